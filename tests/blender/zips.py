"""Built zips that say that they are of another version, for tests of updates."""

import zipfile
from pathlib import Path

from stga_addon import __version__


def with_version(archive: Path, version: str, out: Path) -> Path:
    """Copy a built zip to the path `out`, with another version in its manifest."""
    with zipfile.ZipFile(archive) as source, zipfile.ZipFile(out, "w") as made:
        for entry in source.infolist():
            data = source.read(entry)
            if entry.filename == "blender_manifest.toml":
                data = data.replace(
                    f'version = "{__version__}"'.encode(), f'version = "{version}"'.encode(), 1
                )
            made.writestr(entry, data)
    return out
