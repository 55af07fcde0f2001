"""Order of the views that a continued run trains: those asked for and, now and then, a few of all others."""

from collections.abc import Iterator, Sequence

import numpy as np

from ...capture.model import Capture, View, evenly_spread
from ..schedule import view_order
from .folder import Continuation

REPLAY_SHARE = 1 / 3
"""Share of a refinement's iterations that train views outside the continuation's frames, where there are any."""
EXTEND_REPLAY_SHARE = 0.4
"""Share of an extension's iterations that train views of the old takes."""
REPLAY_TIMESTEPS = 12
"""Timesteps that are replayed: those that differ most from each other."""
REPLAY_VIEWS = 120
"""Views that are replayed at most; the cameras take turns from timestep to timestep. Fewer would be overfitted."""
MAX_CANDIDATES = 200
"""Timesteps among which the replayed ones are chosen, evenly spread: long takes are not read as a whole."""
MIN_REGION_SHARE = 0.3
"""A view refines a region if it sees at least this share of what the view that sees most of it sees."""


def continued_order(
    continuation: Continuation,
    capture: Capture,
    region: np.ndarray | None,
    seed: int,
    start: int = 0,
) -> Iterator[View]:
    """Endless order of views from position `start` on: of the continuation's frames and, now and then, of others.

    region (F,) bool: what is refined, by views that see much of it. None for an extension.
    """
    views = capture.views["train"]
    asked = [view for view in views if continuation.includes(view.timestep)]
    others = replayed_views(capture, [view for view in views if not continuation.includes(view.timestep)])
    if region is not None:
        asked, others = (views_of_region(capture, members, region) for members in (asked, others))
    share = (EXTEND_REPLAY_SHARE if region is None else REPLAY_SHARE) if others else 0.0
    replayed = [int(position * share) for position in (start, start + 1)]
    new = view_order(asked, 1, seed, start - replayed[0])
    old = view_order(others, 1, seed + 1, replayed[0]) if others else new
    position = start
    while True:
        yield next(old) if int((position + 1) * share) > int(position * share) else next(new)
        position += 1


def replayed_views(capture: Capture, views: Sequence[View], limit: int = REPLAY_VIEWS) -> list[View]:
    """At most `limit` of the views: some cameras each of the timesteps whose expressions differ most."""
    by_timestep: dict[int, list[View]] = {}
    for view in views:
        by_timestep.setdefault(view.timestep, []).append(view)
    chosen = distinct_timesteps(capture, sorted(by_timestep))
    kept, cameras = [], max(1, limit // max(1, len(chosen)))
    for turn, timestep in enumerate(chosen):
        members = sorted(by_timestep[timestep], key=lambda view: view.camera_index)
        steps = np.linspace(0, len(members), min(cameras, len(members)), endpoint=False).astype(int)
        kept += [members[(step + turn) % len(members)] for step in steps]
    return kept


def distinct_timesteps(capture: Capture, timesteps: Sequence[int], count: int = REPLAY_TIMESTEPS) -> list[int]:
    """At most `count` timesteps: the most neutral one, then always the one farthest from all chosen so far."""
    if len(timesteps) <= count:
        return list(timesteps)
    candidates = evenly_spread(timesteps, MAX_CANDIDATES)
    meshes = np.stack([capture.expression_mesh(timestep, "head").astype(np.float32) for timestep in candidates])
    chosen = [int(np.argmin(_distance(meshes, capture.neutral)))]
    nearest = _distance(meshes, meshes[chosen[0]])
    while len(chosen) < min(count, len(candidates)):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, _distance(meshes, meshes[chosen[-1]]))
    return [candidates[n] for n in chosen]


def _distance(meshes: np.ndarray, mesh: np.ndarray) -> np.ndarray:
    """(T,) root mean square distance of vertices."""
    return np.asarray(np.sqrt(np.square(meshes - mesh.astype(np.float32)).sum(-1).mean(-1)))


def views_of_region(capture: Capture, views: Sequence[View], region: np.ndarray) -> list[View]:
    """The views in which the region (F,) bool is seen large: turned to the camera, whatever may cover it."""
    seen = np.array([_facing_area(capture, view, region) for view in views])
    return [view for view, area in zip(views, seen, strict=True) if area >= MIN_REGION_SHARE * seen.max() > 0]


def is_faced(capture: Capture, views: Sequence[View], region: np.ndarray) -> bool:
    """Whether `views_of_region` finds any view; looks at views only until it does."""
    return any(_facing_area(capture, view, region) > 0 for view in views)


def _facing_area(capture: Capture, view: View, region: np.ndarray) -> float:
    """Pixels that the region's triangles facing the camera cover."""
    mesh = np.asarray(capture.mesh(view.timestep))
    corners, depth = view.camera.project(mesh)
    triangles = capture.faces[region]
    a, b, c = (corners[triangles[:, n]] for n in range(3))
    doubled = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    # Counter-clockwise seen from outside, and so clockwise in pixels, whose y points down: a negative area.
    facing = (doubled < 0) & (depth[triangles] > 0).all(1)
    return float(-doubled[facing].sum() / 2)
