"""Which calibration a footage folder has, and its cameras; a reader for each program."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from ...capture.transforms import WHOLE_FILE, transforms_files
from ...errors import StgaError, listed
from ...files import decoded_text, is_file, is_folder, matching
from .colmap import colmap_models, incomplete_models, read_colmap
from .json_cameras import (
    CAMERA_PARAMS,
    is_camera_params,
    is_gaussian_cameras,
    read_camera_params,
    read_gaussian_cameras,
)
from .metashape import is_metashape, read_metashape
from .nerfstudio import is_transforms, read_nerfstudio
from .realitycapture import (
    is_table_of_cameras,
    is_xmp,
    read_realitycapture_csv,
    read_realitycapture_xmp,
)
from .shots import Calibrated, ImageSize

EXPECTED = (
    "transforms.json, a COLMAP model (sparse/0), Metashape's cameras.xml, "
    "RealityCapture's CSV or XMP files, NeRSemble's camera_params.json"
)
"""Files that are read, for messages."""
LEVELS_ABOVE = 4
"""Folders around one of images, in which NeRSemble's calibration is looked for."""
HEAD_BYTES = 4096
"""Bytes of a file in which UNREAD_MARKS are looked for."""
UNREAD_NAMES = (
    *("poses_bounds.npy", "cameras_sphere.npz", "reconstruction.json", "cameras.sfm"),
    *("intri.yml", "extri.yml"),
)
"""Files of LLFF, NeuS, OpenSfM, Meshroom and EasyMocap."""
OF_JSON = ("transform_matrix", "camera_matrix", "intrinsics", "extrinsics", "world_2_cam")
"""Keys of a camera in the JSON of several programs."""
UNREAD_MARKS: dict[str, tuple[str, ...]] = {
    ".out": ("# Bundle file",),
    ".nvm": ("NVM_V3",),
    ".sfm": ('"poses"',),
    ".yml": ("camera_matrix",),
    ".yaml": ("camera_matrix",),
    ".xml": ("<opencv_storage", "<BlocksExchange", "<calibration", "<camera"),
    ".json": tuple(f'"{word}"' for word in (*OF_JSON, "img_name", "camera_angle_x")),
}
"""Suffix -> words in the beginning of calibrations that are not read."""


class Program(NamedTuple):
    """A program whose calibrations are read.

    find      those in a folder, files or folders that stand for several, the best first
    read      shots of one of them, and sentences about what it lists and is left out
    suffixes  of the files that it reads wherever they are
    is_as_stored  whether the program ignores EXIF's orientation
    """

    find: Callable[[Path], list[Path]]
    read: Callable[[Path, ImageSize], Calibrated]
    suffixes: tuple[str, ...] = ()
    is_as_stored: bool = False


def _transforms(root: Path) -> list[Path]:
    files = transforms_files(root)
    return [files[0] if files[0].name == WHOLE_FILE else root] if files else []


def _read_transforms(path: Path, image_size: ImageSize) -> Calibrated:
    if is_file(path) and is_camera_params(path):
        return read_camera_params(path, image_size)
    if is_file(path) and is_gaussian_cameras(path):
        return read_gaussian_cameras(path), ()
    parts = [read_nerfstudio(file) for file in (transforms_files(path) or [path])]
    messages = tuple(message for _, sentences in parts for message in sentences)
    return [shot for shots, _ in parts for shot in shots], messages


def _exports(suffix: str, is_one: Callable[[Path], bool]) -> Callable[[Path], list[Path]]:
    """What finds the files of any name that are a program's."""
    return lambda root: [
        path for path in _files(root) if path.suffix.lower() == suffix and is_one(path)
    ]


def _files(root: Path) -> list[Path]:
    return [path for path in matching(root, "[!.]*") if is_file(path)]


def _head(path: Path) -> str:
    with path.open("rb") as stream:
        return decoded_text(stream.read(HEAD_BYTES), "replace")


def _xmp_files(root: Path) -> list[Path]:
    """RealityCapture's XMP files of a folder and those in it, of the images beside them."""
    files = (path for pattern in ("*.xmp", "*/*.xmp", "*/*/*.xmp") for path in root.glob(pattern))
    return sorted(path for path in files if is_file(path) and is_xmp(path))


def _xmp_folder(root: Path) -> list[Path]:
    files = _xmp_files(root)
    above = [files[0].parent, *files[0].parents] if files else []
    return [folder for folder in above if all(path.is_relative_to(folder) for path in files)][:1]


