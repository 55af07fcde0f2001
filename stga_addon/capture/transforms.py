"""Cameras and frames: `transforms_{train,val,test}.json` or `transforms.json`."""

import itertools
import math
import posixpath
import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from os.path import isfile
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from ..errors import StgaError, shorten
from ..files import read_json
from .camera import MAX_COORDINATE_M, MAX_FOCAL_PIXELS, Camera, camera_from_gl, is_image_size
from .model import FPS_LIMIT, Item, View

SPLITS = ("train", "val", "test")
PRINCIPAL_POINTS = ("vhap", "opencv", "center")
DEFAULT_PRINCIPAL_POINT = PRINCIPAL_POINTS[0]
ROTATION_TOLERANCE = 1e-3  # exporters write float32 poses, some rounded to a few decimals
MAX_NUMBER = sys.float_info.max  # JSON does not limit whole numbers
INDEX_LIMIT = 1 << 31
MIN_ANGLE = 1e-9  # radians; half of it still has a tangent
MAX_PATH_CHARACTERS, MAX_NAME_BYTES = 2000, 255
MATRIX = "a 4x4 matrix of finite numbers"


@dataclass(frozen=True)
class Frame:
    """One entry of a transforms file.

    principal  (cx, cy) in pixels as written in the file; the image center where they are missing
    camera_id  name of the camera in the file, or None
    mesh, flame  file of the tracked mesh or FLAME parameters of the frame's timestep, or None
    where      file and entry, with which messages begin
    """

    view: View
    principal: tuple[float, float]
    camera_id: str | None
    mesh: Path | None
    flame: Path | None
    where: str


def camera_entry(camera: Camera) -> dict[str, Any]:
    """A camera as a transforms file's entry; cy is counted from the bottom, as VHAP writes it."""
    return {
        "transform_matrix": camera.camera_to_world_gl.tolist(),
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fl_x,
        "fl_y": camera.fl_y,
        "cx": camera.cx,
        "cy": camera.height - camera.cy,
    }


@dataclass(frozen=True)
class Transforms:
    """All frames by split, and what the top level says, None where it is missing."""

    splits: dict[str, tuple[Frame, ...]]
    canonical_mesh: Path | None
    regions: Path | None
    fps: float | None = None

    @property
    def frames(self) -> tuple[Frame, ...]:
        return tuple(frame for split in self.splits.values() for frame in split)


def has_transforms(folder: Path) -> bool:
    """Whether the folder holds a transforms file of any split."""
    return any((folder / name).is_file() for name in ("transforms.json", *map(_split_file, SPLITS)))


def read_transforms(
    path: Path, principal_point: str = DEFAULT_PRINCIPAL_POINT
) -> tuple[Frame, ...]:
    """Read the frames of one transforms file; neither images nor tracked files are opened, nor need
    they exist.

    A frame's own intrinsics take precedence over the top level's, which are wrong in some exports.
    `transform_matrix` is camera-to-world with OpenGL axes. `principal_point` says what `cy` means:
    "vhap" (H − cy from the top, as VHAP's exporter writes it), "opencv" (from the top) or "center"
    (cx and cy are ignored, as GaussianAvatars does). Paths are relative to the file's folder and
    may leave it only for a sibling folder (union sets of VHAP). Raises StgaError naming the file
    and the field.
    """
    return _numbered(_read_frames(path, read_json(path), principal_point))


