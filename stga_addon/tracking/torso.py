"""The torso's motion: whether what is below the head turns with it, stays, or moves on its own.

Landmarks of a face cannot tell the neck's rotation from the head's, so that a tracked head and the ring of shoulders
that its neck ends in turn as one. Here the root joint, which carries that ring, gets the orientation that explains the
images below the head best; the neck turns back by as much, and the head stays where it was tracked. Skin between both
is blended by the model's own weights.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_dilation

from ..avatar.embedding import FaceFrames, face_frames
from ..capture.camera import Camera
from ..capture.mesh_raster import silhouette
from ..capture.model import evenly_spread
from ..flame.forward import axis_angle_matrices
from ..flame.masks import torso_faces
from ..flame.model import JOINTS
from ..flame.quaternions import from_matrices, to_axis_angle
from .appearance import CHANNEL_WEIGHTS, NOISE_LEVELS, pyramid, robust, sampled
from .dense_terms import (
    FLOW_ITERATIONS,
    FLOW_SCALE_PX,
    FLOW_SHARE,
    OUTLIER_SQUARED,
    POINT_SHARE,
    PyramidView,
    flow_targets,
    inside,
    projection_derivative,
)
from .fit import HeadFit
from .footage.model import Footage, FootageCamera
from .landmarks import Report
from .posed_points import RIGID_SIZE, PosedPoints, SurfacePoints, cross_matrices
from .torso_motion import TorsoMotion
from .write_capture import posed_mesh

ROOT, NECK = JOINTS.index("root"), JOINTS.index("neck")
MIN_TIMESTEPS, MAX_CAMERAS = 4, 4
"""Below it, there is no motion to tell apart; cameras, spread over the rig, whose images are compared."""
POINT_STEP_M, MAX_POINTS = 0.005, 800
"""Distance between points at the torso, and how many of them a camera has at most."""
TIE = 1e-3
"""Difference in the trace of rotations that time decides."""
MIN_POINTS = 200
"""Of all cameras together, below which the torso is not seen."""
BLOCK_POINTS, HELD_OUT = 4, 3
"""Blocks of so many points by so many; one of so many blocks is not fitted, and tells which motion is right."""
HEAD_MARGIN, MASK_MARGIN = 0.03, 0.01
"""Around the head's silhouette, where hair and chin may be, and around the mask, whose edge is compared as well; shares
of the image's height."""
PLAIN_LEVEL = 128
"""Gray that stands for everything outside the mask."""
START_LEVEL, EVIDENCE_LEVEL = 2, 1
"""Levels of the pyramid in which starts are compared, and in which motions are."""
COARSE_STEPS, FINE_STEPS = ((3, 3), (2, 3)), ((1, 4), (0, 2))
"""Levels and Gauss–Newton steps in each, for every start, and for the best one."""
CHANGE_SIGMA_RAD = 0.1
"""Standard deviation of the torso's rotation from one timestep to the next."""
MAX_STEP_RAD, CONVERGED_RAD = 0.15, 1e-4
DEPTHS_M = tuple(np.linspace(-0.12, 0.06, 19).tolist())
"""Along a point's ray, from the depth of the mesh beside it, that are tried: a chest is before the neck."""
DEPTH_TIMESTEPS, NEIGHBORS, UNSEEN_COST = 8, 25, 0.5
"""Timesteps at which depths are compared; points whose evidence counts for each other; cost where a point is not in
sight."""
ALONG_CAMERAS = CHANNEL_WEIGHTS * [0, 1, 1]
"""Weights of channels between cameras, from which surfaces are not equally bright."""
COMPARED_TIMESTEPS = 24
"""Spread over the take, at which motions are compared; depths are found at some of them."""
MIN_GAIN, MIN_OWN_GAIN = 0.1, 0.05
"""Share by which the misfit has to fall for the torso not to ride on the head, and to move instead of being still."""


Motion = Mapping[int, np.ndarray]
"""Timestep -> parameters (E + 18,)."""


