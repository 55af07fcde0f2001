"""Dense tracking: expression and pose that explain the images by the head's own texture (analysis
by synthesis).

Landmarks fail where faces do most; the skin between them does not. As in Face2Face (Thies et al.
2016), the texture is averaged over cameras and timesteps of the fit so far, and every timestep is
moved by Gauss–Newton until the texture, under that view's lighting, looks like the images.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..capture.model import evenly_spread, parts_of
from ..flame.forward import RIGID_SIZE
from ..worker.helpers import Step
from .appearance import PyramidView, Sample, Texture, Views, average_texture, pyramid, robust
from .dense_head import HELD_OUT_LEVEL, NO_TEXTURE, REGIONS, UPPER_FACE, DenseHead, Misfit
from .fit import (
    HeadFit,
    LandmarkVisibility,
    RecordedTake,
    TimestepLandmarks,
    excerpt,
    landmarks_in_capture,
)
from .posed_points import split
from .solve import Observation, acceleration_precision, normal_equations, prior_terms, smoothed
from .stages import Stage, Workers

MIN_TIMESTEPS = 6
"""Least number of timesteps: an average texture of fewer is no evidence of how timesteps differ."""
SETTLED_WEIGHT = 0.1
"""Least weight of a timestep in the texture of a settled take."""
TEXTURE_TIMESTEPS = 32
"""Timesteps, spread over the take, from which the texture is averaged."""
MAX_CAMERAS = 8
"""Largest number of cameras, spread over the rig, whose images are compared."""
TEXTURE_PART_TIMESTEPS = 12
"""Largest number of the texture's timesteps that are worked on at once."""
PART_TIMESTEPS = 24
"""Largest number of the take's timesteps that are worked on at once."""
LANDMARK_WEIGHT = 0.01
"""Weight of landmarks beside the images."""
INNER_WEIGHT = 0.3
"""The same for landmarks on eyeballs and lids: the texture shows neither reflections nor whether
lid or eyeball is visible."""
REGION_SCALE_M = 0.004
"""Median distance between a region's landmarks and the head at which the region's weight has fallen
to a quarter."""
DISAGREEMENT_M = 0.0015
"""Distance at which a landmark's weight has fallen to a quarter when the fit starts again, beyond
its distance at most timesteps."""
START_STEPS = ((3, 2), (2, 2))
"""(level of the pyramid, Gauss–Newton steps) from every start."""
START_LEVEL = 2
"""Level of the pyramid at which starts are compared."""
FINE_STEPS = ((2, 3), (1, 16), (0, 3))
"""(level, steps) from the best start."""
EVIDENCE_LEVEL = 1
"""Level at which held-out points show whether the fit has become better."""
LAST_STEPS = ((1, 12), (0, 4))
"""(level, steps) from that result where other points are visible than at the start, as in a mouth
that opens."""
LAST_ROUNDS = 2
"""How often LAST_STEPS are taken at most."""
CARRIED_STEPS = ((1, 3), (0, 1))
"""(level, steps) of a timestep that is first moved as its neighbors were."""
CARRIED_FACTOR = 1.25
"""Largest misfit of a region, relative to the neighbors' misfit, for which that is enough."""
OPENINGS_M = 0.008, 0.016
"""How far the chin is moved down for further starts."""
TYPICAL_QUANTILE = 0.2
"""Quantile, over the texture's timesteps, of a region's misfit that is typical."""
TYPICAL_FACTOR = 1.5
"""Misfit of a region of the face, relative to its typical misfit, above which other starts are
tried."""
DAMPING = 1e-3
"""Relative damping of the normal equations' diagonal (Levenberg–Marquardt)."""
CONVERGED_STEP_M = 1e-4
"""Root mean square motion of points in a step, below which a level is done."""
MAX_TURN = 0.3
"""Largest turn of a joint in one step, in radians."""
SETTLED_GAIN = 0.01
"""Least relative fall of a region's misfit for which a settled timestep is changed: below it, the
surface that several cameras see is the better evidence."""
KEPT_STIFFNESS = 100.0
"""Stiffness of a timestep that keeps its parameters, relative to the stiffness over time."""
MIN_REGION_GAIN = 0.1
"""Relative fall of a region's misfit below which its landmarks are the better evidence: a wrinkled
forehead looks a little more like lowered brows than like raised ones."""
MAX_MISS_FACTOR = 1.5
"""Largest factor by which the landmarks' distance from the head may then become larger."""
SMALL_MISS_M = 0.001
"""Additional distance that is allowed beside MAX_MISS_FACTOR."""
MAX_UPPER_MISS_M = 0.01
"""Largest additional distance of the upper face's landmarks: no brow is raised by more."""


