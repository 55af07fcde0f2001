"""Real Blenders, and built zips that say that they are of another version, for tests of updates."""

import os
import shlex
import zipfile
from pathlib import Path

from stga_addon import __version__

BLENDERS = [
    shlex.split(each) for each in os.environ.get("STGA_BLENDER", "").split(" ; ") if each.strip()
]
"""Commands that start a Blender, one after another, separated by " ; " in the variable."""
OLD_VERSION = "0.1.9"


def name_of(command: list[str]) -> str:
    return "-".join(command[-2:])


def with_version(archive: Path, version: str, out: Path) -> Path:
    """Copy a built zip to the path `out`, with another version in its manifest."""
    own, other = (f'version = "{each}"'.encode() for each in (__version__, version))
    with zipfile.ZipFile(archive) as source, zipfile.ZipFile(out, "w") as made:
        for entry in source.infolist():
            data = source.read(entry)
            is_manifest = entry.filename == "blender_manifest.toml"
            made.writestr(entry, data.replace(own, other, 1) if is_manifest else data)
    return out
