"""A capture in memory, whatever its layout on disk; its summary."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..errors import StgaError
from ..flame.sequence import FlameSequence
from .camera import Camera
from .lens import Undistortion

Item = TypeVar("Item")
"""Type of the items that a function is given and returns."""

FPS_LIMIT = 1000.0
"""Frame rates are below it."""


@dataclass(frozen=True)
class View:
    """One image: a camera at a timestep. `name` is its `file_path` with forward slashes;
    `undistortion` leads from the recorded image to that of `camera`, None where that is the same;
    is_mask_inverted: its file holds 255 outside. is_as_stored: EXIF's orientation is ignored, as
    the program did that calibrated the camera.
    """

    timestep: int
    camera_index: int
    camera: Camera
    name: str
    image: Path
    mask: Path | None = None
    undistortion: Undistortion | None = None
    is_mask_inverted: bool = False
    is_as_stored: bool = False


Views = Mapping[str, tuple[View, ...]]
"""Views by their split, "train", "val" or "test"."""
ViewExposure = Callable[[View], np.ndarray | None]
"""View -> gain and offset (2, 3), in levels, of red, green and blue; None where not known."""


@dataclass(frozen=True)
class Capture:
    """A multi-view recording with a tracked mesh of constant topology per timestep.

    faces      (F, 3) int32, shared by all timesteps
    neutral    (V, 3) float64 meters: the canonical mesh (expression and pose zero)
    views      by their split; empty for a bare mesh sequence
    timesteps  all timesteps that have a mesh, ascending
    regions    key region name -> (F,) bool
    mesh       timestep -> (V, 3) float64, the tracked mesh in world space, read on demand
    expression_mesh  (timestep, zero_pose) -> (V, 3) float64 without rigid head motion (STGA,
                     selective training)
    flame      the parameters and model behind the meshes, for FLAME captures
    flame_file the model's file; None without one
    given_selection  timestep -> (F,) bool where the capture comes with a selection
    warnings   one sentence each
    repair     name of the repair with which the mesh would fit its images; None where it fits
    fps        timesteps per second, counted by their numbers: with 60, timestep 30 was recorded 0.5
               s after timestep 0, also where those between are missing; None where unknown
    """

    root: Path
    layout: str
    faces: np.ndarray
    neutral: np.ndarray
    views: Views
    timesteps: tuple[int, ...]
    regions: Mapping[str, np.ndarray]
    mesh: Callable[[int], np.ndarray]
    expression_mesh: Callable[[int, str], np.ndarray]
    flame: FlameSequence | None = None
    flame_file: Path | None = None
    given_selection: Mapping[int, np.ndarray] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    repair: str | None = None
    fps: float | None = None

    @property
    def all_views(self) -> list[View]:
        """Views of every split, in the splits' order."""
        return [view for views in self.views.values() for view in views]

    def flame_motion(self, name: str = "") -> FlameSequence:
        """`flame`. Raises StgaError, beginning with `name` or the folder's, where there is none."""
        if self.flame is None:
            lacks = "so it has no parameters of identity, expression and pose"
            raise StgaError(f"{name or self.root}: was not tracked with FLAME, {lacks}")
        return self.flame


def views_by_timestep(views: Iterable[View]) -> dict[int, list[View]]:
    """The views of each timestep, in the order of the views."""
    found: dict[int, list[View]] = {}
    for view in views:
        found.setdefault(view.timestep, []).append(view)
    return found


def views_by_camera(views: Iterable[View]) -> dict[int, list[View]]:
    """The views of each camera, in the order of the views."""
    found: dict[int, list[View]] = {}
    for view in views:
        found.setdefault(view.camera_index, []).append(view)
    return found


def evenly_spread(items: Sequence[Item], limit: int) -> list[Item]:
    """At most `limit` of the items: the first, the last, and those evenly between."""
    if len(items) <= limit:
        return list(items)
    return [items[n] for n in np.linspace(0, len(items) - 1, limit).round().astype(int)]