@dataclass(frozen=True)
class DenseFit:
    """The fit; landmarks, moved to the fit in regions that disagree with it; and each timestep's
    misfit by region (R,)."""

    fit: HeadFit
    landmarks: Mapping[int, TimestepLandmarks]
    misfit: Mapping[int, np.ndarray]


@dataclass(frozen=True)
class _Shot:
    """Data of a timestep: views, triangulated landmarks, parameters of the fit so far, and the
    regions of the face (R,) in which landmarks are the better evidence."""

    views: Views
    landmarks: Observation
    start: np.ndarray
    by_landmarks: np.ndarray


@dataclass(frozen=True)
class _Solved:
    """Parameters of a timestep, visibility (C, N), Gauss–Newton matrix and right-hand side, misfit
    of the regions (R,), distances of the landmarks (L,), and whether it is better than the
    start."""

    values: np.ndarray
    visible: np.ndarray
    matrix: np.ndarray
    right: np.ndarray
    misfit: np.ndarray
    missed: np.ndarray
    better: bool


def fit_dense(
    fit: HeadFit, take: RecordedTake, workers: Workers, settled: bool = False
) -> DenseFit | None:
    """Expression and pose of every timestep from the images; None where the take is too short for
    it.

    Each timestep starts where the fit is, and where that explains the images badly, where optical
    flow carries its neighbor and with the mouth opened wider. It keeps what it had unless points
    are explained better that were not fitted. Every second one is moved as its neighbors are where
    that explains it as well. Parts of the take are solved at once, by helping processes; no
    timestep has a neighbor in another part.
    settled: the fit is one of images already; every timestep counts in the texture, not only those
    at rest, and the take is followed backwards.
    """
    timesteps = sorted(take.landmarks)
    if len(timesteps) < MIN_TIMESTEPS:
        return None
    chosen = evenly_spread(timesteps, TEXTURE_TIMESTEPS)
    head = DenseHead(fit.head, take)
    total = 2 * len(chosen) + len(timesteps)
    alone = all(len(at_timestep.cameras) == 1 for at_timestep in take.landmarks.values())
    stage = Stage.REFINEMENT if settled else Stage.ONLY_DENSE if alone else Stage.DENSE

    def in_parts(
        work: Callable[..., Any], parts: Sequence[tuple], before: int, keep: bool = False
    ) -> list:
        every = [(*excerpt(fit, take, part), *arguments) for part, *arguments in parts]
        return workers.map(work, every, (stage, before, total), keep)

    weights = head.rest([fit.parameters[t] for t in chosen])
    weights = np.maximum(weights, SETTLED_WEIGHT if settled else 0)
    some = parts_of(chosen, TEXTURE_PART_TIMESTEPS)
    rows = np.split(weights, np.cumsum([len(part) for part in some])[:-1])
    samples = in_parts(_sampled_part, list(zip(some, rows, strict=True)), 0)
    texture = average_texture([sample for part in samples for sample in part])
    started = in_parts(_started_part, [(part, texture) for part in some], len(chosen))
    typical = np.quantile(np.concatenate(started), TYPICAL_QUANTILE, axis=0)
    parts = [(part, texture, typical, settled) for part in parts_of(timesteps, PART_TIMESTEPS)]
    found = in_parts(_solved_part, parts, 2 * len(chosen), keep=True)
    solved = {name: np.concatenate([part[name] for part in found]) for name in found[0]}
    stiffness = acceleration_precision(fit.head.model) if fit.ordered else None
    smooth = smoothed(solved["values"], solved["matrix"], stiffness, solved["right"], fit.head)
    moved = replace(fit, parameters=dict(zip(timesteps, smooth, strict=True)))
    landmarks = _agreeing(head, moved, take, solved["missed"], solved["better"])
    return DenseFit(moved, landmarks, dict(zip(timesteps, solved["misfit"], strict=True)))