def follow_torso(
    fit: HeadFit, parameters: Mapping[int, np.ndarray], footage: Footage, report: Report
) -> tuple[dict[int, np.ndarray], TorsoMotion | None]:
    """Parameters (E + 18,) of every timestep with the torso's motion, and how it was decided.

    The torso turns about the neck's joint; the head is not moved. Parameters are returned as they are where the torso
    rides on the head. None where that cannot be told: without masks, in takes shorter than MIN_TIMESTEPS, of models
    without a neck, and where little of a torso is seen.
    """
    unchanged = dict(parameters)
    torso = torso_faces(fit.head.model)
    if len(parameters) < MIN_TIMESTEPS or not fit.head.joints[NECK] or not torso.any():
        return unchanged, None
    middle = _middle_timestep(parameters)
    take = _Take(fit, unchanged, _cameras(footage, middle), torso)
    seen = _seen_points(take, middle)
    if sum(map(len, seen.rows.values())) < MIN_POINTS:
        return unchanged, None
    some = evenly_spread(sorted(unchanged), COMPARED_TIMESTEPS)
    seen = _at_depth(take, seen, {})["stereo"]
    turns = _Follower(take, seen).follow(some, report)
    rough = {t: take.with_torso(t, turn) for t, turn in turns.items()}
    turns = _Follower(take, _at_depth(take, seen, {"own": rough})["own"]).follow(sorted(unchanged), report)
    motions: dict[str, Motion] = {
        "head": unchanged,
        "still": {t: take.with_torso(t, turns[middle]) for t in unchanged},
        "own": {t: take.with_torso(t, turns[t]) for t in unchanged},
    }
    misfit = _compared(take, _at_depth(take, seen, motions), motions, some)
    motion = _chosen(misfit)
    turn = max(float(np.degrees(np.linalg.norm(_joint(values, NECK)))) for values in motions[motion].values())
    return dict(motions[motion]), TorsoMotion(motion, misfit, turn)


def with_root(parameters: np.ndarray, rotation: np.ndarray, arm: np.ndarray) -> np.ndarray:
    """Parameters (E + 18,) with the root joint in another orientation (3, 3), and the head in its place.

    arm (3,): from the root joint to the neck's, before posing.
    """
    before, neck = axis_angle_matrices(np.stack([_joint(parameters, joint) for joint in (ROOT, NECK)]))
    changed = parameters.copy()
    rigid = changed[-RIGID_SIZE:]
    rigid[3 * ROOT : 3 * ROOT + 3] = _axis_angle(rotation)
    rigid[3 * NECK : 3 * NECK + 3] = _axis_angle(rotation.T @ before @ neck)
    rigid[-3:] += (before - rotation) @ arm
    return changed


def _chosen(misfit: Mapping[str, float]) -> str:
    """The motion that explains the images best; a simpler one unless the gain is clear."""
    best = "own" if misfit["own"] < (1 - MIN_OWN_GAIN) * misfit["still"] else "still"
    return best if misfit[best] < (1 - MIN_GAIN) * misfit["head"] else "head"


def _middle_timestep(parameters: Mapping[int, np.ndarray]) -> int:
    """The timestep at which the head is turned most nearly as on average: there the torso is taken to be straight."""
    timesteps = sorted(parameters)
    turns = np.stack([_head_turn(parameters[timestep]) for timestep in timesteps])
    late = np.abs(np.linspace(-1, 1, len(timesteps)))  # of a head that does not turn, the middle of the take
    return timesteps[int(((turns * turns.mean(0)).sum((1, 2)) - TIE * late).argmax())]


def _cameras(footage: Footage, timestep: int) -> list[FootageCamera]:
    """Cameras with a masked frame at the timestep."""
    seen = [camera for camera in footage.cameras if timestep in camera.timesteps and camera.mask(timestep) is not None]
    return evenly_spread(seen, MAX_CAMERAS)


