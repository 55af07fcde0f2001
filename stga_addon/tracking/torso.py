"""The torso's motion: whether the body below the head turns with the head, is still, or moves
independently.

Landmarks of a face cannot distinguish the neck's rotation from the head's, so that a tracked head
and the ring of shoulders that its neck ends in turn as one. Here the root joint, which carries that
ring, gets the orientation that explains the images below the head best; the neck turns back by as
much, and the head stays where it was tracked. Skin between both is blended by the model's own
weights. Where that leaves much unexplained, because shoulders were lifted or a chin was pushed
forward, the torso is shifted as well; and its cloth bends, where that explains more.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..capture.model import evenly_spread
from ..flame.forward import RIGID_SIZE, axis_angle_matrices, cross_matrices
from ..flame.model import torso_faces
from ..worker.helpers import Step
from . import appearance, torso_take
from .appearance import NOISE_LEVELS, flow_weights, point_weights, projection_derivative, sampled
from .fit import HeadFit, posed_mesh
from .folder import TorsoMotion, TorsoPoints
from .footage.model import Footage
from .stages import Stage, Workers
from .surface import with_offset
from .torso_cloth import Bending, found_bending
from .torso_take import NECK, Motion, PosedTorso, TorsoPose, TorsoTake, axis_angle, head_turn

MIN_TIMESTEPS = 4
"""Timesteps without which there is no motion to distinguish."""
MAX_CAMERAS = 4
"""Cameras, spread over the rig, whose images are compared."""
TIE = 1e-3
"""Difference in the trace of rotations that time decides."""
MIN_POINTS = 200
"""Points of all cameras together without which the torso is not visible."""
START_LEVEL = 2
"""Level of the pyramid in which starts are compared."""
COARSE_STEPS = ((3, 3), (2, 3))
"""Levels of the pyramid and Gauss–Newton steps in each, for every start."""
FINE_STEPS = ((1, 4), (0, 2))
"""The same for the best start."""
CHANGE_SIGMA_RAD = 0.1
"""Standard deviation of the torso's rotation from one timestep to the next."""
CHANGE_SIGMA_M = 0.01
"""Standard deviation of the torso's shift from one timestep to the next."""
# Radians, meters
MAX_STEP = 0.15
"""Largest step of a motion's parameters, in radians or meters."""
CONVERGED_STEP = 1e-4
"""Step below which the motion has converged."""
COMPARED_TIMESTEPS = 24
"""Timesteps, spread over the take, at which motions are compared; depths are found at some of
them."""
MIN_GAIN = 0.1
"""Fraction by which the misfit has to fall for the torso not to move with the head."""
MIN_MOTION_GAIN = 0.05
"""Fraction by which it has to fall for the torso to move instead of being still, or to be shifted
as well."""

Plan = Sequence[tuple[int, int]]


@dataclass(frozen=True)
class FollowedTorso:
    """A take's heads with their torsos.

    fit         the head; a torso that bends is drawn over the surface that cameras see
    parameters  timestep -> (E + 18,)
    offsets     timestep -> vertex offsets (V, 3) that shift and bend the torso; empty where it is
                not shifted
    motion      how it was decided; None where that is not known
    points      where the torso's surface is seen; None where it rides on the head
    """

    fit: HeadFit
    parameters: Mapping[int, np.ndarray]
    offsets: Mapping[int, np.ndarray] = field(default_factory=dict)
    motion: TorsoMotion | None = None
    points: TorsoPoints | None = None

    def mesh(self, timestep: int) -> np.ndarray:
        """Vertices (V, 3) of a timestep in the capture's world, in meters."""
        return posed_mesh(self.fit, self.parameters[timestep], self.offsets.get(timestep))


