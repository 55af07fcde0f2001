"""A capture in memory, whatever its layout on disk; its summary; several takes as one capture."""

from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
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
RATE_TOLERANCE = 0.01
"""Relative difference up to which the frame rates of takes are the same."""
MAX_NEUTRAL_DIFFERENCE_M = 1e-4
"""Largest distance between neutral meshes of takes of one head: trackers write rounded shape
coefficients."""
MAX_SCALE_FACTOR = 5.0
"""Largest ratio of the head's sizes in two takes; another unit makes it 10 or more."""
COMPARED = 8  # Number of views, and of timesteps, by which a take's scale is judged


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


def join_takes(takes: Sequence[Capture]) -> Capture:
    """One capture of all takes: the timesteps of each follow those of the take before.

    A timestep of take n becomes `first_timesteps(takes)[n]` + timestep, and the first take keeps
    its own. Neutral mesh and regions are the first take's. A camera of a later take keeps its index
    where the first take has the same camera under it, so that exposure is corrected alike. The
    frame rate is the one of all takes that have one, None where they differ. Raises StgaError where
    the takes are not of one head.
    """
    first = takes[0]
    if len(takes) == 1:
        return first
    for other in takes[1:]:
        require_same_head(first, other)
    starts = first_timesteps(takes)
    views = dict[str, tuple[View, ...]]()
    selected: dict[int, np.ndarray] = {}
    numbered = list(zip(takes, starts, strict=True))
    for take, start in numbered:
        taken = {view.camera_index for members in views.values() for view in members}
        for split, members in _renumbered(take, start, first, taken).items():
            views[split] = (*views.get(split, ()), *members)
        selected |= {start + timestep: faces for timestep, faces in take.given_selection.items()}
    timesteps = tuple(start + timestep for take, start in numbered for timestep in take.timesteps)
    flame = [take.flame for take in takes if take.flame is not None]
    frame = _dispatch([each.frame for each in flame], starts)
    whole = replace(flame[0], timesteps=timesteps, frame=frame) if flame else None
    rates = [take.fps for take in takes if take.fps is not None]
    return replace(
        first,
        views=views,
        timesteps=timesteps,
        mesh=_dispatch([take.mesh for take in takes], starts),
        expression_mesh=_dispatch([take.expression_mesh for take in takes], starts),
        flame=whole if len(flame) == len(takes) else None,
        given_selection=selected,
        warnings=tuple(dict.fromkeys(warning for take in takes for warning in take.warnings)),
        fps=rates[0] if rates and max(rates) <= (1 + RATE_TOLERANCE) * min(rates) else None,
    )


def first_timesteps(takes: Sequence[Capture]) -> list[int]:
    """What is added to the timesteps of each take in `join_takes`."""
    lengths = (max(take.timesteps, default=0) + 1 for take in takes[:-1])
    return list(accumulate(lengths, initial=0))


def require_same_head(first: Capture, other: Capture) -> None:
    """Raise StgaError where `other` has another mesh, or another neutral shape, than `first`."""
    same = "a take must be of the same head"
    if not np.array_equal(first.faces, other.faces):
        raise StgaError(f"{other.root}: its mesh has other triangles than {first.root}; {same}")
    distance = float(np.linalg.norm(first.neutral - other.neutral, axis=1).max())
    if distance > MAX_NEUTRAL_DIFFERENCE_M:
        apart = f"up to {1000 * distance:.2g} mm from that of {first.root}"
        same += ", tracked with the same shape"
        raise StgaError(f"{other.root}: its neutral mesh is {apart}; {same}")


def require_same_scale(first: Capture, other: Capture) -> None:
    """Raise StgaError where `other`, a take of the same head, has meshes or cameras in another unit
    of length. Its tracked meshes must be as large as the neutral one, and the head must take a
    similar fraction of the images."""
    posed = [_extent(other.mesh(timestep)) for timestep in evenly_spread(other.timesteps, COMPARED)]
    factor = float(np.median(posed)) / _extent(other.neutral)
    if not 1 / MAX_SCALE_FACTOR <= factor <= MAX_SCALE_FACTOR:
        raise StgaError(
            f"{other.root}: its tracked meshes are {factor:.3g} times as large as the neutral "
            "mesh; expected meters"
        )
    factor = _fraction_of_images(first) / _fraction_of_images(other)
    if not 1 / MAX_SCALE_FACTOR <= factor <= MAX_SCALE_FACTOR:
        apart = f"{factor:.3g} times smaller" if factor > 1 else f"{1 / factor:.3g} times larger"
        apart += f" in the images than in those of {first.root}"
        raise StgaError(
            f"{other.root}: its head appears {apart}; expected cameras and tracking in meters"
        )


def _extent(vertices: np.ndarray) -> float:
    """Meters along the longest axis."""
    return float(np.ptp(vertices, axis=0).max())


def _fraction_of_images(take: Capture) -> float:
    """Size of the head in pixels by that of the image, the median of some training views."""
    fractions = []
    for view in evenly_spread(take.views["train"], COMPARED):
        camera = view.camera
        mesh = take.mesh(view.timestep)
        distance = float(np.linalg.norm(mesh.mean(0) - camera.position))
        fractions.append(
            camera.fl_x * _extent(mesh) / (distance * max(camera.width, camera.height))
        )
    return float(np.median(fractions))


def _renumbered(take: Capture, start: int, first: Capture, taken: set[int]) -> Views:
    """The views at the joined timesteps. Their cameras keep an index under which the first take has
    the same; others are counted from the take's start, as the identities of runs hold them, or
    above all that are `taken`."""
    if start == 0:
        return take.views
    poses = {view.camera_index: view.camera.world_to_camera for view in first.all_views}
    cameras = views_by_camera(take.all_views)
    free = 1 + start + max(poses, default=-1)
    if any(free + index in taken for index in cameras):
        free = 1 + max(taken)

    def moved(view: View) -> View:
        pose = poses.get(view.camera_index)
        index = free + view.camera_index
        if pose is not None and np.allclose(pose, view.camera.world_to_camera, atol=1e-6):
            index = view.camera_index
        return replace(view, timestep=start + view.timestep, camera_index=index)

    return {split: tuple(map(moved, members)) for split, members in take.views.items()}


def _dispatch(
    functions: Sequence[Callable[..., Item]], starts: Sequence[int]
) -> Callable[..., Item]:
    """timestep of the joined capture -> what its take's function says about its own."""

    def of(timestep: int, *rest: str) -> Item:
        take = bisect_right(starts, timestep) - 1
        return functions[take](timestep - starts[take], *rest)

    return of