def cameras_at_once(views: Iterable[View]) -> int:
    """Most cameras that show one timestep. A phone is one also where it took several takes, from
    other places: they do not show together how far away anything is."""
    together = views_by_timestep(views).values()
    return max((len(views_by_camera(simultaneous)) for simultaneous in together), default=0)


def parts_of(timesteps: Sequence[int], limit: int) -> list[list[int]]:
    """Consecutive parts of at most `limit` timesteps, the same on every machine; at least one."""
    count = max(1, -(-len(timesteps) // limit))
    return [part.tolist() for part in np.array_split(np.array(timesteps), count)]


def summarize_capture(capture: Capture) -> list[tuple[str, str]]:
    """(label, value) lines: recording, tracking, warnings. Reads no image."""
    views = capture.all_views
    sizes = sorted({(view.camera.width, view.camera.height) for view in views})
    masked = sum(view.mask is not None for view in views)
    splits = []
    for name, split in capture.views.items():
        timesteps = {view.timestep for view in split}
        cameras = {view.camera_index for view in split}
        counts = f"{len(timesteps)} timesteps, {len(cameras)} cameras"
        splits += [f"{name} {len(split)} views ({counts})"] if split else []
    recorded = [
        ("cameras", format_ranges(sorted({view.camera_index for view in views}))),
        ("image size", ", ".join(f"{width} x {height}" for width, height in sizes)),
        ("masks", f"{masked} of {len(views)} views"),
        ("splits", "; ".join(splits)),
    ]
    bare = [("cameras", "none: can be imported and animated, not trained on")]
    regions = [
        f"{name} {int(np.count_nonzero(region))}" for name, region in capture.regions.items()
    ]
    lines = [("folder", str(capture.root)), ("layout", capture.layout)]
    lines += [*(recorded if views else bare), ("timesteps", format_ranges(capture.timesteps))]
    if capture.fps is not None:
        lines.append(("frame rate", f"{capture.fps:g} frames per second"))
    lines += [
        ("mesh", f"{len(capture.neutral)} vertices, {len(capture.faces)} triangles"),
        ("regions", ", ".join(regions) + " triangles" if regions else "none"),
    ]
    fractions = [float(np.mean(selected)) for selected in capture.given_selection.values()]
    if fractions:
        fraction = f"{np.mean(fractions):.1%} of the triangles on average"
        lines.append(("given selection", f"{len(fractions)} timesteps, {fraction}"))
    if capture.flame is not None:
        first = capture.flame.frame(capture.flame.timesteps[0])
        offsets = (("static", capture.flame.static_offset), ("dynamic", first.dynamic_offset))
        for name, offset in offsets:
            size = 0.0 if offset is None else 1000 * float(np.linalg.norm(offset, axis=1).max())
            lines.append((f"{name} offset", "none" if offset is None else f"up to {size:.1f} mm"))
    return lines + [("warning", warning) for warning in capture.warnings]


def format_ranges(numbers: Sequence[int]) -> str:
    """Ascending whole numbers as count, ranges and gaps: "5: 0–2, 6–7 (gap 3–5)"."""
    starts = [n for i, n in enumerate(numbers) if i == 0 or numbers[i - 1] != n - 1]
    ends = [n for i, n in enumerate(numbers) if i == len(numbers) - 1 or numbers[i + 1] != n + 1]

    def spans(firsts: Sequence[int], lasts: Sequence[int]) -> str:
        pairs = zip(firsts, lasts, strict=True)
        return ", ".join(str(a) if a == b else f"{a}–{b}" for a, b in pairs)

    gaps = spans([end + 1 for end in ends[:-1]], [start - 1 for start in starts[1:]])
    several = "gaps" if len(starts) > 2 else "gap"
    return f"{len(numbers)}: {spans(starts, ends)}" + (f" ({several} {gaps})" if gaps else "")