def follow_torso(
    fit: HeadFit,
    parameters: Mapping[int, np.ndarray],
    footage: Footage,
    workers: Workers,
    bends: bool = True,
) -> FollowedTorso:
    """The torso's motion in a take of heads whose parameters (E + 18,) are given by timestep.

    The torso turns about the neck's joint; the head is not moved. Parameters are returned as they
    are where the torso rides on the head, and where its motion is not known: without masks, in
    takes shorter than MIN_TIMESTEPS, of models without a neck, and where little of a torso is seen.
    bends: whether cloth may; the model is drawn over it then.
    """
    unchanged = dict(parameters)
    model = fit.head.model
    if len(parameters) < MIN_TIMESTEPS or not fit.head.joints[NECK] or not torso_faces(model).any():
        return FollowedTorso(fit, unchanged)
    # The timestep with the head's most average turn, where the torso is taken to be straight; of a
    # head that does not turn, the middle of the take
    turns = np.stack([head_turn(parameters[timestep]) for timestep in sorted(parameters)])
    late = np.abs(np.linspace(-1, 1, len(turns)))
    mean = ((turns * turns.mean(0)).sum((1, 2)) - TIE * late).argmax()
    middle = sorted(parameters)[int(mean)]
    some = evenly_spread(sorted(unchanged), COMPARED_TIMESTEPS)
    present = [camera for camera in footage.cameras if middle in camera.timesteps]
    masked = [camera for camera in present if camera.mask(middle) is not None]
    take = TorsoTake(fit, unchanged, evenly_spread(masked, MAX_CAMERAS))
    observed = torso_take.observed_points(take, middle)
    if sum(map(len, observed.rows.values())) < MIN_POINTS:
        return FollowedTorso(fit, unchanged)
    walk = torso_take.BothWays(workers, Stage.TORSO, 3 * len(some) + len(unchanged))
    motions = _motions(take, observed, some, walk)
    deep = torso_take.at_depth(take, observed, motions)
    found = torso_take.compared(take, deep, motions, some)
    independent = (
        "shifted" if found["shifted"] < (1 - MIN_MOTION_GAIN) * found["turned"] else "turned"
    )
    misfit = {"head": found["head"], "still": found["still"], "own": found[independent]}
    # what explains the images best; a simpler motion unless the gain is clear
    motion = "own" if misfit["own"] < (1 - MIN_MOTION_GAIN) * misfit["still"] else "still"
    motion = motion if misfit[motion] < (1 - MIN_GAIN) * misfit["head"] else "head"
    decided = TorsoMotion(motion, misfit, 0.0)
    if motion == "head":
        return FollowedTorso(fit, unchanged, motion=decided)
    name = independent if motion == "own" else motion
    posed = _everywhere(take, name, deep[name], walk)
    points = TorsoPoints(middle, deep[name].at)
    bending = None
    if bends and name == "shifted":
        walk = torso_take.BothWays(workers, Stage.CLOTH, len(unchanged))
        bending = found_bending(take, posed, points, some, walk)
    return replace(_followed(fit, take, posed, bending, decided), points=points)


def _followed(
    fit: HeadFit, take: TorsoTake, posed: Motion, bending: Bending | None, motion: TorsoMotion
) -> FollowedTorso:
    """The take with the motion that was chosen."""
    necks = [pose.parameters[-RIGID_SIZE:][3 * NECK : 3 * NECK + 3] for pose in posed.values()]
    bends = [] if bending is None else bending.bends.values()
    shifts = [np.linalg.norm(pose.shift) for pose in posed.values() if pose.shift is not None]
    motion = replace(
        motion,
        turn_deg=float(np.degrees(np.linalg.norm(necks, axis=1).max())),
        shift_mm=1000 * float(max(shifts, default=0.0)),
        bend_mm=1000 * max((float(np.linalg.norm(b, axis=1).max()) for b in bends), default=0.0),
    )
    heads = {t: pose.parameters for t, pose in posed.items()}
    offsets = dict[int, np.ndarray]()
    for t, pose in posed.items():
        if pose.shift is not None:
            bend = 0.0 if bending is None else bending.at(t)
            heads[t], offsets[t] = take.with_offset(pose, bend)
    if bending is not None:
        static = bending.drape + (0 if fit.static_offset is None else fit.static_offset)
        fit = replace(fit, head=with_offset(fit.head, bending.drape), static_offset=static)
        offsets = {t: offset - bending.drape for t, offset in offsets.items()}
    return FollowedTorso(fit, heads, offsets, motion)


