"""Continuing a finished run in another folder: refining a region of its avatar, or extending it by
further takes; and the order of the views that this trains."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ...avatar.file import read_avatar
from ...capture.model import Capture, View, evenly_spread, views_by_timestep
from ...capture.selection import visible_pixels
from ...errors import StgaError
from ...files import file_digest
from ...raster.cpu.layout import Parameters
from ...schema import validate
from ..evaluate import metrics
from ..evaluate.metrics import EvaluationView
from ..optimize.state import TrainState, state_of_avatar, with_offsets
from ..schedule import learning_rates, take_order, view_order
from ..settings import TrainingSettings
from .checkpoint import read_checkpoint
from .folder import AVATAR, CHECKPOINT, Continuation, Run

START_FRACTION = 0.5
"""Fraction of the run's schedule of learning rates that has passed when its continuation begins."""
DENSITY_INTERVAL = 40
"""Iterations between density control's steps in a continuation, whose budget is a tenth of a
training's."""
DENSITY_SPAN = (0.0, 0.6)
"""Fractions of the budget between which density control acts."""
MIN_GROUP_VIEWS = 4
"""Evaluation views of a group at least, where it has so many."""
ROUNDING = 1e-5
"""Largest difference between colors that went through the harmonics of the off-axis prior."""


def starting_state(
    continuation: Continuation, settings: TrainingSettings, triangles: int
) -> TrainState:
    """The state with which a continuation begins: the parent's avatar, on a mesh with this number
    of triangles.

    Driven offsets that the settings ask for and the avatar lacks begin at zero. Adam's moments are
    those of the parent's checkpoint if its averaged splats are the avatar's, and zero otherwise.
    Raises StgaError if the avatar has changed since the continuation was started.
    """
    folder = continuation.parent
    if file_digest(folder / AVATAR) != continuation.avatar:
        raise StgaError(
            f"{folder / AVATAR}: has changed since this continuation was started from it"
        )
    avatar = read_avatar(folder / AVATAR).as_trained
    state = state_of_avatar(avatar)
    kept = None
    if (folder / CHECKPOINT).exists():
        kept = read_checkpoint(folder).state
    if kept is not None:
        offsets = {name: offset.average for name, offset in kept.driven_offsets.items()}
        of_avatar = {**vars(avatar.splats), **avatar.driven_offsets}
        limited = replace(avatar, driven_offsets=offsets).with_limited_offsets
        of_checkpoint = {**vars(kept.splats(averaged=True)), **limited.driven_offsets}
        if of_avatar.keys() == of_checkpoint.keys() and all(
            array.shape == of_checkpoint[name].shape
            and np.allclose(array, of_checkpoint[name], rtol=0, atol=ROUNDING)
            for name, array in of_avatar.items()
        ):
            parameters = Parameters(*(array.copy() for array in kept.average))
            screen, count = np.zeros((2, len(kept)), np.float32)
            state = replace(
                kept, parameters=parameters, screen_gradient=screen, gradient_count=count
            )
            for offset in kept.driven_offsets.values():
                offset.value = offset.average.copy()
    return with_offsets(state, settings.driven_offsets, triangles)


def continued_settings(
    settings: TrainingSettings,
    strategy: str,
    growth: float,
    seconds: float | None,
    iterations: int | None,
    seed: int,
) -> TrainingSettings:
    """The settings of a run for its continuation by one of CONTINUATIONS. Raises StgaError for a
    value not allowed.

    Colors that follow the pose begin with the first rate of the run in an extension: other
    expressions strain triangles in directions that the old takes never showed.
    """
    first = settings.rates
    left = 1 - START_FRACTION
    ends = {"position_end": first.position_end**left, "end": first.end**left}
    rates = replace(first, **learning_rates(first, START_FRACTION), **ends)  # from there on
    if strategy == "extend":
        rates = replace(rates, strain_color=first.strain_color)
    continued = replace(
        settings,
        strategy=strategy,
        seconds=seconds,
        iterations=iterations,
        seed=seed,
        rates=rates,
        views_per_visit=1,
        warm_up_share=0.0,
        sh_steps=(0.0,) * settings.sh_degree,
        coarse_share=0.0,
        density_interval=DENSITY_INTERVAL if growth else 0,
        density_span=DENSITY_SPAN,
        growth=growth,
        target_psnr=None,
        stop_when_flat=False,
        tracking=False,
        effects=None,
    )
    validate(continued)
    return continued