@dataclass(frozen=True)
class _Shot:
    """A timestep: by number of the camera its image, and the pixels (H, W) bool of the head at EVIDENCE_LEVEL."""

    views: Mapping[int, PyramidView]
    heads: Mapping[int, np.ndarray]

    def shows(self, number: int, at: np.ndarray) -> np.ndarray:
        """(N,) bool: points (N, 3) that lie in the camera's image, and not behind or before the head."""
        camera, head = self.views[number].levels[EVIDENCE_LEVEL].camera, self.heads[number]
        x, y = np.clip(camera.project(at)[0].astype(int), 0, [camera.width - 1, camera.height - 1]).T
        return np.asarray(inside(camera, at) & ~head[y, x])


class _Take:
    """The tracked take: images by timestep, and the head's parameters with any orientation of the torso."""

    def __init__(
        self,
        fit: HeadFit,
        parameters: Mapping[int, np.ndarray],
        cameras: Sequence[FootageCamera],
        torso: np.ndarray,
    ) -> None:
        self.model, self.parameters, self.cameras, self.torso = fit.head.model, parameters, cameras, torso
        self._fit = fit
        regressor = self.model.j_regressor[[ROOT, NECK]]
        self._joints = regressor @ self.model.v_template
        self._joint_dirs = np.einsum("jv,vak->jak", regressor, self.model.shapedirs)
        self._center = posed_mesh(fit, next(iter(parameters.values()))).mean(0)

    def with_torso(self, timestep: int, turn: np.ndarray) -> np.ndarray:
        """The timestep's parameters with the torso in an orientation (3, 3)."""
        root, neck = self._unposed_joints(timestep)
        return with_root(self.parameters[timestep], turn, neck - root)

    def pivot(self, timestep: int) -> np.ndarray:
        """(3,) what the torso turns about: the joint of the neck."""
        parameters, (root, neck) = self.parameters[timestep], self._unposed_joints(timestep)
        turn = axis_angle_matrices(_joint(parameters, ROOT)[None])[0]
        return np.asarray(root + turn @ (neck - root) + parameters[-3:])

    def _unposed_joints(self, timestep: int) -> np.ndarray:
        return np.asarray(self._joints + self._joint_dirs @ self.parameters[timestep][:-RIGID_SIZE])

    def mesh(self, parameters: np.ndarray) -> np.ndarray:
        return posed_mesh(self._fit, parameters)

    def shot(self, timestep: int) -> _Shot:
        """Read a timestep; images are of constant size, as optical flow needs them."""
        mesh = self.mesh(self.parameters[timestep])
        views, heads = {}, {}
        for number, source in enumerate(self.cameras):
            mask = source.mask(timestep) if timestep in source.timesteps else None
            if mask is not None:
                camera = self._fit.to_capture.camera(source.camera)
                levels = pyramid(camera, _masked(source.image(timestep), mask), self._center)
                views[number] = PyramidView(bytes([number]), camera, levels)
                heads[number] = self.head_pixels(mesh, levels[EVIDENCE_LEVEL].camera)
        return _Shot(views, heads)

    def head_pixels(self, mesh: np.ndarray, camera: Camera) -> np.ndarray:
        """(H, W) bool: the head without its torso, and what is beside it."""
        return _grown(silhouette(mesh, self.model.faces[~self.torso], camera), HEAD_MARGIN)


