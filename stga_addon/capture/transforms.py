"""Cameras and frames: `transforms_{train,val,test}.json` or `transforms.json`."""

import itertools
import math
import posixpath
import re
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from ..errors import StgaError, shorten
from ..files import is_file, read_json
from ..schema import MAX_NAME_BYTES
from .camera import MAX_COORDINATE_M, MAX_FOCAL_PIXELS, Camera, camera_from_gl, is_image_size
from .model import FPS_LIMIT, Item, View, Views

SPLITS = ("train", "val", "test")
"""Splits of a capture: training views, the held-out camera, the held-out expressions."""
WHOLE_FILE = "transforms.json"
"""File of a capture without splits, all of whose views are training views."""
SPLIT_FILES = {s: f"transforms_{s}.json" for s in SPLITS}
"""Split -> its file."""
PRINCIPAL_POINTS = ("vhap", "opencv", "center")
"""Choices of what a file's cx and cy mean (`read_transforms`)."""
DEFAULT_PRINCIPAL_POINT = PRINCIPAL_POINTS[0]
"""Choice where the user makes none: VHAP's, cy from the bottom."""

ROTATION_TOLERANCE = 1e-3
"""Exporters write float32 poses, some rounded to a few decimals."""
MAX_NUMBER = sys.float_info.max
"""JSON does not limit whole numbers."""
MIN_ANGLE = 1e-9
"""Least angle of view in radians; half of it still has a tangent."""
INDEX_LIMIT = 1 << 31
"""Timesteps and camera indices are below it, to fit into int32."""
MAX_PATH_CHARACTERS = 2000
"""Longest path that a file may name."""
MATRIX = "a 4x4 matrix of finite numbers"
"""What a message says that `transform_matrix` must be."""

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
"""Suffixes of images, in the order in which a path without one is looked for."""
VIDEO_SUFFIXES = (
    *(".mp4", ".mov", ".mkv", ".avi", ".m4v", ".webm", ".mts", ".m2ts", ".ts", ".mxf", ".mpg"),
    *(".mpeg", ".m2v", ".vob", ".wmv", ".asf", ".flv", ".f4v", ".3gp", ".3g2", ".ogv", ".dv"),
    ".gif",
)
"""Suffixes of videos that are read."""
TIMESTEP_KEYS = ("timestep_index", "keyframe")
"""VHAP writes timestep_index, the STGA authors' release keyframe."""
READ_PATHS = ("file_path", "fg_mask_path", "mask_path", "mesh_path", "flame_param_path")
"""Paths of a frame that are read."""
TOP_PATHS = ("canonical_mesh_path", "regions_path", "ply_file_path")
"""Paths at the top level that are read; nerfstudio's points are of no use."""
NUMBERED = "without timestep_index, timesteps are the numbers of the tracked files"
SCALED = "the scale of transform_matrix was left out"


@dataclass(frozen=True)
class Record:
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
        value = self.number(key, -1, INDEX_LIMIT)
        if value % 1:
            raise StgaError(f"{self.where(key)}: expected a whole number, not {value:g}")
        return int(value)

    def path_of(self, key: str) -> Path | None:
        value = self.values.get(key)
        if value is None:
            return None
        if not isinstance(value, str):
            raise StgaError(f"{self.where(key)}: expected a relative path, not {shorten(value)}")
        return inside(self.folder, value, self.where(key))


@dataclass(frozen=True)
class Frame:
    """One entry of a transforms file.

    principal  (cx, cy) in pixels as written in the file; the image center where they are missing
    camera_id  name of the camera in the file, or None
    mesh, flame  file of the tracked mesh or FLAME parameters of the frame's timestep, or None
    record     the entry, with the fields of the top level
    repairs    what was read in another way than it is written, in a few words each
    """

    view: View
    principal: tuple[float, float]
    camera_id: str | None
    mesh: Path | None
    flame: Path | None
    record: Record
    repairs: tuple[str, ...] = ()

    @property
    def where(self) -> str:
        """File and entry, with which messages begin."""
        return self.record.where("").rstrip(".")


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
    """All frames by split, and the fields of the top level, None where it is missing."""

    splits: dict[str, tuple[Frame, ...]]
    canonical_mesh: Path | None
    regions: Path | None
    fps: float | None = None

    @property
    def frames(self) -> tuple[Frame, ...]:
        return tuple(frame for split in self.splits.values() for frame in split)

    @property
    def views(self) -> Views:
        return {
            split: tuple(frame.view for frame in frames) for split, frames in self.splits.items()
        }