def _motions(
    take: TorsoTake,
    observed: torso_take.ObservedPoints,
    some: Sequence[int],
    walk: torso_take.BothWays,
) -> dict[str, Motion]:
    """The possible motions of a torso, at some timesteps and at the timestep of the points, whose
    depth is determined first by one of these motions."""
    observed = torso_take.at_depth(take, observed, {})["stereo"]
    (rough,) = _poses(walk, [_Follower(take, observed, False)], some)
    observed = torso_take.at_depth(take, observed, {"own": take.motion(rough, rigid=False)})["own"]
    both = [_Follower(take, observed, shifts) for shifts in (False, True)]
    turned, shifted = _poses(walk, both, some)
    still = dict.fromkeys(turned, take.straight(observed.timestep))
    return {
        "head": {t: PosedTorso(take.parameters[t]) for t in turned},
        "still": take.motion(still, rigid=False),
        "turned": take.motion(turned, rigid=False),
        "shifted": take.motion(shifted, rigid=True),
    }


def _everywhere(
    take: TorsoTake, name: str, observed: torso_take.ObservedPoints, walk: torso_take.BothWays
) -> Motion:
    """The motion that was chosen, at all timesteps."""
    if name == "still":
        still = dict.fromkeys(take.parameters, take.straight(observed.timestep))
        return take.motion(still, rigid=False)
    shifts = name == "shifted"
    (poses,) = _poses(walk, [_Follower(take, observed, shifts)], take.parameters)
    return take.motion(poses, rigid=shifts)


def _poses(
    walk: torso_take.BothWays, followers: Sequence["_Follower"], timesteps: Iterable[int]
) -> list[dict[int, TorsoPose]]:
    """The torso's poses by timestep, for each follower."""
    found = walk.along(_Follower.follow, followers, followers[0].observed.timestep, timesteps)
    return [
        {timestep: TorsoPose(**arrays) for timestep, arrays in by_timestep.items()}
        for by_timestep in found
    ]