@dataclass(frozen=True)
class _SeenPoints:
    """N points below the head as the cameras see them at one timestep.

    rows       number of a camera -> the rows of its own points: how deep they lie is a guess that other cameras lack
    at, ray    (N, 3) meters; unit vectors away from their camera
    fitted     (N,) bool: points that the motion is fitted to
    reference  by level, the images' channels (N, 3)
    """

    timestep: int
    rows: Mapping[int, np.ndarray]
    at: np.ndarray
    ray: np.ndarray
    fitted: np.ndarray
    reference: Sequence[np.ndarray]

    def unexplained(self, shot: _Shot, at: np.ndarray, level: int) -> tuple[np.ndarray, np.ndarray]:
        """Share (N,) from 0 to 1 of each point, moved to `at` (N, 3), that the images do not explain, and (N,) bool
        whether it is seen."""
        share, seen = np.zeros(len(at)), np.zeros(len(at), bool)
        for number, rows in self.rows.items():
            if number in shot.views:
                share[rows] = self.share(shot, number, rows, at[rows], level)
                seen[rows] = shot.shows(number, at[rows])
        return share, seen

    def share(
        self,
        shot: _Shot,
        number: int,
        rows: np.ndarray,
        at: np.ndarray,
        level: int,
        weights: np.ndarray = CHANNEL_WEIGHTS,
    ) -> np.ndarray:
        """(M,) from 0 to 1: how little a camera's image at points (M, 3) looks like the reference of the rows."""
        squared = self.residual(shot, number, rows, at, level) ** 2 @ weights
        return np.asarray(squared / (OUTLIER_SQUARED[level] + squared))

    def residual(self, shot: _Shot, number: int, rows: np.ndarray, at: np.ndarray, level: int) -> np.ndarray:
        """Channels (M, 3) of a camera's image at points, minus those of the reference, in NOISE_LEVELS."""
        own = shot.views[number].levels[level]
        values = sampled(own.channels, own.camera.project(at)[0])
        return np.asarray((values - self.reference[level][rows]) / NOISE_LEVELS)


def _seen_points(take: _Take, timestep: int) -> _SeenPoints:
    """What the cameras see below the head at a timestep."""
    shot, parameters = take.shot(timestep), take.parameters[timestep]
    mesh = take.mesh(parameters)
    at, fitted, rows, count = [np.zeros((0, 3))], [np.zeros(0, bool)], {}, 0
    for number, view in shot.views.items():
        own, chosen = _below_head(take, timestep, mesh, number, view.camera)
        if not len(own):
            continue
        rows[number] = count + np.arange(len(own))
        at, fitted, count = [*at, own], [*fitted, chosen], count + len(own)
    every = np.concatenate(at)
    eyes = np.zeros_like(every)
    for number in rows:
        eyes[rows[number]] = shot.views[number].camera.position
    away = every - eyes
    reference = []
    for level in range(len(OUTLIER_SQUARED)):
        images = {number: shot.views[number].levels[level] for number in rows}
        values = [sampled(own.channels, own.camera.project(every[rows[number]])[0]) for number, own in images.items()]
        reference.append(np.concatenate(values) if values else np.zeros((0, 3)))
    ray = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    return _SeenPoints(timestep, rows, every, ray, np.concatenate(fitted), reference)