def transforms_files(folder: Path) -> list[Path]:
    """The folder's transforms files: the whole one, and those of splits."""
    files = (folder / name for name in (WHOLE_FILE, *SPLIT_FILES.values()))
    return [path for path in files if is_file(path)]


def read_transforms(
    path: Path, principal_point: str = DEFAULT_PRINCIPAL_POINT, moved: bool = False
) -> tuple[Frame, ...]:
    """Read the frames of one transforms file. Images and tracked files are not opened, and need not
    exist.

    Intrinsics of a frame take precedence over those of the top level, which are wrong in some
    exports. `transform_matrix` is camera-to-world with OpenGL axes. Paths are relative to the
    file's folder, and may leave it only for a sibling folder (union sets of VHAP). Raises StgaError
    naming the file and the field.

    principal_point  what `cy` means: "vhap" (H − cy from the top, as VHAP's exporter writes it),
                     "opencv" (from the top), or "center" (cx and cy are ignored, as in
                     GaussianAvatars)
    moved            the file was moved: an image whose path leads outside is searched for in the
                     file's folder, by what follows the last ".." or by its name
    """
    return _numbered(_timed(_read_frames(path, read_json(path), principal_point, moved)))


def read_splits(folder: Path, principal_point: str = DEFAULT_PRINCIPAL_POINT) -> Transforms:
    """Read every split of a capture folder, as `read_transforms` does; `transforms.json` alone is
    all training. Cameras without `camera_index` are numbered alike in all splits. Raises
    StgaError."""
    names = {split: name for split, name in SPLIT_FILES.items() if (folder / name).is_file()}
    frames = dict[str, list[Frame]]()
    meshes = []
    regions = []
    rates = []
    for split, name in (names or {"train": WHOLE_FILE}).items():
        path = folder / name
        values = read_json(folder / name)
        frames[split] = _read_frames(path, values, principal_point)
        record = Record(path, folder.resolve(), "", values)
        meshes.append(record.path_of("canonical_mesh_path"))
        regions.append(record.path_of("regions_path"))
        rates.append(record.number("fps", 0, FPS_LIMIT) if record.has("fps") else None)
    numbered = iter(_numbered(_timed([frame for split in frames.values() for frame in split])))
    counts = {split: len(frames.get(split, ())) for split in SPLITS}
    splits = {split: tuple(itertools.islice(numbered, n)) for split, n in counts.items()}

    def first(values: list[Item | None]) -> Item | None:
        return next((value for value in values if value is not None), None)

    return Transforms(splits, first(meshes), first(regions), first(rates))


def with_principal_point(camera: Camera, written: tuple[float, float], convention: str) -> Camera:
    """The camera with the principal point that the file's (cx, cy) mean (`read_transforms`)."""
    if convention == "center":
        return replace(camera, cx=camera.width / 2, cy=camera.height / 2)
    cx, cy = written
    return replace(camera, cx=cx, cy=camera.height - cy if convention == "vhap" else cy)


def repairs(frames: Sequence[Frame]) -> tuple[str, ...]:
    """Sentences about what was repaired, each of which names the first of the frames."""
    counts = Counter(repair for frame in frames for repair in frame.repairs)
    found = []
    for repair, count in counts.items():
        first = next(frame for frame in frames if repair in frame.repairs)
        found.append(f"{first.where}: {repair} (in {count} of {len(frames)} frames)")
    return tuple(found)


def tracked_files(frames: Iterable[Frame], field: str) -> dict[int, Path]:
    """timestep -> its tracked file, ascending; `field` is "mesh" or "flame". Raises StgaError where
    a frame has none, or where two frames of a timestep name different ones."""
    files: dict[int, Path] = {}
    key = "mesh_path" if field == "mesh" else "flame_param_path"
    for frame in frames:
        path = getattr(frame, field)
        timestep = frame.view.timestep
        if path is None:
            raise StgaError(
                f"{frame.where}.{key}: is missing; expected the tracked file of timestep {timestep}"
            )
        if files.setdefault(timestep, path) != path:
            raise StgaError(
                f"{frame.where}.{key}: is {path}, but timestep {timestep} already has "
                f"{files[timestep]}"
            )
    return dict(sorted(files.items()))


def inside(root: Path, relative: str, where: str) -> Path:
    """Resolve a path of a capture's file against the folder `root` of that file. `..` may lead to a
    sibling of `root`, not further; symbolic links inside the capture are followed. Raises
    StgaError, beginning with `where`, for absolute paths and for those that lead outside."""
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


