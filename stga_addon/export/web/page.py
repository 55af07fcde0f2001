"""The web page of an avatar as one HTML file, or its data and the player for a server."""

import base64
import gzip
import html
import re
from functools import cache
from pathlib import Path

from ...avatar.file import Avatar
from ...avatar.splats import harmonics_text
from ...files import replacing_together
from ...light.shading import SHADING_DEFINES, SHADING_FUNCTIONS
from ...raster.splat_shader import SPLAT_DEFINES, SPLAT_FUNCTIONS
from ..playback import Playback
from ..rig import RiggedAvatar
from ..skinned_gltf import glb_of, in_planes

PLAYER = Path(__file__).parent / "player"
"""Folder of the JavaScript modules."""
ELEMENT = "stga-avatar.js"
"""Module of the custom element."""
PAGE = "page.js"
"""Module of the page around it."""
IMPORT = re.compile(r"^import\b[^;]*?'\./([\w-]+\.js)';\n", re.MULTILINE)
"""Imports of the modules, which are one in a page."""
EXPORT = re.compile(r"^export (?=class|function|const|async)", re.MULTILINE)
"""Their exports."""
TYPES = re.compile(
    r"^// @ts-check\n|^ */\*\*\n(?: *\* @.*\n)+ *\*/\n|^ */\*\* @.*\*/\n|^ *\* @.*\n|"
    r"/\*\* @type \{.*?\} \*/ ",
    re.MULTILINE,
)
"""Comments that only `make lint-web` reads."""
NOTES = re.compile(r"^ *//.*\n|^ +", re.MULTILINE)
"""Comments and indents, which a page is smaller without."""
HTML_SAFE = str.maketrans("&<>", ",.:")
"""Translation of those base 85 digits that have a meaning in HTML."""


@cache
def element_script() -> str:
    """The custom element as one module, under its licence."""
    licence = (PLAYER / "LICENSE").read_text(encoding="utf-8")
    return "/*!\n" + licence + "*/\n" + "\n".join(map(_source, modules()))


@cache
def modules(name: str = ELEMENT) -> tuple[str, ...]:
    """A module after all that it imports, each once."""
    imported = IMPORT.findall((PLAYER / name).read_text(encoding="utf-8"))
    return tuple(dict.fromkeys([*(each for other in imported for each in modules(other)), name]))


def _source(name: str) -> str:
    """A module without imports, exports and types, and with the GLSL shared with Blender."""
    source = (PLAYER / name).read_text(encoding="utf-8")
    for comment in (IMPORT, EXPORT, TYPES):
        source = comment.sub("", source)
    source = source.replace("{{harmonics}}", "; ".join(harmonics_text()[1:]))
    source = source.replace("{{splat}}", SPLAT_DEFINES + SPLAT_FUNCTIONS)
    return source.replace("{{shading}}", SHADING_DEFINES + SHADING_FUNCTIONS)


def page(title: str, notice: str, data: bytes) -> str:
    """The HTML of a page that plays `data` (`skinned_glb`); `notice`: on its licence, or ""."""
    template = (PLAYER / "page.html").read_text(encoding="utf-8")
    packed = gzip.compress(in_planes(data), 9, mtime=0)
    parts = {
        "title": html.escape(title),
        "notice": html.escape(notice),
        "script": NOTES.sub("", f"{element_script()}\n{_source(PAGE)}"),
        "data": base64.b85encode(packed).decode("ascii").translate(HTML_SAFE),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template)


PAGE_BYTES = 700_000
"""Size of a page without splats, about."""
BYTES_PER_SPLAT = 20
"""Size of a splat in it, about."""
BYTES_PER_COEFFICIENT = 0.45
"""Size of a coefficient of a driven offset in it, about."""


def write_web(path: Path, rigged: RiggedAvatar, playback: Playback) -> list[Path]:
    """Write a page that plays the avatar, or an .glb file with the player beside it; returns
    the files.

    Raises StgaError where a value cannot be stored, or a file not be written.
    """
    data = glb_of(path, rigged, playback)
    contents = {path: page(playback.title, rigged.notice, data).encode("utf-8")}
    if path.suffix.lower() == ".glb":
        contents = {path: data, path.with_name(ELEMENT): element_script().encode("utf-8")}
    with replacing_together() as new_file:
        for file, content in contents.items():
            with new_file(file) as partial:
                partial.write_bytes(content)
    return list(contents)


def web_bytes(avatar: Avatar) -> int:
    """About the size of a page of the avatar."""
    coefficients = sum(each.size for each in avatar.driven_offsets.values())
    size = PAGE_BYTES + BYTES_PER_SPLAT * len(avatar.splats)
    return round(size + BYTES_PER_COEFFICIENT * coefficients)