def grouped_evaluation_views(
    run: Run, capture: Capture, region: np.ndarray | None
) -> list[EvaluationView]:
    """At most MAX_EVALUATION_VIEWS of the held-out views, evenly spread; of a run of several takes,
    or one that continues another, in groups: by take, or frames that are refined and others.

    region (F,) bool: its visible pixels become the views' region "region"; None but for a
    refinement.
    """
    groups: dict[str, list[View]] = {}
    for view in capture.views.get("val", ()):
        continuation = run.continuation
        if continuation is None or run.settings.strategy == "extend":
            group = f"take_{1 + run.take_at(view.timestep)}"
        else:
            group = "frames" if continuation.includes(view.timestep) else "other_frames"
        groups.setdefault(group, []).append(view)
    limit = max(MIN_GROUP_VIEWS, metrics.MAX_EVALUATION_VIEWS // max(1, len(groups)))
    chosen = []
    background = run.settings.background
    backdrop = run.settings.backdrop
    for name, members in groups.items():
        for view in evenly_spread(members, limit):
            found = metrics.read_evaluation_view(capture, view, background, backdrop)
            found = replace(found, group=name if len(groups) > 1 else "")
            pixels = np.zeros(0) if region is None else visible_pixels(capture, view, region)
            if pixels.sum() >= metrics.MIN_REGION_PIXELS:
                found = replace(found, regions={**found.regions, "region": pixels})
            chosen.append(found)
    return chosen


REPLAY_FRACTION = 1 / 3
"""Fraction of a refinement's iterations that train views outside its frames, if any."""
REPLAY_TIMESTEPS = 12
"""Timesteps that are replayed: those that differ most from each other."""
REPLAY_VIEWS = 120
"""Replayed at most; cameras take turns from timestep to timestep. Fewer would be overfitted."""
MAX_CANDIDATES = 200
"""Evenly spread, of which replayed timesteps are chosen: long takes are not read as a whole."""
MIN_REGION_FRACTION = 0.3
"""A view refines a region if it sees this fraction of what the view that sees most does."""


def continued_order(
    continuation: Continuation,
    capture: Capture,
    region: np.ndarray | None,
    seed: int,
    start: int = 0,
) -> Iterator[View]:
    """Endless order of views from position `start` on: of the continuation's frames and, in turn or
    now and then, of others.

    region (F,) bool: what is refined, by views that see much of it. None for an extension, which
    trains the views of all takes.
    """
    views = capture.views["train"]
    asked = [view for view in views if continuation.includes(view.timestep)]
    rest = [view for view in views if not continuation.includes(view.timestep)]
    if region is None:
        yield from take_order([asked, rest] if rest else [asked], 1, seed, start)
        return
    parts = (asked, replayed_views(capture, rest))
    asked, others = (views_of_region(capture, members, region) for members in parts)
    fraction = REPLAY_FRACTION if others else 0.0
    replayed = [int(position * fraction) for position in (start, start + 1)]
    new = view_order(asked, 1, seed, start - replayed[0])
    old = view_order(others, 1, seed + 1, replayed[0]) if others else new
    position = start
    while True:
        yield next(old) if int((position + 1) * fraction) > int(position * fraction) else next(new)
        position += 1


def replayed_views(capture: Capture, views: Sequence[View]) -> list[View]:
    """At most REPLAY_VIEWS views: some cameras each of the timesteps that differ most."""
    by_timestep = views_by_timestep(views)
    chosen = distinct_timesteps(capture, sorted(by_timestep))
    kept = []
    cameras = max(1, REPLAY_VIEWS // max(1, len(chosen)))
    for turn, timestep in enumerate(chosen):
        members = sorted(by_timestep[timestep], key=lambda view: view.camera_index)
        steps = np.linspace(0, len(members), min(cameras, len(members)), endpoint=False).astype(int)
        kept += [members[(step + turn) % len(members)] for step in steps]
    return kept


def distinct_timesteps(
    capture: Capture, timesteps: Sequence[int], count: int = REPLAY_TIMESTEPS
) -> list[int]:
    """At most `count`: the most neutral one, then always the one farthest from those chosen."""
    if len(timesteps) <= count:
        return list(timesteps)
    candidates = evenly_spread(timesteps, MAX_CANDIDATES)
    meshes = np.stack(
        [capture.expression_mesh(timestep, "head").astype(np.float32) for timestep in candidates]
    )
    chosen = [int(np.argmin(_distance(meshes, capture.neutral)))]
    nearest = _distance(meshes, meshes[chosen[0]])
    while len(chosen) < min(count, len(candidates)):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, _distance(meshes, meshes[chosen[-1]]))
    return [candidates[n] for n in chosen]


def _distance(meshes: np.ndarray, mesh: np.ndarray) -> np.ndarray:
    """(T,) root mean square distance of vertices."""
    return np.sqrt(np.square(meshes - mesh.astype(np.float32)).sum(-1).mean(-1))


def views_of_region(capture: Capture, views: Sequence[View], region: np.ndarray) -> list[View]:
    """In which the region (F,) bool is seen large: turned to the camera, whatever covers it."""
    areas = np.array([_facing_area(capture, view, region) for view in views])
    large = [area >= MIN_REGION_FRACTION * areas.max() > 0 for area in areas]
    return [view for view, is_large in zip(views, large, strict=True) if is_large]


def is_faced(capture: Capture, views: Sequence[View], region: np.ndarray) -> bool:
    """Whether `views_of_region` finds any view; looks at views only until it does."""
    return any(_facing_area(capture, view, region) > 0 for view in views)


def _facing_area(capture: Capture, view: View, region: np.ndarray) -> float:
    """Pixels that the region's triangles facing the camera cover."""
    mesh = capture.mesh(view.timestep)
    corners, depth = view.camera.project(mesh)
    triangles = capture.faces[region]
    a, b, c = (corners[triangles[:, n]] for n in range(3))
    doubled = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    # Counter-clockwise seen from outside, and so clockwise in pixels, whose y points down: a
    # negative area.
    facing = (doubled < 0) & (depth[triangles] > 0).all(1)
    return float(-doubled[facing].sum() / 2)