def _read_frames(path: Path, values: Any, principal_point: str, moved: bool = False) -> list[Frame]:
    if not isinstance(values, dict) or not isinstance(values.get("frames"), list):
        raise StgaError(f"{path}: frames: expected a list with one entry per image")
    shared = Record(path, path.parent.resolve(), "", values)
    timed = any(_timestep_key(entry) for entry in values["frames"] if isinstance(entry, dict))
    cameras: dict[tuple[bytes | float, ...], tuple[Camera, bool]] = {}
    frames = []
    for number, entry in enumerate(values["frames"]):
        if not isinstance(entry, dict):
            raise StgaError(f"{path}: frames[{number}]: expected an object, not {shorten(entry)}")
        record = replace(shared, place=f"frames[{number}].", values=entry)
        image = _image_path(record, moved)
        where = record.where
        if image is None:
            raise StgaError(f"{where('file_path')}: is missing; expected the path of the image")
        image = _with_suffix(image)
        key = _timestep_key(entry)
        if timed and key is None:
            raise StgaError(f"{where('timestep_index')}: is missing, though other frames have it")
        size = width, height = _image_size(record, shared, image)
        written = _principal(record, shared, "cx", width), _principal(record, shared, "cy", height)
        focal = _focal(record, shared, width, height)
        try:
            matrix = np.array(entry["transform_matrix"], np.float64)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise StgaError(f"{where('transform_matrix')}: expected {MATRIX}") from error
        known = matrix.tobytes(), *size, *focal, *written  # most frames share a camera
        if known not in cameras:
            rigid, is_scaled = _pose(record, matrix)
            camera = camera_from_gl(rigid, size, focal, written)
            camera = with_principal_point(camera, written, principal_point)
            cameras[known] = camera, is_scaled
        camera, is_scaled = cameras[known]
        timestep = record.natural(key) if key else 0
        index = record.natural("camera_index") if record.has("camera_index") else -1
        name = entry["file_path"].replace("\\", "/")  # files are named after views
        mask = record.path_of("fg_mask_path") or record.path_of("mask_path")  # nerfstudio's
        mask = None if mask is None else _with_suffix(mask)
        view = View(timestep, index, camera, name, image, mask)
        camera_id = str(entry["camera_id"]) if record.has("camera_id") else None
        mesh = record.path_of("mesh_path")
        flame = record.path_of("flame_param_path")
        whole = replace(record, values=values | entry)
        repairs = (SCALED,) if is_scaled else ()
        frames.append(Frame(view, written, camera_id, mesh, flame, whole, repairs))
    return frames


def _with_suffix(path: Path) -> Path:
    """The image that a path names without its suffix, as Blender's NeRF exporters write it; .png
    where there is none."""
    if path.suffix.lower() in IMAGE_SUFFIXES or (path.suffix and is_file(path)):
        return path
    named = [path.with_name(path.name + suffix) for suffix in IMAGE_SUFFIXES]
    named += [path.with_name(path.name + suffix.upper()) for suffix in IMAGE_SUFFIXES]
    found = next((each for each in named if is_file(each)), None)
    return found or (path if path.suffix else named[0])


def _timestep_key(values: dict[str, Any]) -> str | None:
    """The key of the timestep, None without one."""
    return next((key for key in TIMESTEP_KEYS if values.get(key) is not None), None)


def _image_path(record: Record, moved: bool) -> Path | None:
    """The image of an entry. moved: of paths of another computer, and from the folder in which a
    program ran, what is behind their last "..", or the name."""
    try:
        return record.path_of("file_path")
    except StgaError:
        text = record.values["file_path"]
        if not moved or not isinstance(text, str):
            raise
        path = PureWindowsPath(text)  # which takes either slash
        inside_of = path.parts if not path.is_absolute() and not path.anchor else path.parts[-1:]
        behind = [part for part in inside_of if part != ".."]
        return inside(record.folder, "/".join(behind), record.where("file_path"))


def _principal(record: Record, shared: Record, key: str, size: int) -> float:
    """One coordinate of the principal point as written; the image's center where there is none."""
    source = record if record.has(key) else shared
    if not source.has(key):
        return size / 2
    return source.number(key, low=-MAX_FOCAL_PIXELS, high=MAX_FOCAL_PIXELS)