def _below_head(
    take: _Take, timestep: int, mesh: np.ndarray, number: int, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) on the rays of the pixels below the head, as deep as the mesh beside them; which are fitted."""
    from scipy.spatial import cKDTree

    mask = take.cameras[number].mask(timestep)
    assert mask is not None
    pixels, depth = camera.project(mesh[take.model.faces].mean(1))
    step = max(1.0, POINT_STEP_M * camera.fl_x / float(np.median(depth)))
    rows, columns = np.indices((int(camera.height / step), int(camera.width / step)))
    at = (np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5) * step
    x, y = at.astype(int).T
    _, nearest = cKDTree(pixels).query(at)
    shown = _grown(mask > 127, MASK_MARGIN) & ~take.head_pixels(mesh, camera)
    kept = np.flatnonzero(shown[y, x] & take.torso[nearest])
    kept = kept[:: max(1, -(-len(kept) // MAX_POINTS))]
    block = (rows // BLOCK_POINTS + columns // BLOCK_POINTS).ravel()[kept]
    return camera.unproject(at[kept], depth[nearest[kept]]), block % HELD_OUT != 0


class _Carrier:
    """The torso's triangles, which carry points as they carry splats: each the nearest one."""

    def __init__(self, take: _Take, parameters: np.ndarray, at: np.ndarray) -> None:
        """at (N, 3): where the points are with these parameters."""
        from scipy.spatial import cKDTree

        candidates = np.flatnonzero(take.torso)
        centers = take.mesh(parameters)[take.model.faces[candidates]].mean(1)
        used, self._face = np.unique(candidates[cKDTree(centers).query(at)[1]], return_inverse=True)
        self._corners = PosedPoints(take.model, SurfacePoints(np.repeat(used, 3), np.tile(np.eye(3), (len(used), 1))))
        self._neutral = take.model.v_template[take.model.faces[used]].reshape(-1, 3)
        self._triangles = np.arange(3 * len(used)).reshape(-1, 3)
        self._first = self._frames(parameters)

    def carried(self, parameters: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """What brings the points (N, 3), from where they are with the first parameters, to where these ones do."""
        before, after, face = self._first, self._frames(parameters), self._face
        turn = (after.scale / before.scale)[:, None, None] * after.rotation @ before.rotation.swapaxes(1, 2)
        return lambda at: np.einsum("nij,nj->ni", turn[face], at - before.origin[face]) + after.origin[face]

    def _frames(self, parameters: np.ndarray) -> FaceFrames:
        corners = self._corners.positions(parameters[:-RIGID_SIZE], parameters[-RIGID_SIZE:])
        return face_frames(corners, self._triangles, self._neutral)


def _compared(
    take: _Take, seen: Mapping[str, _SeenPoints], motions: Mapping[str, Motion], timesteps: Sequence[int]
) -> dict[str, float]:
    """Motion -> mean misfit of the points that were not fitted, where all motions leave them in sight."""
    first = seen["head"]
    carriers = {name: _Carrier(take, own[first.timestep], seen[name].at) for name, own in motions.items()}
    total, count = dict.fromkeys(motions, 0.0), 0
    for timestep in timesteps:
        if timestep == first.timestep:
            continue
        shot, use, shares = take.shot(timestep), ~first.fitted, {}
        for name, own in motions.items():
            at = carriers[name].carried(own[timestep])(seen[name].at)
            shares[name], shown = seen[name].unexplained(shot, at, EVIDENCE_LEVEL)
            use = use & shown
        count += int(use.sum())
        for name, share in shares.items():
            total[name] += float(share[use].sum())
    return {name: value / max(count, 1) for name, value in total.items()}


def _at_depth(take: _Take, seen: _SeenPoints, motions: Mapping[str, Motion]) -> dict[str, _SeenPoints]:
    """Motion -> the points at the depths along their rays at which other cameras, and other timesteps of the motion,
    look like them; "stereo": of other cameras alone."""
    candidates = [seen.at + depth * seen.ray for depth in DEPTHS_M]
    shot, stereo = take.shot(seen.timestep), np.zeros((len(DEPTHS_M), len(seen.at)))
    for number, rows in seen.rows.items():
        for other in shot.views.keys() - {number}:
            for cost, at in zip(stereo, candidates, strict=True):
                share = seen.share(shot, other, rows, at[rows], EVIDENCE_LEVEL, ALONG_CAMERAS)
                cost[rows] += np.where(shot.shows(other, at[rows]), share, UNSEEN_COST)
    costs = {"stereo": stereo, **{name: stereo.copy() for name in motions}}
    carriers = {name: _Carrier(take, own[seen.timestep], seen.at) for name, own in motions.items()}
    known = sorted(set.intersection(*(set(own) for own in motions.values()))) if motions else []
    for timestep in evenly_spread([t for t in known if t != seen.timestep], DEPTH_TIMESTEPS):
        shot = take.shot(timestep)
        for name, own in motions.items():
            carried = carriers[name].carried(own[timestep])
            for cost, at in zip(costs[name], candidates, strict=True):
                share, shown = seen.unexplained(shot, carried(at), EVIDENCE_LEVEL)
                cost += np.where(shown, share, UNSEEN_COST)
    return {name: _moved_in_depth(seen, cost) for name, cost in costs.items()}


def _moved_in_depth(seen: _SeenPoints, cost: np.ndarray) -> _SeenPoints:
    """The points where the cost (DEPTHS_M, N), averaged over neighbors, is least; where it tells nothing, as they
    are."""
    from scipy.spatial import cKDTree

    moved = seen.at.copy()
    for rows in seen.rows.values():
        if len(rows) >= NEIGHBORS and np.ptp(cost[:, rows]) > 0:
            near = rows[cKDTree(seen.at[rows]).query(seen.at[rows], NEIGHBORS)[1]]
            depth = np.zeros(len(moved))
            depth[rows] = np.array(DEPTHS_M)[cost[:, near].mean(2).argmin(0)]
            moved[rows] += np.median(depth[near], axis=1)[:, None] * seen.ray[rows]
    return replace(seen, at=moved)


class _Follower:
    """The orientation of the torso over a take, by Gauss–Newton on the images of points below the head."""

    def __init__(self, take: _Take, seen: _SeenPoints) -> None:
        self._take, self._seen = take, seen
        self._first = _head_turn(take.parameters[seen.timestep])
        self._carrier = _Carrier(take, take.with_torso(seen.timestep, self._first), seen.at)

    def follow(self, timesteps: Sequence[int], report: Report) -> dict[int, np.ndarray]:
        """Timestep -> orientation (3, 3), from the timestep whose points are followed to both ends of the take."""
        middle, turns = self._seen.timestep, {self._seen.timestep: self._first}
        later = [timestep for timestep in timesteps if timestep > middle]
        earlier = [timestep for timestep in reversed(timesteps) if timestep < middle]
        for way in (later, earlier):
            before, shot = middle, self._take.shot(middle)
            for timestep in way:
                report("Torso", len(turns), len(timesteps))
                now = self._take.shot(timestep)
                turns[timestep] = self._solved(timestep, now, before, shot, turns[before])
                before, shot = timestep, now
        return turns

    def _solved(self, timestep: int, shot: _Shot, before: int, shot_before: _Shot, turn: np.ndarray) -> np.ndarray:
        """The orientation at a timestep, from that at the one before."""
        starts = [turn, self._by_flow(timestep, shot, before, shot_before, turn)]
        starts = [self._descended(timestep, shot, start, turn, COARSE_STEPS) for start in starts]
        misfits = [self._misfit(timestep, shot, start) for start in starts]
        return self._descended(timestep, shot, starts[int(np.argmin(misfits))], turn, FINE_STEPS)

    def _misfit(self, timestep: int, shot: _Shot, turn: np.ndarray) -> float:
        share, shown = self._seen.unexplained(shot, self._posed(timestep, turn), START_LEVEL)
        use = shown & self._seen.fitted
        return float(share[use].mean()) if use.any() else 1.0

    def _descended(
        self, timestep: int, shot: _Shot, turn: np.ndarray, usual: np.ndarray, plan: Sequence[tuple[int, int]]
    ) -> np.ndarray:
        """The orientation after up to so many steps in each level of the plan; usual (3, 3): the prior's."""
        for level, steps in plan:
            for _ in range(steps):
                at, by_turn = self._linearized(timestep, turn)
                matrix, right = _prior(turn, usual)
                for number, rows in self._visible(shot, at):
                    own = shot.views[number].levels[level]
                    residual = self._seen.residual(shot, number, rows, at[rows], level)
                    pixels, _ = own.camera.project(at[rows])
                    slope = np.stack([sampled(part, pixels) for part in own.gradient], axis=2) / NOISE_LEVELS
                    rate = slope @ projection_derivative(own.camera, at[rows]) @ by_turn[rows]
                    used = POINT_SHARE / (1 + residual**2 @ CHANNEL_WEIGHTS / OUTLIER_SQUARED[level]) ** 2
                    weight = used[:, None] * CHANNEL_WEIGHTS
                    matrix = matrix + np.einsum("nc,nci,ncj->ij", weight, rate, rate)
                    right = right - np.einsum("nc,nci,nc->i", weight, rate, residual)
                turn, size = _stepped(turn, matrix, right)
                if size < CONVERGED_RAD:
                    break
        return turn

    def _by_flow(self, timestep: int, shot: _Shot, before: int, shot_before: _Shot, turn: np.ndarray) -> np.ndarray:
        """The orientation to which optical flow leads from `turn`, that at the timestep before."""
        old, found = self._posed(before, turn), turn
        flows = flow_targets(old, list(shot_before.views.values()), list(shot.views.values()))
        targets = {key[0]: (camera, target) for key, camera, target in flows}
        shown = [(number, rows) for number, rows in self._visible(shot_before, old) if number in targets]
        for _ in range(FLOW_ITERATIONS):
            at, by_turn = self._linearized(timestep, found)
            matrix, right = _prior(found, turn)
            for number, rows in shown:
                camera, target = targets[number]
                miss = camera.project(at[rows])[0] - target[rows]
                weight = FLOW_SHARE * robust(np.linalg.norm(miss, axis=1), FLOW_SCALE_PX)
                rate = projection_derivative(camera, at[rows]) @ by_turn[rows]
                matrix = matrix + np.einsum("n,nci,ncj->ij", weight, rate, rate)
                right = right - np.einsum("n,nci,nc->i", weight, rate, miss)
            found, _ = _stepped(found, matrix, right)
        return found

    def _visible(self, shot: _Shot, at: np.ndarray) -> list[tuple[int, np.ndarray]]:
        """Number of each camera that sees any of its points that are fitted, and the rows of these."""
        chosen = [
            (number, rows[self._seen.fitted[rows] & shot.shows(number, at[rows])])
            for number, rows in self._seen.rows.items()
            if number in shot.views
        ]
        return [(number, rows) for number, rows in chosen if len(rows)]

    def _posed(self, timestep: int, turn: np.ndarray) -> np.ndarray:
        return self._carrier.carried(self._take.with_torso(timestep, turn))(self._seen.at)

    def _linearized(self, timestep: int, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (N, 3), and derivatives (N, 3, 3) by a small rotation in front of the orientation, as if they were
        the root joint's alone."""
        at = self._posed(timestep, turn)
        return at, -cross_matrices(at - self._take.pivot(timestep))


def _prior(turn: np.ndarray, usual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matrix and right-hand side (3,) of a small rotation, by which the orientation is near the usual one."""
    precision = CHANGE_SIGMA_RAD**-2
    return precision * np.eye(3), -precision * _axis_angle(turn @ usual.T)


def _stepped(turn: np.ndarray, matrix: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, float]:
    """The orientation after a Gauss–Newton step, and the step's angle."""
    step = np.linalg.solve(matrix, right)
    size = float(np.linalg.norm(step))
    step *= min(1.0, MAX_STEP_RAD / max(size, 1e-12))
    return np.asarray(axis_angle_matrices(step[None])[0] @ turn), size


def _joint(parameters: np.ndarray, joint: int) -> np.ndarray:
    """(3,) axis-angle of a joint in (E + 18,) parameters."""
    return np.asarray(parameters[-RIGID_SIZE:][3 * joint : 3 * joint + 3])


def _head_turn(parameters: np.ndarray) -> np.ndarray:
    """(3, 3) orientation of the head in the world."""
    root, neck = axis_angle_matrices(np.stack([_joint(parameters, joint) for joint in (ROOT, NECK)]))
    return np.asarray(root @ neck)


def _axis_angle(rotation: np.ndarray) -> np.ndarray:
    return np.asarray(to_axis_angle(from_matrices(rotation[None]))[0])


def _masked(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The image (H, W, 3) uint8 over plain gray."""
    share = mask[..., None].astype(np.float32) / 255
    return np.asarray(image * share + PLAIN_LEVEL * (1 - share) + 0.5, np.uint8)


def _grown(where: np.ndarray, share: float) -> np.ndarray:
    """The pixels (H, W) bool with those around them, as far as a share of the height."""
    return np.asarray(binary_dilation(where, iterations=max(1, round(share * len(where)))))