def read_splits(folder: Path, principal_point: str = DEFAULT_PRINCIPAL_POINT) -> Transforms:
    """Read every split of a capture folder, as `read_transforms` does; `transforms.json` alone is
    all training.

    Cameras without `camera_index` are numbered alike in all splits. Raises StgaError.
    """
    names = {split: _split_file(split) for split in SPLITS}
    names = {split: name for split, name in names.items() if (folder / name).is_file()}
    documents = {}
    for split, name in (names or {"train": "transforms.json"}).items():
        values = read_json(folder / name)
        if not isinstance(values, dict):
            raise StgaError(f"{folder / name}: expected a JSON object with the field frames")
        documents[split] = _Record(folder / name, folder.resolve(), "", values)
    records = documents.values()
    frames = {
        split: _read_frames(record.path, record.values, principal_point)
        for split, record in documents.items()
    }
    rates = [frame_rate(record.path, record.values) for record in records]
    numbered = iter(_numbered([frame for split in frames.values() for frame in split]))
    counts = {split: len(frames.get(split, ())) for split in SPLITS}
    splits = {split: tuple(itertools.islice(numbered, n)) for split, n in counts.items()}
    meshes = [record.path_of("canonical_mesh_path") for record in records]
    regions = [record.path_of("regions_path") for record in records]
    return Transforms(splits, _first(meshes), _first(regions), _first(rates))


def _first(values: Iterable[Item | None]) -> Item | None:
    return next((value for value in values if value is not None), None)


def frame_rate(path: Path, values: dict[str, Any]) -> float | None:
    """`fps` at the top level of a transforms file; None without. Raises StgaError."""
    record = _Record(path, path.parent, "", values)
    return record.number("fps", low=0, high=FPS_LIMIT) if record.has("fps") else None


def with_principal_point(camera: Camera, written: tuple[float, float], convention: str) -> Camera:
    """The camera with the principal point that the file's (cx, cy) mean (`read_transforms`)."""
    if convention not in PRINCIPAL_POINTS:
        raise StgaError(
            f"principal point convention {convention!r} is not one of {', '.join(PRINCIPAL_POINTS)}"
        )
    if convention == "center":
        return replace(camera, cx=camera.width / 2, cy=camera.height / 2)
    cx, cy = written
    return replace(camera, cx=cx, cy=camera.height - cy if convention == "vhap" else cy)


def tracked_files(frames: Iterable[Frame], field: str) -> dict[int, Path]:
    """timestep -> its tracked file, ascending; `field` is "mesh" or "flame".

    Raises StgaError where a frame has none, or where two frames of a timestep name different ones.
    """
    files: dict[int, Path] = {}
    key = "mesh_path" if field == "mesh" else "flame_param_path"
    for frame in frames:
        path, timestep = getattr(frame, field), frame.view.timestep
        if path is None:
            raise StgaError(
                f"{frame.where}.{key}: is missing; expected the tracked file of timestep {timestep}"
            )
        if files.setdefault(timestep, path) != path:
            raise StgaError(
                f"{frame.where}.{key}: is {path}, "
                f"but timestep {timestep} already has {files[timestep]}"
            )
    return dict(sorted(files.items()))


def inside(root: Path, relative: str, where: str) -> Path:
    """Resolve a path of a capture's file against the folder `root` of that file.

    `..` may lead to a sibling of `root`, not further; symbolic links inside the capture are
    followed. Raises StgaError, beginning with `where`, for absolute paths and for those that lead
    outside.
    """
    text = relative.replace("\\", "/")
    parts = posixpath.normpath(text).split("/")
    drives = [PureWindowsPath(part).drive for part in parts if ":" in part]
    absolute = text.startswith("/") or any(drives)
    if absolute or "\0" in text or parts == ["."]:
        raise StgaError(f"{where}: {shorten(relative)} is not a path of a file relative to {root}")
    longest = max(len(part.encode()) for part in parts)
    if len(text) > MAX_PATH_CHARACTERS or longest > MAX_NAME_BYTES:
        raise StgaError(f"{where}: {shorten(relative)} is longer than a path can be")
    # Behind a first "..", only the name of a sibling may follow.
    if parts[:2] == ["..", ".."] or parts == [".."]:
        raise StgaError(f"{where}: {shorten(relative)} leads outside of {root.parent}")
    return root.parent.joinpath(*parts[1:]) if parts[0] == ".." else root.joinpath(*parts)