def _image_size(record: Record, shared: Record, image: Path) -> tuple[int, int]:
    source = next((s for s in (record, shared) if s.has("w") and s.has("h")), None)
    if source is None:
        if not is_file(image):
            raise StgaError(
                f"{record.where('w')}: w and h are missing, and so is the image {image} to "
                "take them from"
            )
        try:
            from .images import image_size
        except ImportError as error:
            raise StgaError(
                f"{record.where('w')}: w and h are missing; to take them from the image needs "
                "Pillow, which Blender lacks: write them"
            ) from error
        return image_size(image)
    width = source.number("w", low=0)
    height = source.number("h", low=0)
    if not is_image_size(width, height):
        raise StgaError(
            f"{source.where('w')}: expected an image size in pixels, not {width:g} x {height:g}"
        )
    return int(width), int(height)


def _focal(record: Record, shared: Record, width: int, height: int) -> tuple[float, float]:
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


def _pose(record: Record, matrix: np.ndarray) -> tuple[np.ndarray, bool]:
    """(4, 4) rotation and translation, of a matrix that may lack its last row or be written in one
    line; and whether its axes were scaled, as those of an object in Blender may be."""
    where = record.where("transform_matrix")
    if matrix.shape == (16,):
        matrix = matrix.reshape(4, 4)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0, 0, 0, 1]])
    finite = matrix.shape == (4, 4) and np.isfinite(matrix).all()
    if not finite or not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise StgaError(f"{where}: expected {MATRIX} that ends in the row 0 0 0 1")
    if np.abs(matrix).max() > MAX_COORDINATE_M:
        raise StgaError(
            f"{where}: the camera lies farther than {MAX_COORDINATE_M:g} from the origin"
        )
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    is_scaled = bool(lengths.min() > 0 and np.abs(lengths - 1).max() >= ROTATION_TOLERANCE / 2)
    if is_scaled:
        matrix = matrix / np.append(lengths, 1.0)
    rotation = matrix[:3, :3]
    orthonormal = np.abs(rotation @ rotation.T - np.eye(3)).max() < ROTATION_TOLERANCE
    if not orthonormal or np.linalg.det(rotation) < 0:
        raise StgaError(
            f"{where}: expected a rotation without shear or mirroring in its upper left 3x3 part"
        )
    return matrix, is_scaled


def _timed(frames: Sequence[Frame]) -> list[Frame]:
    """Frames without any timestep by their tracked files: the numbers that the names end in, or the
    files' order. Monocular trackers, such as INSTA's, write an image and a mesh a frame so."""
    tracked = [frame.mesh or frame.flame for frame in frames]
    files = list(dict.fromkeys(path for path in tracked if path is not None))
    written = any(frame.record.has(key) for frame in frames for key in TIMESTEP_KEYS)
    if written or len(files) < 2 or None in tracked:
        return list(frames)
    numbers = [re.search(r"\d{1,9}$", path.stem, re.ASCII) for path in files]
    number_of = {path: int(found[0]) for path, found in zip(files, numbers, strict=True) if found}
    if len(set(number_of.values())) < len(files):
        number_of = {path: number for number, path in enumerate(files)}
    timed = []
    for frame, path in zip(frames, tracked, strict=True):
        view = replace(frame.view, timestep=number_of[path] if path is not None else 0)
        timed.append(replace(frame, view=view, repairs=(*frame.repairs, NUMBERED)))
    return timed


def transforms_warnings(frames: Sequence[Frame], principal_point: str) -> list[str]:
    """Sentences about what was repaired, about a principal point that may be another, and about
    files that the frames name and nobody reads; each names the first of the transforms files."""
    found = list(repairs(frames))
    doubtful = [f for f in frames if NUMBERED in f.repairs and f.view.mask is None]
    height = doubtful[0].view.camera.height if doubtful else 0
    if principal_point == "vhap" and doubtful and abs(2 * doubtful[0].principal[1] - height) > 1:
        found.append(
            f"{doubtful[0].where}: cy is counted from the bottom, as VHAP writes it; if "
            "another program wrote it, give --principal-point opencv"
        )
    unread = dict[str, Frame]()
    for frame in frames:
        for key in frame.record.values:
            if key.endswith("_path") and key not in (*READ_PATHS, *TOP_PATHS):
                unread.setdefault(key, frame)
    if unread:
        names = ", ".join(unread)
        where = next(iter(unread.values())).where
        found.append(f"{where}: not read: {names:.200}; a mask is named by fg_mask_path")
    return found


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
