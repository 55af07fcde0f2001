"""Several takes of one head as one capture."""

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import accumulate
from typing import TypeVar

import numpy as np

from ..errors import StgaError
from ..flame.sequence import FlameSequence
from .model import Capture, View, evenly_spread

MAX_NEUTRAL_DIFFERENCE_M = 1e-4
"""Largest distance between the neutral meshes of two takes of one head: trackers write rounded shape coefficients."""
MAX_SCALE_FACTOR = 5.0
"""Largest ratio of the head's sizes in two takes; another unit than the meter makes it 10 or more."""
COMPARED = 8
"""Views, and timesteps, of a take whose scale is looked at."""

RATE_TOLERANCE = 0.01
"""Relative difference up to which the frame rates of takes are the same."""

T = TypeVar("T")


def join_takes(takes: Sequence[Capture]) -> Capture:
    """One capture of all takes: the timesteps of each follow those of the take before.

    A timestep of take n becomes `first_timesteps(takes)[n]` + timestep, and the first take keeps its own. Neutral mesh
    and regions are the first take's. A camera of a later take keeps its index where the first take has the same
    camera under it, so that exposure is corrected alike. The frame rate is the one of all takes that have one, None
    where they differ. Raises StgaError where the takes are not of one head.
    """
    first = takes[0]
    if len(takes) == 1:
        return first
    for other in takes[1:]:
        require_same_head(first, other)
    starts = first_timesteps(takes)
    views: dict[str, tuple[View, ...]] = {}
    for take, start in zip(takes, starts, strict=True):
        free = _first_free_index(take, start, first, views)
        for split, members in take.views.items():
            views[split] = (*views.get(split, ()), *_shifted(members, start, first, free))
    flame = [take.flame for take in takes]
    numbered = list(zip(takes, starts, strict=True))

    def expression_mesh(timestep: int, zero_pose: str) -> np.ndarray:
        return _dispatch([_posed(take, zero_pose) for take in takes], starts)(timestep)

    return replace(
        first,
        views=views,
        timesteps=tuple(start + timestep for take, start in numbered for timestep in take.timesteps),
        mesh=_dispatch([take.mesh for take in takes], starts),
        expression_mesh=expression_mesh,
        flame=_joined_sequence([each for each in flame if each is not None], starts) if all(flame) else None,
        given_selection={
            start + timestep: faces for take, start in numbered for timestep, faces in take.given_selection.items()
        },
        warnings=tuple(dict.fromkeys(warning for take in takes for warning in take.warnings)),
        fps=_common_rate([take.fps for take in takes if take.fps is not None]),
    )


def first_timesteps(takes: Sequence[Capture]) -> list[int]:
    """What is added to the timesteps of each take in `join_takes`."""
    lengths = (max(take.timesteps, default=0) + 1 for take in takes[:-1])
    return list(accumulate(lengths, initial=0))


def require_same_head(first: Capture, other: Capture) -> None:
    """Raise StgaError where `other` has another mesh, or another neutral shape, than `first`."""
    if not np.array_equal(first.faces, other.faces):
        raise StgaError(
            f"{other.root}: its mesh has other triangles than {first.root}; a take must be of the same head"
        )
    distance = float(np.linalg.norm(first.neutral - other.neutral, axis=1).max())
    if distance > MAX_NEUTRAL_DIFFERENCE_M:
        raise StgaError(
            f"{other.root}: its neutral mesh is up to {1000 * distance:.2g} mm from that of {first.root}; "
            "a take must be of the same head, tracked with the same shape"
        )


def _common_rate(rates: Sequence[float]) -> float | None:
    """None where there are none, or differences of more than 1 %."""
    return rates[0] if rates and max(rates) <= (1 + RATE_TOLERANCE) * min(rates) else None


def require_same_scale(first: Capture, other: Capture) -> None:
    """Raise StgaError where `other`, a take of the same head, has meshes or cameras in another unit of length.

    Its tracked meshes must be as large as the neutral one, and the head must take a similar share of the images.
    """
    posed = [_extent(other.mesh(timestep)) for timestep in evenly_spread(other.timesteps, COMPARED)]
    factor = float(np.median(posed)) / _extent(other.neutral)
    if not 1 / MAX_SCALE_FACTOR <= factor <= MAX_SCALE_FACTOR:
        raise StgaError(
            f"{other.root}: its tracked meshes are {factor:.3g} times as large as the neutral mesh; expected meters"
        )
    factor = _share_of_images(first) / _share_of_images(other)
    if not 1 / MAX_SCALE_FACTOR <= factor <= MAX_SCALE_FACTOR:
        apart = f"{factor:.3g} times smaller" if factor > 1 else f"{1 / factor:.3g} times larger"
        raise StgaError(
            f"{other.root}: its head appears {apart} in the images than in those of {first.root}; "
            "expected cameras and tracking in meters"
        )


def _extent(vertices: np.ndarray) -> float:
    """Meters along the longest axis."""
    return float(np.ptp(vertices, axis=0).max())


def _share_of_images(take: Capture) -> float:
    """Size of the head in pixels by that of the image, the median of some training views."""
    shares = []
    for view in evenly_spread(take.views["train"], COMPARED):
        camera, mesh = view.camera, take.mesh(view.timestep)
        distance = float(np.linalg.norm(mesh.mean(0) - camera.position))
        shares.append(camera.fl_x * _extent(mesh) / (distance * max(camera.width, camera.height)))
    return float(np.median(shares))


def _first_free_index(take: Capture, start: int, first: Capture, joined: Mapping[str, Sequence[View]]) -> int:
    """What is added to the indices of a take's own cameras, so that none is that of a camera in `joined`.

    Where possible it counts from the take's start: the identities of runs hold these indices.
    """
    taken = {view.camera_index for members in joined.values() for view in members}
    free = 1 + start + max((view.camera_index for members in first.views.values() for view in members), default=-1)
    collides = any(free + view.camera_index in taken for members in take.views.values() for view in members)
    return 1 + max(taken) if collides else free


def _shifted(views: Sequence[View], start: int, first: Capture, free: int) -> list[View]:
    """The views at the joined timesteps; `free` is added to indices of cameras that the first take does not have."""
    cameras = {view.camera_index: view.camera for members in first.views.values() for view in members}
    shifted = []
    for view in views:
        known, camera = cameras.get(view.camera_index), view.camera
        same = known is not None and np.allclose(known.world_to_camera, camera.world_to_camera, atol=1e-6)
        index = view.camera_index if start == 0 or same else free + view.camera_index
        shifted.append(replace(view, timestep=start + view.timestep, camera_index=index))
    return shifted


def _posed(take: Capture, zero_pose: str) -> Callable[[int], np.ndarray]:
    return lambda timestep: take.expression_mesh(timestep, zero_pose)


def _dispatch(functions: Sequence[Callable[[int], T]], starts: Sequence[int]) -> Callable[[int], T]:
    """timestep of the joined capture -> what the function of its take says about its own timestep."""

    def of(timestep: int) -> T:
        take = bisect_right(starts, timestep) - 1
        return functions[take](timestep - starts[take])

    return of


def _joined_sequence(sequences: Sequence[FlameSequence], starts: Sequence[int]) -> FlameSequence:
    timesteps = tuple(s + t for sequence, s in zip(sequences, starts, strict=True) for t in sequence.timesteps)
    return replace(sequences[0], timesteps=timesteps, frame=_dispatch([each.frame for each in sequences], starts))