def _sampled_part(
    fit: HeadFit, take: RecordedTake, weights: np.ndarray, step: Step
) -> list[Sample]:
    """What the views of a part's timesteps show; weights (T, N) of the points at each."""
    solver = _Solver(fit, take)
    found = []
    for timestep, weight in zip(sorted(take.landmarks), weights, strict=True):
        shot = solver.shot(timestep)
        visible = solver.head.visibility(shot.start, shot.views)
        found += solver.head.samples(shot.views, shot.start, weight * visible)
        step()
    return found


def _started_part(fit: HeadFit, take: RecordedTake, texture: Texture, step: Step) -> np.ndarray:
    """(T, R) misfit by region in coarse images at the fit so far, for the timesteps of a part."""
    solver = _Solver(fit, take, texture)
    found = []
    for timestep in sorted(take.landmarks):
        shot = solver.shot(timestep)
        visible = solver.head.visibility(shot.start, shot.views)
        found.append(solver.started(shot, shot.start, visible)[1].regions)
        step()
    return np.stack(found)


def _solved_part(
    fit: HeadFit,
    take: RecordedTake,
    texture: Texture,
    typical: np.ndarray,
    settled: bool,
    step: Step,
) -> dict[str, np.ndarray]:
    """The timesteps of a part, each solved from the one before, every second one first; name ->
    values of `_Solved` for T timesteps."""
    solver = _Solver(fit, take, texture, SETTLED_GAIN if settled else 0.0)
    timesteps = sorted(take.landmarks, reverse=settled)

    def solve(
        timestep: int, before: tuple[_Shot, _Solved] | None, after: tuple[_Shot, _Solved] | None
    ) -> tuple[_Shot, _Solved]:
        shot = solver.shot(timestep)
        found = solver.carried(shot, before, after) if before and after else None
        found = found or solver.solve(shot, before, typical)
        step()
        return shot, found

    before = solve(timesteps[0], None, None)
    solved = [before[1]]
    for first in range(1, len(timesteps), 2):
        (timestep, *later) = timesteps[first : first + 2]
        after = solve(later[0], before, None) if later else None
        solved.append(solve(timestep, before, after)[1])
        if after is not None:
            solved.append(after[1])
            before = after
    names = ("values", "matrix", "right", "misfit", "missed", "better")
    order = -1 if settled else 1
    return {name: np.stack([getattr(each, name) for each in solved[::order]]) for name in names}


