"""The web page of an avatar: player, styles and data in one HTML file without external requests."""

import base64
import html
import re
from functools import cache
from pathlib import Path

PLAYER = Path(__file__).parent / "player"
MODULES = (
    "vector.js",
    "strain.js",
    "signals.js",
    "data.js",
    "performance.js",
    "rotation.js",
    "shapes.js",
    "motion.js",
    "rig.js",
    "face_frames.js",
    "depth_sort.js",
    "harmonics.js",
    "lighting.js",
    "bounce.js",
    "surface.js",
    "shaders.js",
    "likeness.js",
    "light_shaders.js",
    "gl.js",
    "camera.js",
    "lashes.js",
    "light_pass.js",
    "renderer.js",
    "player.js",
    "controls.js",
    "stga-avatar.js",
)
"""Modules of the custom element, each after those that it imports."""
PAGE_MODULES = "light_controls.js", "page.js"
"""Those of the page around it."""
IMPORT = re.compile(r"^import\b[^;]*?'\./[\w-]+\.js';\n", re.MULTILINE)
EXPORT = re.compile(r"^export (?=class|function|const|async)", re.MULTILINE)
TYPES = re.compile(
    r"^// @ts-check\n|^ */\*\*\n(?: *\* @.*\n)+ *\*/\n|^ */\*\* @.*\*/\n|^ *\* @.*\n|/\*\* @type \{.*?\} \*/ ",
    re.MULTILINE,
)
"""Comments that only `make lint-web` reads."""


@cache
def element_script() -> str:
    """The custom element as one module: the player's files without their imports and exports, under their licence."""
    sources = [EXPORT.sub("", _source(name)) for name in MODULES]
    licence = (PLAYER / "LICENSE").read_text(encoding="utf-8")
    return "/*!\n" + licence + "*/\n" + "\n".join(sources)


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