@dataclass(frozen=True)
class _Record:
    """A JSON object, its file, that file's resolved folder, and its place in it for messages."""

    path: Path
    folder: Path
    place: str
    values: dict[str, Any]

    def where(self, key: str) -> str:
        return f"{self.path}: {self.place}{key}"

    def has(self, key: str) -> bool:
        return self.values.get(key) is not None

    def number(self, key: str, low: float = -math.inf, high: float = math.inf) -> float:
        """A finite number strictly between the bounds."""
        value = self.values[key]
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not low < value < high or abs(value) > MAX_NUMBER:
            bounds = (("above", low), ("below", high))
            limits = [f"{word} {limit:g}" for word, limit in bounds if math.isfinite(limit)]
            expected = f"a finite number {' and '.join(limits)}".strip()
            raise StgaError(f"{self.where(key)}: expected {expected}, not {shorten(value)}")
        return float(value)

    def natural(self, key: str) -> int:
        value = self.values[key]
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < INDEX_LIMIT:
            expected = "a whole number from 0 up, below 2^31"
            raise StgaError(f"{self.where(key)}: expected {expected}, not {shorten(value)}")
        return value

    def path_of(self, key: str) -> Path | None:
        value = self.values.get(key)
        if value is None:
            return None
        if not isinstance(value, str):
            raise StgaError(f"{self.where(key)}: expected a relative path, not {shorten(value)}")
        return inside(self.folder, value, self.where(key))


def _split_file(split: str) -> str:
    return f"transforms_{split}.json"


def _read_frames(path: Path, values: Any, principal_point: str) -> list[Frame]:
    if not isinstance(values, dict) or not isinstance(values.get("frames"), list):
        raise StgaError(f"{path}: frames: expected a list with one entry per image")
    shared = _Record(path, path.parent.resolve(), "", values)
    timed = any(_timestep_key(entry) for entry in values["frames"] if isinstance(entry, dict))
    cameras: dict[tuple[bytes | float, ...], Camera] = {}
    frames = []
    for number, entry in enumerate(values["frames"]):
        if not isinstance(entry, dict):
            raise StgaError(f"{path}: frames[{number}]: expected an object, not {shorten(entry)}")
        record = replace(shared, place=f"frames[{number}].", values=entry)
        frames.append(_frame(record, shared, timed, principal_point, cameras))
    return frames


def _frame(
    record: _Record,
    shared: _Record,
    timed: bool,
    principal_point: str,
    cameras: dict[tuple[bytes | float, ...], Camera],
) -> Frame:
    """cameras: those of earlier frames by their numbers in the file; most frames share theirs."""
    image = record.path_of("file_path")
    if image is None:
        raise StgaError(f"{record.where('file_path')}: is missing; expected the path of the image")
    if not image.suffix:  # as Blender's NeRF exporters write it
        image = image.with_name(image.name + ".png")
    key = _timestep_key(record.values)
    if timed and key is None:
        raise StgaError(
            f"{record.where('timestep_index')}: is missing, though other frames have it"
        )
    size = width, height = _image_size(record, shared, image)
    written = _principal(record, shared, "cx", width), _principal(record, shared, "cy", height)
    focal = _focal(record, shared, width, height)
    try:
        matrix = np.array(record.values["transform_matrix"], np.float64)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise StgaError(f"{record.where('transform_matrix')}: expected {MATRIX}") from error
    known = matrix.tobytes(), *size, *focal, *written
    if known not in cameras:
        camera = camera_from_gl(_pose(record, matrix), *size, *focal, *written)
        cameras[known] = with_principal_point(camera, written, principal_point)
    timestep = record.natural(key) if key else 0
    index = record.natural("camera_index") if record.has("camera_index") else -1
    name = record.values["file_path"].replace("\\", "/")  # files are named after views
    mask = record.path_of("fg_mask_path")
    view = View(timestep, index, cameras[known], name, image, mask)
    camera_id = str(record.values["camera_id"]) if record.has("camera_id") else None
    mesh, flame = record.path_of("mesh_path"), record.path_of("flame_param_path")
    return Frame(view, written, camera_id, mesh, flame, record.where("").rstrip("."))


def _timestep_key(values: dict[str, Any]) -> str | None:
    """The key of the timestep: VHAP writes timestep_index, the STGA authors' release keyframe."""
    keys = ("timestep_index", "keyframe")
    return next((key for key in keys if values.get(key) is not None), None)


