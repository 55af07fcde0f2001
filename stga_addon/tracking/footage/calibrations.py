"""Which calibration a footage folder has, and its cameras; a reader for each program."""

from collections.abc import Callable
from pathlib import Path

from ...capture.transforms import WHOLE_FILE, transforms_files
from ...errors import StgaError
from ...files import decoded_text, is_file, is_folder
from .colmap import colmap_models, incomplete_models, model_suffix, read_colmap
from .metashape import is_metashape, read_metashape
from .nerfstudio import is_transforms, read_nerfstudio
from .realitycapture import (
    is_table_of_cameras,
    is_xmp,
    read_realitycapture_csv,
    read_realitycapture_xmp,
)
from .shots import Calibrated, ImageSize, Shot, listed

EXPECTED = (
    "transforms.json, a COLMAP model (sparse/0), Metashape's cameras.xml, "
    "RealityCapture's CSV or XMP files"
)
HEAD_BYTES = 4096
UNREAD_NAMES = (
    *("poses_bounds.npy", "cameras_sphere.npz", "reconstruction.json", "cameras.sfm"),
    *("intri.yml", "extri.yml"),
)
"""Files of LLFF, NeuS, OpenSfM, Meshroom and EasyMocap."""
OF_JSON = ("transform_matrix", "camera_matrix", "intrinsics", "extrinsics", "world_2_cam")
UNREAD_MARKS: dict[str, tuple[str, ...]] = {
    ".out": ("# Bundle file",),
    ".nvm": ("NVM_V3",),
    ".sfm": ('"poses"',),
    ".yml": ("camera_matrix",),
    ".yaml": ("camera_matrix",),
    ".xml": ("<opencv_storage", "<BlocksExchange", "<calibration", "<camera"),
    ".json": tuple(f'"{word}"' for word in (*OF_JSON, "img_name", "camera_angle_x")),
    ".csv": (),
}
"""Suffix -> words in the beginning of calibrations that are not read."""


def find_calibration(root: Path) -> tuple[Path | None, tuple[str, ...]]:
    """The calibration of a folder, None without, and a sentence about others that it holds.

    It is the first of: transforms files, the COLMAP model of most images, Metashape,
    RealityCapture's CSV and XMP. A folder stands for transforms_train.json and its like, for a
    COLMAP model or for XMP files. Raises StgaError for two files, and where there is none but a
    file that looks like one.
    """
    transforms = transforms_files(root)
    found = [transforms[0] if transforms[0].name == WHOLE_FILE else root] if transforms else []
    found += colmap_models(root)
    visible = sorted(path for path in root.iterdir() if not path.name.startswith("."))
    listed_files = [path for path in visible if _may_be_one(path) and path not in transforms]
    heads = {path: _head(path) for path in listed_files}
    files = [path for path, head in heads.items() if _is_read(path, head)]
    if len(files) > 1 and not found:
        raise StgaError(f"{root}: {files[0].name} and {files[1].name} are calibrations; choose one")
    found += files
    names = [own.relative_to(root).as_posix() for own in found]
    if xmp := xmp_files(root):
        found.append(_common_folder(xmp))
        names.append(f"{xmp[0].relative_to(root).as_posix()} and its like")
    others = [path for path, head in heads.items() if path not in files and _is_unread(path, head)]
    others += incomplete_models(root)
    if not found:
        if others:
            raise StgaError(
                f"{others[0]}: looks like a calibration, but is not understood; expected "
                f"{EXPECTED}, or none in the folder"
            )
        return None, ()
    names += [path.relative_to(root).as_posix() for path in others]
    unused = (f"{found[0]}: is the calibration; not used: {listed(names[1:])}",)
    return found[0], unused if len(names) > 1 else ()


def read_calibration(path: Path, image_size: ImageSize) -> Calibrated:
    """Shots of a calibration file or folder, and sentences about what it lists and is left out.
    image_size: size of the images of a label, which RealityCapture does not write. Raises StgaError
    that names file and field."""
    read: Callable[[Path], Calibrated] | None
    suffix = path.suffix.lower()
    parts = [path]
    if is_folder(path):
        splits = transforms_files(path)
        xmp = xmp_files(path)
        if splits:
            read = read_nerfstudio
            parts = splits
        elif model_suffix(path):
            read = read_colmap
        elif xmp and _common_folder(xmp) == path:
            read = _xmp_reader(xmp, image_size)
        else:
            inside, unused = find_calibration(path)
            if inside is None or inside == path:
                raise StgaError(f"{path}: holds no calibration; expected {EXPECTED}")
            shots, more = read_calibration(inside, image_size)
            return shots, (*unused, *more)
    elif not is_file(path):
        raise StgaError(f"{path}: does not exist; expected {EXPECTED}")
    elif suffix in (".bin", ".txt") and model_suffix(path.parent):
        read = read_colmap
        parts = [path.parent]
    else:
        read = {
            ".json": read_nerfstudio,
            ".xml": read_metashape,
            ".csv": lambda own: read_realitycapture_csv(own, image_size),
            ".xmp": _xmp_reader([path], image_size),
        }.get(suffix)
        if read is None:
            raise StgaError(f"{path}: is no calibration; expected {EXPECTED}")
    shots = list[Shot]()
    sentences = list[str]()
    for part in parts:
        own, told = read(part)
        shots += own
        sentences += [f"{part}: {sentence}" for sentence in told]
    if not shots:
        raise StgaError(f"{path}: has no camera with a pose")
    return shots, tuple(sentences)


def xmp_files(root: Path) -> list[Path]:
    """RealityCapture's XMP files of a folder and those in it, of the images beside them."""
    files = (path for pattern in ("*.xmp", "*/*.xmp", "*/*/*.xmp") for path in root.glob(pattern))
    return sorted(path for path in files if is_file(path) and is_xmp(path))


def _xmp_reader(paths: list[Path], image_size: ImageSize) -> Callable[[Path], Calibrated]:
    folder = _common_folder(paths)
    return lambda _: read_realitycapture_xmp(paths, image_size, folder)


def _common_folder(paths: list[Path]) -> Path:
    first = paths[0].parent
    return next(own for own in (first, *first.parents) if all(p.is_relative_to(own) for p in paths))


def _may_be_one(path: Path) -> bool:
    name = path.name.lower()
    return is_file(path) and (path.suffix.lower() in UNREAD_MARKS or name in UNREAD_NAMES)


def _head(path: Path) -> str:
    with path.open("rb") as stream:
        return decoded_text(stream.read(HEAD_BYTES), "replace")


def _is_read(path: Path, head: str) -> bool:
    """Whether a file is a calibration by its beginning, of a name that is not looked for."""
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return is_table_of_cameras(head)
    return (suffix == ".xml" and is_metashape(head)) or (suffix == ".json" and is_transforms(path))


def _is_unread(path: Path, head: str) -> bool:
    marks = UNREAD_MARKS.get(path.suffix.lower(), ())
    return path.name.lower() in UNREAD_NAMES or any(mark in head for mark in marks)
