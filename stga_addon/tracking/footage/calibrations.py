"""Which calibration a footage folder has, and its cameras."""

from os.path import isdir, isfile
from pathlib import Path

from ...capture.transforms import SPLITS
from ...errors import StgaError
from .colmap import find_colmap, read_colmap
from .metashape import read_metashape
from .nerfstudio import read_nerfstudio
from .realitycapture import (
    ImageSize,
    is_realitycapture_csv,
    read_realitycapture_csv,
    read_realitycapture_xmp,
)
from .shots import Shot

TRANSFORMS = ("transforms.json", *(f"transforms_{split}.json" for split in SPLITS))
EXPECTED = "transforms.json, a COLMAP model (sparse/0), Metashape's cameras.xml, RealityCapture's CSV or XMP files"
NAMES_IN_WARNING = 5


def find_calibration(root: Path) -> Path | None:
    """The calibration of a folder, the first of: transforms files, COLMAP, Metashape,
    RealityCapture's CSV and XMP.

    A folder stands for transforms_train.json and its like, for a COLMAP model or for XMP files.
    """
    if (root / TRANSFORMS[0]).is_file():
        return root / TRANSFORMS[0]
    if any((root / name).is_file() for name in TRANSFORMS):
        return root
    colmap = find_colmap(root)
    if colmap is not None:
        return colmap
    xml = [path for path in sorted(root.glob("*.xml")) if isfile(path) and _is_metashape(path)]
    tables = [
        path for path in sorted(root.glob("*.csv")) if isfile(path) and is_realitycapture_csv(path)
    ]
    if len(xml + tables) > 1:
        raise StgaError(
            f"{root}: {(xml + tables)[0].name} and {(xml + tables)[1].name} are calibrations; choose one"
        )
    folders = [folder for folder in (root, root / "images") if any(folder.glob("*.xmp"))]
    return next(iter(xml + tables + folders), None)


def read_calibration(path: Path, image_size: ImageSize) -> tuple[list[Shot], tuple[str, ...]]:
    """Shots of a calibration file or folder, and a sentence about cameras that it lists without a
    pose.

    image_size: size of the images of a label, which RealityCapture does not write. Raises StgaError
    that names file and field.
    """
    shots, without_pose = _read(path, image_size)
    if not shots:
        raise StgaError(f"{path}: has no camera with a pose")
    if not without_pose:
        return shots, ()
    more = (
        ""
        if len(without_pose) <= NAMES_IN_WARNING
        else f" and {len(without_pose) - NAMES_IN_WARNING} more"
    )
    names = ", ".join(without_pose[:NAMES_IN_WARNING])
    return shots, (f"{path}: left out cameras without a pose: {names}{more}",)


def _read(path: Path, image_size: ImageSize) -> tuple[list[Shot], list[str]]:
    suffix = path.suffix.lower()
    if isdir(path):
        splits = [path / name for name in TRANSFORMS if (path / name).is_file()]
        model = find_colmap(path)
        if splits:
            return [shot for name in splits for shot in read_nerfstudio(name)], []
        if model is not None:
            return read_colmap(model), []
        return read_realitycapture_xmp(path.glob("*.xmp"), image_size)
    if not isfile(path):
        raise StgaError(f"{path}: does not exist; expected {EXPECTED}")
    if suffix == ".json":
        return read_nerfstudio(path), []
    if suffix == ".xml":
        return read_metashape(path)
    if suffix == ".csv":
        return read_realitycapture_csv(path, image_size), []
    if suffix == ".xmp":
        return read_realitycapture_xmp([path], image_size)
    if suffix in (".bin", ".txt") and find_colmap(path.parent) == path.parent:
        return read_colmap(path.parent), []
    raise StgaError(f"{path}: is no calibration; expected {EXPECTED}")


def _is_metashape(path: Path) -> bool:
    """Whether it begins as Metashape's export; other programs write XML files beside images,
    too."""
    with path.open("rb") as stream:
        start = stream.read(1024)
    return b"<document" in start and b"<chunk" in start
