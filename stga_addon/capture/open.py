"""Opening a capture folder of any layout."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from os.path import isdir, isfile  # which are False, not an error, for a path that is too long
from pathlib import Path

import numpy as np

from ..errors import StgaError, shorten
from ..files import read_json, read_npy
from .camera import Camera
from .flame_capture import CANONICAL_NAME, PARAMETERS, open_flame_capture, open_flame_motion
from .mesh_geometry import without_head_motion
from .meshes import MESH_SUFFIXES, checked_mesh, read_mesh, read_regions, tracked_meshes
from .model import Capture, View, evenly_spread
from .transforms import (
    DEFAULT_PRINCIPAL_POINT,
    PRINCIPAL_POINTS,
    SPLITS,
    Frame,
    Transforms,
    has_transforms,
    read_splits,
    tracked_files,
    with_principal_point,
)

MIN_HEAD_EXTENT_M, TYPICAL_HEAD_EXTENT_M, MAX_HEAD_EXTENT_M = 0.05, 0.3, 3.0
"""Largest extent of a neutral mesh: outside of these, its unit is probably not the meter."""

MAX_COMPARED_VIEWS = 4
MIN_SHARE_DIFFERENCE = 0.01  # of the vertices


def open_capture(folder: Path, flame: Path | None = None, principal_point: str = DEFAULT_PRINCIPAL_POINT) -> Capture:
    """Open a capture: cameras and file names now, images and tracked meshes when they are asked for.

    An .npz file in place of a folder is a FLAME motion: a capture without views.

    Layouts: "flame" (VHAP and GaussianAvatars; needs the model file `flame`), "mesh" (`mesh_path` per frame, or a
    bare folder of meshes, which has no views) and "release" (STGA's authors). `principal_point` as in
    `read_transforms`; `Capture.warnings` says where the masks fit another one better.
    Raises StgaError in one sentence naming file, field and what was expected, also for any image, mask or tracked
    file that is missing.
    """
    if principal_point not in PRINCIPAL_POINTS:
        raise StgaError(
            f"principal point convention {shorten(principal_point)} is not one of {', '.join(PRINCIPAL_POINTS)}"
        )
    if folder.suffix.lower() == ".npz" and isfile(folder):
        return open_flame_motion(folder.resolve(), flame)
    if not isdir(folder):
        raise StgaError(f"{folder}: is not a folder; expected that of a capture")
    root = folder.resolve()
    transforms = read_splits(root, principal_point) if has_transforms(root) else Transforms({}, None, None)
    views = {split: tuple(frame.view for frame in frames) for split, frames in transforms.splits.items()}
    _require_files(transforms)
    capture = _open_layout(root, transforms, views, flame)
    found = (principal_point_warning(transforms.frames, capture.mesh, principal_point), _size_warning(capture))
    return replace(
        capture, fps=transforms.fps, warnings=(*capture.warnings, *(warning for warning in found if warning))
    )


def _size_warning(capture: Capture) -> str | None:
    """Limits, thresholds and the near plane are in meters: a head in millimeters cannot be trained."""
    size = float(np.ptp(capture.neutral, axis=0).max()) if len(capture.neutral) else 0.0
    if MIN_HEAD_EXTENT_M <= size <= MAX_HEAD_EXTENT_M:
        return None
    return f"{capture.root}: the neutral mesh measures {size:.3g} m; expected a head of {TYPICAL_HEAD_EXTENT_M} m"


def _open_layout(
    root: Path, transforms: Transforms, views: Mapping[str, tuple[View, ...]], flame: Path | None
) -> Capture:
    frames = transforms.frames
    if (root / CANONICAL_NAME).is_file() or any(frame.flame for frame in frames):
        return open_flame_capture(root, transforms, views, flame)
    if any(frame.mesh for frame in frames):
        return open_mesh_capture(root, transforms, views)
    if is_release(root):
        return open_release(root, views)
    if not transforms.splits and mesh_files(root):
        return open_mesh_folder(root)
    if not transforms.splits and (root / PARAMETERS).is_dir():
        return open_flame_capture(root, transforms, views, flame)
    if transforms.splits:
        expected = "a frame with flame_param_path or mesh_path in the transforms"
    else:
        expected = f"transforms_{'|'.join(SPLITS)}.json, transforms.json or meshes"
    raise StgaError(f"{root}: is not a capture; expected {expected}")


def _require_files(transforms: Transforms) -> None:
    """Raise StgaError for a missing file now rather than an hour into the training."""
    seen: set[Path] = set()
    for frame in transforms.frames:
        for field, path in _files(frame).items():
            if path is not None and path not in seen:
                if not isfile(path):
                    raise StgaError(f"{path}: does not exist, but {frame.where} names it as its {field}")
                seen.add(path)


def _files(frame: Frame) -> dict[str, Path | None]:
    return {
        "file_path": frame.view.image,
        "fg_mask_path": frame.view.mask,
        "mesh_path": frame.mesh,
        "flame_param_path": frame.flame,
    }


def principal_point_warning(frames: Sequence[Frame], mesh: Callable[[int], np.ndarray], chosen: str) -> str | None:
    """A warning where another convention puts clearly more of the mesh inside the masks, else None.

    Checks a few views in which the conventions differ. Only vertices outside of a mask count: hair and shoulders lie
    inside the mask but beside the mesh. Without Pillow, which Blender lacks, nothing is checked.
    Raises StgaError where a mask cannot be read.
    """
    if find_spec("PIL") is None:
        return None
    apart = [frame for frame in frames if _conventions_differ(frame)]
    outside = [_shares_outside(frame, mesh) for frame in evenly_spread(apart, MAX_COMPARED_VIEWS)]
    known = [shares for shares in outside if shares is not None]
    if not known:
        return None
    share = dict(zip(PRINCIPAL_POINTS, np.mean(known, axis=0).tolist(), strict=True))
    best = min(share, key=lambda convention: share[convention])
    if share[chosen] < 2 * share[best] + MIN_SHARE_DIFFERENCE:
        return None
    return (
        f"{share[chosen]:.1%} of the mesh falls outside the masks with the principal point read as {chosen!r}, "
        f"but {share[best]:.1%} with {best!r}: the capture was probably written that way"
    )


def _cameras(frame: Frame) -> list[Camera]:
    return [with_principal_point(frame.view.camera, frame.principal, name) for name in PRINCIPAL_POINTS]


def _conventions_differ(frame: Frame) -> bool:
    points = np.array([(camera.cx, camera.cy) for camera in _cameras(frame)])
    return bool((np.ptp(points, axis=0) > 0.5).any())


def _shares_outside(frame: Frame, mesh: Callable[[int], np.ndarray]) -> list[float] | None:
    """Share of the vertices outside the mask under each convention, or None without a mask."""
    from .images import read_mask

    mask = read_mask(frame.view)
    if mask is None:
        return None
    points = mesh(frame.view.timestep)
    return [_share_outside(points, camera, mask) for camera in _cameras(frame)]


def _share_outside(points: np.ndarray, camera: Camera, mask: np.ndarray) -> float:
    pixels, depth = camera.project(points)
    column, row = np.floor(np.clip(pixels, -1, [camera.width, camera.height])).astype(int).T
    visible = (depth > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    inside = mask[row[visible], column[visible]] > 127
    return 1 - float(inside.sum()) / len(points)


NEUTRAL_NAMES = ("neutral", "canonical")
REGIONS_NAME = "regions.json"


def open_mesh_capture(root: Path, transforms: Transforms, views: Mapping[str, tuple[View, ...]]) -> Capture:
    """Capture of layout "mesh": `mesh_path` per frame, `canonical_mesh_path` and `regions_path` at the top level.

    Only the canonical mesh is read now, the others when they are needed. Raises StgaError.
    """
    files = tracked_files(transforms.frames, "mesh")
    return _mesh_capture(root, files, transforms.canonical_mesh, transforms.regions, views)


def open_mesh_folder(root: Path) -> Capture:
    """Capture of layout "mesh" without views: a folder of meshes, one a timestep.

    Timesteps are the numbers at the end of the names, or the alphabetical order where a name has none. A mesh called
    `neutral` or `canonical` is the canonical one, and `regions.json` the regions file. Raises StgaError.
    """
    meshes = mesh_files(root)
    canonical = next((path for path in meshes if path.stem.lower() in NEUTRAL_NAMES), None)
    tracked = [path for path in meshes if path != canonical]
    if not tracked:
        raise StgaError(f"{root}: holds no tracked mesh besides {canonical}; expected one file per timestep")
    regions = root / REGIONS_NAME
    return _mesh_capture(root, _by_number(tracked), canonical, regions if regions.is_file() else None, {})


def mesh_files(folder: Path) -> list[Path]:
    """The meshes directly in a folder, by name."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in MESH_SUFFIXES and path.is_file())


def rigid_free(mesh: Callable[[int], np.ndarray], neutral: np.ndarray) -> Callable[[int, str], np.ndarray]:
    """`Capture.expression_mesh` for meshes without parameters, which ignores the choice of zero pose."""
    return lambda timestep, zero_pose: without_head_motion(mesh(timestep), neutral)


def _mesh_capture(
    root: Path,
    files: dict[int, Path],
    canonical: Path | None,
    regions_file: Path | None,
    views: Mapping[str, tuple[View, ...]],
) -> Capture:
    warnings = []
    if canonical is None:
        canonical = files[min(files)]
        warnings.append(f"no canonical mesh is given: {canonical.name}, the first timestep, is the neutral mesh")
    neutral, faces = read_mesh(canonical)
    if any(path.suffix.lower() == ".stl" for path in (canonical, *files.values())):
        warnings.append("STL has no shared vertices: of the topology, only the number of triangles can be checked")
    regions = {} if regions_file is None else read_regions(regions_file, faces, len(neutral))
    empty = [name for name, members in regions.items() if not members.any()]
    if empty:
        warnings.append(f"{regions_file}: no triangle lies in {', '.join(empty)}")
    mesh = tracked_meshes(files, len(neutral), faces, canonical, read_mesh)
    return Capture(
        root=root,
        layout="mesh",
        faces=faces,
        neutral=neutral,
        views=views,
        timesteps=tuple(files),
        regions=regions,
        mesh=mesh,
        expression_mesh=rigid_free(mesh, neutral),
        warnings=tuple(warnings),
    )


def _by_number(paths: list[Path]) -> dict[int, Path]:
    numbers = [re.search(r"(\d+)$", path.stem, re.ASCII) for path in paths]
    numbered = {int(match[1]): path for match, path in zip(numbers, paths, strict=True) if match}
    return dict(sorted(numbered.items())) if len(numbered) == len(paths) else dict(enumerate(paths))


def is_release(root: Path) -> bool:
    """Whether the folder holds `meshes/mesh_*.json`."""
    return next((root / "meshes").glob("mesh_*.json"), None) is not None


def open_release(root: Path, views: Mapping[str, tuple[View, ...]]) -> Capture:
    """Capture of layout "release": `meshes/mesh_%04d.json` and `training_faces/%04d.npy` by `keyframe`.

    The layout names neither a neutral mesh nor regions. Raises StgaError naming the file and the field.
    """
    timesteps = sorted({view.timestep for split in views.values() for view in split})
    files = {timestep: root / "meshes" / f"mesh_{timestep:04d}.json" for timestep in timesteps}
    if not files:
        raise StgaError(f"{root}: its transforms hold no frame; expected a keyframe for each mesh in {root / 'meshes'}")
    canonical = files[timesteps[0]]
    neutral, faces = read_soup(canonical)
    mesh = tracked_meshes(files, len(neutral), faces, canonical, read_soup)
    chosen = {timestep: root / "training_faces" / f"{timestep:04d}.npy" for timestep in timesteps}
    return Capture(
        root=root,
        layout="release",
        faces=faces,
        neutral=neutral,
        views=views,
        timesteps=tuple(timesteps),
        regions={},
        mesh=mesh,
        expression_mesh=rigid_free(mesh, neutral),
        given_selection={t: read_face_ids(path, len(faces)) for t, path in chosen.items() if path.is_file()},
        warnings=(f"the layout has no canonical mesh: {canonical.name}, the first timestep, is the neutral mesh",),
    )


def read_soup(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (3F, 3) and triangles (F, 3) from {"triangles": [{"Vertices": [[x, y, z], …]}, …]}, meters.

    The layout has no shared vertices. Raises StgaError naming the file and the field.
    """
    document = read_json(path)
    try:
        corners = np.array([triangle["Vertices"] for triangle in document["triangles"]], np.float64)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise StgaError(f"{path}: triangles: expected a list of objects with Vertices, three points each") from error
    if corners.ndim != 3 or corners.shape[1:] != (3, 3):
        raise StgaError(f"{path}: triangles: expected three Vertices with three coordinates each in every triangle")
    return checked_mesh(path, corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def read_face_ids(path: Path, faces: int) -> np.ndarray:
    """(F,) bool from a npy file of triangle numbers. Raises StgaError where they are no whole numbers below `faces`."""
    ids = read_npy(path)
    if ids.dtype.kind not in "iu" or ids.ndim != 1:
        raise StgaError(f"{path}: expected a list of triangle numbers")
    if ids.size and not 0 <= int(ids.min()) <= int(ids.max()) < faces:
        raise StgaError(f"{path}: names triangles {ids.min()} to {ids.max()}, but the mesh has 0 to {faces - 1}")
    selected = np.zeros(faces, bool)
    selected[ids] = True
    return selected
