"""The web page of an avatar: player, styles and data in one HTML file without external requests."""

import base64
import html
import re
from functools import cache
from pathlib import Path

PLAYER = Path(__file__).parent / "player"
ELEMENT = "stga-avatar.js"
"""Module of the custom element."""
PAGE_MODULES = "light_controls.js", "page.js"
"""Those of the page around it."""
IMPORT = re.compile(r"^import\b[^;]*?'\./([\w-]+\.js)';\n", re.MULTILINE)
EXPORT = re.compile(r"^export (?=class|function|const|async)", re.MULTILINE)
TYPES = re.compile(
    r"^// @ts-check\n|^ */\*\*\n(?: *\* @.*\n)+ *\*/\n|^ */\*\* @.*\*/\n|^ *\* @.*\n|/\*\* @type \{.*?\} \*/ ",
    re.MULTILINE,
)
"""Comments that only `make lint-web` reads."""


@cache
def element_script() -> str:
    """The custom element as one module: the player's files without their imports and exports, under their licence."""
    sources = [EXPORT.sub("", _source(name)) for name in modules()]
    licence = (PLAYER / "LICENSE").read_text(encoding="utf-8")
    return "/*!\n" + licence + "*/\n" + "\n".join(sources)


@cache
def modules(name: str = ELEMENT) -> tuple[str, ...]:
    """A module after all that it imports, each once."""
    imported = IMPORT.findall((PLAYER / name).read_text(encoding="utf-8"))
    return tuple(dict.fromkeys([*(each for other in imported for each in modules(other)), name]))


def _source(name: str) -> str:
    """A module without its imports and types."""
    return TYPES.sub("", IMPORT.sub("", (PLAYER / name).read_text(encoding="utf-8")))


def page(title: str, notice: str, data: bytes) -> str:
    """The HTML of a page that plays `data` (`data_file`); `notice`: a sentence on its licence, or ""."""
    template = (PLAYER / "page.html").read_text(encoding="utf-8")
    parts = {
        "title": html.escape(title),
        "notice": html.escape(notice),
        "style": (PLAYER / "page.css").read_text(encoding="utf-8"),
        "script": "\n".join((element_script(), *map(_source, PAGE_MODULES))),
        "data": base64.b64encode(data).decode("ascii"),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template)