class _Solver:
    """Gauss–Newton at the timesteps of a take."""

    def __init__(
        self, fit: HeadFit, take: RecordedTake, texture: Texture = NO_TEXTURE, min_gain: float = 0.0
    ) -> None:
        self.head = DenseHead(fit.head, take, texture)
        self._fit = fit
        self._take = take
        self._min_gain = min_gain
        self._visibility = LandmarkVisibility(fit.head, take.places)

    def shot(self, timestep: int) -> _Shot:
        """Read a timestep."""
        parameters = self._fit.parameters[timestep]
        world = self._fit.to_capture
        center = self.head.positions(parameters).mean(0)
        views = []
        for recording, image in self._take.images(timestep, MAX_CAMERAS):
            camera = world.camera(recording)
            key = recording.world_to_camera.tobytes()
            views.append(PyramidView(key, camera, pyramid(camera, image, center)))
        weighted = self._visibility.weighted(self._take.landmarks[timestep], parameters, world)
        landmarks = landmarks_in_capture(weighted, self._take, self._fit)
        return _Shot(views, landmarks, parameters, np.zeros(len(REGIONS), bool))

    def solve(
        self, shot: _Shot, before: tuple[_Shot, _Solved] | None, typical: np.ndarray
    ) -> _Solved:
        """The parameters that explain a timestep best, or the start where none are better; before:
        another timestep and its result."""
        visible = self.head.visibility(shot.start, shot.views)
        best, error = self.started(shot, shot.start, visible)
        if (error.regions > TYPICAL_FACTOR * typical).any():
            others = [self.head.opened(shot.start, distance) for distance in OPENINGS_M]
            if before is not None:
                last, solution = before
                start = self.head.flow_start(
                    last.views, solution.visible, solution.values, shot.views
                )
                others.append(start)
            for other in others:
                values, found = self.started(shot, other, visible)
                if found.all < error.all:
                    best = values
                    error = found
        best, visible = self._refined(shot, best)
        while (astray := self._astray(shot, best, visible) & ~shot.by_landmarks).any():
            shot = replace(shot, by_landmarks=shot.by_landmarks | astray)
            best = self._descended(shot, shot.start, visible, START_STEPS)
            best, visible = self._refined(shot, best)
        by_images = np.where(shot.by_landmarks[self.head.region], 0.0, visible)
        old, new = (self._evidence(shot, each, by_images) for each in (shot.start, best))
        better = self._is_better(old, new)
        if better:
            matrix, right, _ = self._terms(shot, best, visible, 0)
        else:
            best = shot.start
            matrix = np.diag(KEPT_STIFFNESS * acceleration_precision(self.head.head.model))
            right = -prior_terms(self.head.head, best)[1]  # which the prior does not move
        missed = self._missed(shot.landmarks, best)
        misfit = self._evidence(shot, best, visible)
        return _Solved(best, visible, matrix, right, misfit.regions, missed, better)

    def carried(
        self, shot: _Shot, before: tuple[_Shot, _Solved], after: tuple[_Shot, _Solved]
    ) -> _Solved | None:
        """The start, moved as its neighbors were moved from their starts, after a few steps; None
        where that is no better than the start, explains some region worse than its neighbors do, or
        leaves its landmarks."""
        moves = [solved.values - near.start for near, solved in (before, after)]
        values = shot.start + np.mean(moves, axis=0)
        visible = self.head.visibility(values, shot.views)
        values = self._descended(shot, values, visible, CARRIED_STEPS)
        misfit, old = (self._evidence(shot, each, visible) for each in (values, shot.start))
        typical = np.maximum(before[1].misfit, after[1].misfit)
        is_typical = (misfit.regions <= CARRIED_FACTOR * typical).all()
        if not (is_typical and self._is_better(old, misfit)):
            return None
        if self._astray(shot, values, visible).any():
            return None
        matrix, right, _ = self._terms(shot, values, visible, 0)
        missed = self._missed(shot.landmarks, values)
        return _Solved(values, visible, matrix, right, misfit.regions, missed, True)

    def _is_better(self, old: Misfit, new: Misfit) -> bool:
        gain = (old.regions - new.regions).max()
        return bool(new.all < old.all and gain > self._min_gain)

    def _evidence(self, shot: _Shot, values: np.ndarray, visible: np.ndarray) -> Misfit:
        """How badly the points that are not fitted are explained."""
        return self.head.misfit(shot.views, visible, values, HELD_OUT_LEVEL, EVIDENCE_LEVEL)

    def _astray(self, shot: _Shot, values: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """(R,) bool: regions whose landmarks are much farther away though the images are not
        clearly better explained; and regions of the upper face that moved farther from their
        landmarks than a face can."""
        both = (shot.start, values)
        astray = np.zeros(len(REGIONS), bool)
        old, new = (self._evidence(shot, parameters, visible).regions for parameters in both)
        missed = [self._missed(shot.landmarks, parameters) for parameters in both]
        for region in range(len(REGIONS)):
            use = (self.head.landmark_region == region) & (shot.landmarks.weight > 0)
            before, after = (float(np.median(miss[use])) if use.any() else 0.0 for miss in missed)
            unproven = new[region] > (1 - MIN_REGION_GAIN) * old[region]
            astray[region] = unproven and after > MAX_MISS_FACTOR * before + SMALL_MISS_M
            astray[region] |= region >= UPPER_FACE and after > before + MAX_UPPER_MISS_M
        return astray

    def _refined(self, shot: _Shot, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Parameters after the steps in fine images, and their visibility (C, N)."""
        visible = self.head.visibility(values, shot.views)
        values = self._descended(shot, values, visible, FINE_STEPS)
        for _ in range(LAST_ROUNDS):
            assumed = visible
            visible = self.head.visibility(values, shot.views)
            if np.array_equal(assumed, visible):
                break
            values = self._descended(shot, values, visible, LAST_STEPS)
        return values, visible

    def started(
        self, shot: _Shot, values: np.ndarray, visible: np.ndarray
    ) -> tuple[np.ndarray, Misfit]:
        """Parameters after the steps in coarse images, and how badly these are explained."""
        values = self._descended(shot, values, visible, START_STEPS)
        return values, self.head.misfit(shot.views, visible, values, START_LEVEL, START_LEVEL)

    def _descended(
        self, shot: _Shot, values: np.ndarray, visible: np.ndarray, plan: Sequence[tuple[int, int]]
    ) -> np.ndarray:
        """Parameters after up to so many damped Gauss–Newton steps in each level of the plan."""
        for level, steps in plan:
            for _ in range(steps):
                matrix, right, jacobian = self._terms(shot, values, visible, level)
                precision, pull = prior_terms(self.head.head, values)
                matrix = matrix + np.diag(precision)
                matrix[np.diag_indices(len(matrix))] *= 1 + DAMPING
                step = np.linalg.solve(matrix, right + pull)
                step = step / max(1.0, np.abs(step[-RIGID_SIZE:-3]).max() / MAX_TURN)
                values = values + step
                if np.sqrt(3 * np.mean((jacobian @ step) ** 2)) < CONVERGED_STEP_M:
                    break
        return values

    def _terms(
        self, shot: _Shot, values: np.ndarray, visible: np.ndarray, level: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Matrix and right-hand side (K + 18,) of images and landmarks, without the prior, and
        derivatives (M, 3, K + 18) of the level's points."""
        _, jacobian = self.head.linearized(values, level)
        by_images = np.where(shot.by_landmarks[self.head.region], 0.0, visible)
        curvature, slope = self.head.photo_term(shot.views, by_images, values, level)
        # a level weighs the same with fewer points
        fraction = len(self.head.rows[0]) / len(jacobian)
        flat = jacobian.reshape(-1, len(values))
        missed = self._missed(shot.landmarks, values)
        weight = shot.landmarks.weight.copy()
        for region in np.flatnonzero(~shot.by_landmarks):
            inside = self.head.landmark_region == region
            if (inside & (weight > 0)).any():  # far from the head, they count less
                weight[inside] *= robust(np.median(missed[inside & (weight > 0)]), REGION_SCALE_M)
            weight[inside] *= np.where(self.head.inner[inside], INNER_WEIGHT, LANDMARK_WEIGHT)
        weighted = replace(shot.landmarks, weight=weight)
        matrix, right = normal_equations(self.head.landmarks, values, weighted)
        matrix = matrix + fraction * flat.T @ (curvature @ jacobian).reshape(flat.shape)
        return matrix, right + fraction * flat.T @ slope.ravel(), jacobian

    def _missed(self, landmarks: Observation, values: np.ndarray) -> np.ndarray:
        """(L,) distance in meters of the landmarks from the head, as far as the cameras determine
        it."""
        at = self.head.landmarks.positions(*split(values))
        away = np.einsum("nij,nj->ni", landmarks.root, at - landmarks.position)
        return np.linalg.norm(away, axis=1)


def _agreeing(
    head: DenseHead, fit: HeadFit, take: RecordedTake, missed: np.ndarray, better: np.ndarray
) -> dict[int, TimestepLandmarks]:
    """The take's landmarks, moved toward the fit in regions where their distance from it is larger
    than at most timesteps.

    missed (T, L), better (T,): of `_Solved` at the take's timesteps.
    """
    regions = [(head.landmark_region == number) & take.reliable for number in range(len(REGIONS))]
    none = np.zeros(len(missed))
    medians = [np.median(missed[:, use], axis=1) if use.any() else none for use in regions]
    by_region = np.stack(medians, axis=1)
    beyond = np.maximum(by_region - np.median(by_region, axis=0), 0) * better[:, None]
    moved = {}
    for timestep, far in zip(sorted(take.landmarks), beyond, strict=True):
        landmarks = take.landmarks[timestep]
        at = head.landmarks.positions(*split(fit.parameters[timestep]))
        weight = robust(far, DISAGREEMENT_M)[head.landmark_region][:, None]
        projected = np.stack(
            [fit.to_capture.camera(camera).project(at)[0] for camera in landmarks.cameras]
        )
        moved[timestep] = replace(
            landmarks, points=weight * landmarks.points + (1 - weight) * projected
        )
    return moved
