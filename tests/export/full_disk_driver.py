"""Exports every format to a disk that is full; run by test_formats.py.

`full_disk_driver.py DISK` prints, for each format and share of the room that it needs, its message
and what it left. DISK must be a small mount that nobody else sees.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from export.web.conftest import Head, make_head
from stga_addon.errors import StgaError
from stga_addon.export.formats import FORMATS, export_avatar

SHARES = {".usdz": (0.0, 0.6, 1.4)}
"""Of the size of the files, per suffix: how much room there is. A .usdz is packed from a file as
large as itself."""


def main(disk: Path) -> list[dict[str, object]]:
    head, found = make_head(), []
    for format, entry in FORMATS.items():
        path = disk / "new" / f"anna{next(iter(entry.suffixes), '')}"
        for suffix in entry.suffixes or [""]:
            path = path.with_suffix(suffix)
            needed = sum(file.stat().st_size for file in export(path, head, format))
            empty(path.parent)
            for share in SHARES.get(suffix, (0.0, 0.6)):
                fill(disk / "filler", round(share * needed))
                message = ""
                try:
                    export(path, head, format)
                except StgaError as error:
                    message = str(error)
                except Exception as error:
                    message = f"not a StgaError: {error!r}"
                (disk / "filler").unlink()
                left = [str(item.relative_to(disk)) for item in disk.rglob("*")]
                case = {"format": format, "path": str(path), "share": share}
                found.append({**case, "message": message, "left": left})
                empty(path.parent)
    return found


def export(path: Path, head: Head, format: str) -> Sequence[Path]:
    return export_avatar(path, head.avatar, format, enumerate(head.meshes), head.sequence)


def fill(filler: Path, room: int) -> None:
    """Fill the disk up to `room` bytes."""
    with filler.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(1 << 16))
        except OSError:
            file.truncate(file.tell() - room)


def empty(folder: Path) -> None:
    for item in sorted(folder.rglob("*"), reverse=True):
        item.rmdir() if item.is_dir() else item.unlink()
    if folder.exists():
        folder.rmdir()


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]))))