def _read_xmp(path: Path, image_size: ImageSize) -> Calibrated:
    if is_file(path):
        return read_realitycapture_xmp([path], image_size, path.parent)
    return read_realitycapture_xmp(_xmp_files(path), image_size, path)


def _camera_params(root: Path) -> list[Path]:
    """NeRSemble's file, in the folder or in one below it, where its data set has it."""
    inside = [path for path in sorted(root.glob(f"*/{CAMERA_PARAMS}")) if is_file(path)]
    return [*_exports(".json", is_camera_params)(root), *inside]


def calibration_above(root: Path) -> Path | None:
    """NeRSemble's file in one of the folders around that of a moment's images."""
    for folder in root.parents[:LEVELS_ABOVE]:
        for path in (folder / CAMERA_PARAMS, folder / "calibration" / CAMERA_PARAMS):
            if is_file(path):
                return path
    return None


PROGRAMS = (
    Program(_transforms, _read_transforms, (".json",)),
    Program(colmap_models, lambda path, _: read_colmap(path), (".bin", ".txt"), True),
    Program(
        _exports(
            ".json", lambda path: is_transforms(path) and path not in transforms_files(path.parent)
        ),
        _read_transforms,
    ),
    Program(_camera_params, _read_transforms),
    Program(_exports(".json", is_gaussian_cameras), _read_transforms),
    Program(
        _exports(".xml", lambda path: is_metashape(_head(path))),
        lambda path, _: read_metashape(path),
        (".xml",),
        True,
    ),
    Program(
        _exports(".csv", lambda path: is_table_of_cameras(_head(path))),
        read_realitycapture_csv,
        (".csv",),
        True,
    ),
    Program(_xmp_folder, _read_xmp, (".xmp",), True),
)
"""Readers, in the order in which the calibration of a folder is looked for."""


def find_calibration(root: Path) -> tuple[Path | None, tuple[str, ...]]:
    """The calibration of a folder, None without, and a sentence about others that it holds.

    It is the first that one of PROGRAMS finds: of COLMAP the model of most images. A folder stands
    for transforms_train.json and its like, for a COLMAP model or for XMP files. Raises StgaError
    for two files, and where there is none but a file that looks like one.
    """
    found = [path for program in PROGRAMS for path in program.find(root)]
    files = [path.name for path in found if is_file(path)]
    if len(files) > 1 and found[0].name in files and files[0] != WHOLE_FILE:
        raise StgaError(f"{root}: {files[0]} and {files[1]} are calibrations; choose one")
    named = transforms_files(root)
    others = [path for path in _files(root) if path not in (*found, *named) and _is_unread(path)]
    others += incomplete_models(root)
    if not found:
        if others:
            raise StgaError(
                f"{others[0]}: looks like a calibration, but is not understood; expected "
                f"{EXPECTED}, or none in the folder"
            )
        return None, ()
    unused = [path.relative_to(root).as_posix() for path in (*found[1:], *others) if path != root]
    unused += ["*.xmp"] if root in found[1:] else []
    message = f"{found[0]}: is the calibration; not used: {listed(unused)}"
    return found[0], (message,) if unused else ()


def read_calibration(path: Path, image_size: ImageSize) -> Calibrated:
    """Shots of a calibration file or folder, and sentences about what it lists and is left out.
    image_size: size of the images of a label, which RealityCapture does not write. Raises StgaError
    that names file and field."""
    if is_folder(path):
        chosen = [program for program in PROGRAMS if path in program.find(path)]
        if not chosen:
            inside, unused = find_calibration(path)
            if inside is None:
                raise StgaError(f"{path}: holds no calibration; expected {EXPECTED}")
            shots, messages = read_calibration(inside, image_size)
            return shots, (*unused, *messages)
    elif not is_file(path):
        raise StgaError(f"{path}: does not exist; expected {EXPECTED}")
    else:
        chosen = [program for program in PROGRAMS if path.suffix.lower() in program.suffixes]
        if not chosen:
            raise StgaError(f"{path}: is no calibration; expected {EXPECTED}")
    shots, messages = chosen[0].read(path, image_size)
    if not shots:
        raise StgaError(f"{path}: has no camera with a pose")
    if chosen[0].is_as_stored:
        shots = [replace(shot, is_as_stored=True) for shot in shots]
    return shots, tuple(f"{path}: {sentence}" for sentence in messages)


def _is_unread(path: Path) -> bool:
    """Whether a file looks like a calibration of another program."""
    marks = UNREAD_MARKS.get(path.suffix.lower(), ())
    is_named = path.name.lower() in UNREAD_NAMES
    return is_named or (bool(marks) and any(mark in _head(path) for mark in marks))
