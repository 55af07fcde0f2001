"""The takes of one person in a folder."""

from os.path import realpath
from pathlib import Path

from ...errors import StgaError
from ...files import is_folder
from .calibrations import find_calibration
from .sources import find_sources, sequence_files


def takes_in(path: Path) -> list[Path]:
    """The videos and folders of images in a folder, each a take; a folder of one camera or of a
    calibrated rig, and a file, is a take itself. Raises StgaError where they cannot be
    distinguished."""
    if not is_folder(path):
        return [path]
    root = Path(realpath(path))
    if find_calibration(root)[0] is not None:
        return [path]
    sources = find_sources(root)
    names = sorted({*sources.videos, *sources.folders})
    if len(names) < 2:
        return [path]
    takes = []
    for name in names:
        files = sequence_files(sources, name)
        takes.append(files if isinstance(files, Path) else files[0].parent)
    if root in takes:
        others = [take.relative_to(root).as_posix() for take in takes if take != root]
        raise StgaError(
            f"{path}: holds images beside {others[0]}; put the images into a folder of their own, "
            "such as around, for them to be a take"
        )
    return takes
