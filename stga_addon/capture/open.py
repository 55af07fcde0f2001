"""Opening a capture folder of any layout."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from os.path import isdir, isfile  # which are False, not an error, for a path that is too long
from pathlib import Path

import numpy as np

from ..errors import StgaError, shorten
from .camera import Camera
from .flame_capture import CANONICAL_NAME, PARAMETERS, open_flame_capture, open_flame_motion
from .mesh_capture import is_release, mesh_files, open_mesh_capture, open_mesh_folder, open_release
from .model import Capture, View, evenly_spread
from .transforms import (
    DEFAULT_PRINCIPAL_POINT,
    PRINCIPAL_POINTS,
    SPLITS,
    Frame,
    Transforms,
    has_transforms,
    read_splits,
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