def _principal(record: _Record, shared: _Record, key: str, size: int) -> float:
    """One coordinate of the principal point as written; the image's center where there is none."""
    source = record if record.has(key) else shared
    if not source.has(key):
        return size / 2
    return source.number(key, low=-MAX_FOCAL_PIXELS, high=MAX_FOCAL_PIXELS)


def _image_size(record: _Record, shared: _Record, image: Path) -> tuple[int, int]:
    source = next((s for s in (record, shared) if s.has("w") and s.has("h")), None)
    if source is None:
        if not isfile(image):
            raise StgaError(
                f"{record.where('w')}: w and h are missing, "
                f"and so is the image {image} to take them from"
            )
        from .images import image_size

        return image_size(image)
    width, height = source.number("w", low=0), source.number("h", low=0)
    if not is_image_size(width, height):
        raise StgaError(
            f"{source.where('w')}: expected an image size in pixels, not {width:g} x {height:g}"
        )
    return int(width), int(height)


def _focal(record: _Record, shared: _Record, width: int, height: int) -> tuple[float, float]:
    source = next((s for s in (record, shared) if s.has("fl_x") or s.has("camera_angle_x")), None)
    if source is None:
        where = record.where("fl_x")
        raise StgaError(f"{where}: is missing, and so is camera_angle_x, here and at the top level")

    def of_angle(key: str, size: int) -> float:
        return size / 2 / math.tan(source.number(key, low=MIN_ANGLE, high=math.pi) / 2)

    given = source.has("fl_x")
    fl_x = fl_y = source.number("fl_x", low=0) if given else of_angle("camera_angle_x", width)
    if source.has("fl_y"):
        fl_y = source.number("fl_y", low=0)
    elif source.has("camera_angle_y") and not given:
        fl_y = of_angle("camera_angle_y", height)
    for name, value in (("fl_x", fl_x), ("fl_y", fl_y)):
        if not 1 <= value <= MAX_FOCAL_PIXELS:
            raise StgaError(
                f"{record.where(name)}: expected a focal length of 1 to 1e7 pixels, not {value:g}"
            )
    return fl_x, fl_y


def _pose(record: _Record, matrix: np.ndarray) -> np.ndarray:
    where = record.where("transform_matrix")
    finite = matrix.shape == (4, 4) and np.isfinite(matrix).all()
    if not finite or not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise StgaError(f"{where}: expected {MATRIX} that ends in the row 0 0 0 1")
    if np.abs(matrix).max() > MAX_COORDINATE_M:
        raise StgaError(
            f"{where}: the camera lies farther than {MAX_COORDINATE_M:g} from the origin"
        )
    rotation = matrix[:3, :3]
    orthonormal = np.abs(rotation @ rotation.T - np.eye(3)).max() < ROTATION_TOLERANCE
    if not orthonormal or np.linalg.det(rotation) < 0:
        raise StgaError(
            f"{where}: expected a rotation without scale, shear or mirroring in its upper left "
            "3x3 part"
        )
    return matrix


def _numbered(frames: list[Frame]) -> tuple[Frame, ...]:
    """Frames with an index for each camera: that of the same one elsewhere, or the next free."""
    known = {_camera_key(f): f.view.camera_index for f in frames if f.view.camera_index >= 0}
    taken = set(known.values())
    free = (number for number in itertools.count() if number not in taken)
    numbered = []
    for frame in frames:
        if frame.view.camera_index < 0:
            key = _camera_key(frame)
            if key not in known:
                known[key] = next(free)
            frame = replace(frame, view=replace(frame.view, camera_index=known[key]))
        numbered.append(frame)
    return tuple(numbered)


def _camera_key(frame: Frame) -> str | bytes:
    """Identity of a camera: its name, else its pose (the cameras of a rig do not move)."""
    # Adding zero turns -0 into 0, whose bytes differ.
    return frame.camera_id or (np.round(frame.view.camera.world_to_camera, 6) + 0.0).tobytes()
