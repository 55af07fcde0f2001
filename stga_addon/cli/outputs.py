"""Size of the files that a command is about to write."""

from pathlib import Path

from ..avatar.file import Avatar
from ..export.formats import check_free_space, range_bytes
from ..format import format_bytes


def announce_size(path: Path, avatar: Avatar, format: str, frames: int) -> None:
    """Print about how large the export of a range of frames will be. Raises StgaError where the disk has too little
    free space."""
    size = range_bytes(avatar, format, frames)
    check_free_space(path, size)
    plural = "" if frames == 1 else "s"
    print(f"{frames} frame{plural} of {len(avatar.splats)} splats: about {format_bytes(size)}")