class _Follower:
    """The pose of the torso over a take, by Gauss–Newton on the images of points below the head."""

    def __init__(self, take: TorsoTake, observed: torso_take.ObservedPoints, shifts: bool) -> None:
        """shifts: whether the torso is rigid, and shifted as well as turned."""
        self._take = take
        self.observed = observed
        self._shifts = shifts
        self._first = take.straight(observed.timestep)
        first = take.with_torso(observed.timestep, self._first, shifts)
        self._carrier = torso_take.Carrier(take, first, observed.at)

    def follow(self, way: Sequence[int], step: Step) -> torso_take.Rows:
        """Poses at the timesteps of a way, which begins with the one whose points are followed."""
        first = self._first.points() + self._pivot(way[0])
        states = torso_take.states_along(self._take, way, first, self._next, step)
        at = zip(way, states, strict=True)
        poses = [TorsoPose.of_points(points - self._pivot(timestep)) for timestep, points in at]
        return {
            name: np.stack([getattr(pose, name) for pose in poses]) for name in ("turn", "shift")
        }

    def _next(
        self, before: torso_take.TorsoShot, now: torso_take.TorsoShot, state: np.ndarray
    ) -> np.ndarray:
        """The pose's points (4, 3) at a timestep from those at one before it; in the world, where
        they move evenly while the head does not, of a torso that is shifted."""
        pose = TorsoPose.of_points(state - self._pivot(before.timestep))
        starts = [pose, self._by_flow(now, before, pose)]
        if self._shifts:  # where it was in the world
            moved = self._pivot(before.timestep) - self._pivot(now.timestep)
            starts.append(TorsoPose(pose.turn, pose.shift + moved))
        starts = [self._descended(now, start, pose, COARSE_STEPS) for start in starts]
        misfits = []
        for start in starts:
            at = self._posed(now.timestep, start)
            fraction, in_sight = self.observed.unexplained(now, at, START_LEVEL)
            use = in_sight & self.observed.fitted
            misfits.append(float(fraction[use].mean()) if use.any() else 1.0)
        best = starts[int(np.argmin(misfits))]
        found = self._descended(now, best, pose, FINE_STEPS)
        return found.points() + self._pivot(now.timestep)

    def _pivot(self, timestep: int) -> np.ndarray:
        return self._take.pivot(timestep) if self._shifts else np.zeros(3)

    def _descended(
        self, shot: torso_take.TorsoShot, pose: TorsoPose, expected: TorsoPose, plan: Plan
    ) -> TorsoPose:
        """The pose after up to so many steps in each level of the plan; expected: the prior's."""
        for level, steps in plan:
            for _ in range(steps):
                at, by_pose = self._linearized(shot.timestep, pose)
                terms = []
                for number, rows in self._visible(shot, at):
                    image = shot.views[number].levels[level]
                    residual = self.observed.residual(shot, number, rows, at[rows], level)
                    pixels, _ = image.camera.project(at[rows])
                    slope = np.stack(sampled(list(image.gradient), pixels), axis=2) / NOISE_LEVELS
                    rate = slope @ projection_derivative(image.camera, at[rows]) @ by_pose[rows]
                    weight = np.outer(point_weights(residual, level), appearance.CHANNEL_WEIGHTS)
                    terms.append((weight, rate, residual))
                pose, size = self._moved(pose, expected, terms)
                if size < CONVERGED_STEP:
                    break
        return pose

    def _by_flow(
        self, shot: torso_take.TorsoShot, before: torso_take.TorsoShot, pose: TorsoPose
    ) -> TorsoPose:
        """The pose to which optical flow leads from `pose`, the pose at the timestep before."""
        old = self._posed(before.timestep, pose)
        found = pose
        views = list(before.views.values()), list(shot.views.values())
        flows = appearance.flow_targets(old, *views)
        targets = {key[0]: (camera, target) for key, camera, target in flows}
        visible = [pair for pair in self._visible(before, old) if pair[0] in targets]
        for _ in range(appearance.FLOW_ITERATIONS):
            at, by_pose = self._linearized(shot.timestep, found)
            terms = []
            for number, rows in visible:
                camera, target = targets[number]
                miss = camera.project(at[rows])[0] - target[rows]
                weight = flow_weights(miss)
                rate = projection_derivative(camera, at[rows]) @ by_pose[rows]
                terms.append((np.repeat(weight[:, None], 2, 1), rate, miss))
            found, _ = self._moved(found, pose, terms)
        return found

    def _visible(self, shot: torso_take.TorsoShot, at: np.ndarray) -> list[tuple[int, np.ndarray]]:
        """Number of each camera that sees any of its fitted points, and the rows of these."""
        known = [
            (number, rows) for number, rows in self.observed.rows.items() if number in shot.views
        ]
        chosen = [(n, r[self.observed.fitted[r] & shot.shows(n, at[r])]) for n, r in known]
        return [pair for pair in chosen if len(pair[1])]

    def _posed(self, timestep: int, pose: TorsoPose) -> np.ndarray:
        torso = self._take.with_torso(timestep, pose, self._shifts)
        return self._carrier.carried(torso)(self.observed.at)

    def _linearized(self, timestep: int, pose: TorsoPose) -> tuple[np.ndarray, np.ndarray]:
        """Positions (N, 3), and derivatives (N, 3, 6) by a small rotation in front of the
        orientation, as if they were the root joint's alone, and by a shift."""
        at = self._posed(timestep, pose)
        by_turn = -cross_matrices(at - pose.shift - self._take.pivot(timestep))
        return at, np.concatenate([by_turn, np.broadcast_to(np.eye(3), by_turn.shape)], axis=2)

    def _moved(
        self, pose: TorsoPose, expected: TorsoPose, terms: Sequence[tuple[np.ndarray, ...]]
    ) -> tuple[TorsoPose, float]:
        """The pose after a Gauss–Newton step, which keeps it near the expected one, and the step's
        length; terms: weights (M, C), derivatives (M, C, 6) and residuals (M, C)."""
        precision = np.repeat([CHANGE_SIGMA_RAD**-2, CHANGE_SIGMA_M**-2], 3)
        away = np.concatenate(
            [axis_angle(pose.turn @ expected.turn.T), pose.shift - expected.shift]
        )
        matrix = np.diag(precision)
        right = -precision * away
        free = 6 if self._shifts else 3
        for weight, rate, residual in terms:
            matrix = matrix + np.einsum("nc,nci,ncj->ij", weight, rate, rate)
            right = right - np.einsum("nc,nci,nc->i", weight, rate, residual)
        step = np.zeros(6)
        step[:free] = np.linalg.solve(matrix[:free, :free], right[:free])
        size = float(np.linalg.norm(step))
        step *= min(1.0, MAX_STEP / max(size, 1e-12))
        turn = axis_angle_matrices(step[None, :3])[0] @ pose.turn
        return TorsoPose(turn, pose.shift + step[3:]), size
