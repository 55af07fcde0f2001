"""Several takes of one head as one capture."""

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..errors import StgaError
from .model import Capture, View, Views, evenly_spread, views_by_camera
from .open import open_capture

Item = TypeVar("Item")
"""Type of what a function of a timestep returns."""
RATE_TOLERANCE = 0.01
"""Relative difference up to which the frame rates of takes are the same."""
MAX_NEUTRAL_DIFFERENCE_M = 1e-4
"""Largest distance between neutral meshes of takes of one head: trackers write rounded shape
coefficients."""
MAX_SCALE_FACTOR = 5.0
"""Largest ratio of the head's sizes in two takes; another unit makes it 10 or more."""
COMPARED = 8  # Number of views, and of timesteps, by which a take's scale is judged


def further_takes(
    paths: Sequence[Path], before: Sequence[Capture], flame: Path | None, principal_point: str
) -> list[Capture]:
    """Captures that join those before them. Raises StgaError where one is of another head or scale,
    has no training views or is there already."""
    new = list[Capture]()
    for path in paths:
        take = open_capture(path, flame, principal_point)
        require_same_head(before[0], take)
        if not take.views.get("train"):
            raise StgaError(
                f"{take.root}: has no training views, so there is nothing to extend the avatar with"
            )
        require_same_scale(before[0], take)
        if any(take.root == old.root for old in before):
            raise StgaError(f"{take.root}: is a take of this run already")
        if any(take.root == other.root for other in new):
            raise StgaError(f"{take.root}: is given twice; expected each take once")
        new.append(take)
    return new


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
