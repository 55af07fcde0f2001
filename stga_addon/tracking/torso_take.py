"""A tracked take in which the torso is followed: its frames, the head's parameters with any
orientation of it, the points that cameras see at it, and which motion the images agree with."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation

from ..avatar.embedding import FaceFrames, face_frames
from ..capture.camera import Camera
from ..capture.mesh_geometry import silhouette
from ..capture.model import evenly_spread
from ..flame.forward import RIGID_SIZE, axis_angle_matrices, world_turns
from ..flame.model import JOINTS, MIN_TORSO_WEIGHT, torso_faces
from ..flame.quaternions import from_matrices, to_axis_angle, unit
from ..worker.helpers import Step
from . import appearance
from .appearance import NOISE_LEVELS, PyramidView, inside, sampled, unexplained
from .fit import HeadFit, posed_mesh
from .footage.model import FootageCamera
from .posed_points import PosedPoints, SurfacePoints, head_rotation, split
from .stages import Stage, Workers

ROOT = JOINTS.index("root")
"""Index of FLAME's first joint, which turns the whole model."""
NECK = JOINTS.index("neck")
"""Index of the joint that turns the head over the shoulders."""
HEAD_MARGIN = 0.03
"""Margin around the head, where hair and chin may be, as a fraction of the image's height."""
PLAIN_LEVEL = 128
"""Gray that stands for everything outside the mask."""
OFFSET_STEPS = 6
"""Steps after which offsets, which move joints, which move vertices, are those wanted."""
EVIDENCE_LEVEL = 1
"""Level of the pyramid in which motions are compared."""
POINT_STEP_M = 0.005
"""Distance between points at the torso."""
MAX_POINTS = 800
"""Points of a camera at most."""
BLOCK_POINTS = 4
"""Side of a block in points."""
HELD_OUT = 3
"""One block of so many is held out, and shows which motion is right."""
MASK_MARGIN = 0.01
"""Margin around the mask, whose edge is compared as well, as a fraction of the image's height."""
DEPTHS_M = tuple(np.linspace(-0.12, 0.06, 19).tolist())
"""Depths along a ray that are tried, from the mesh's beside it: a chest is in front of the neck."""
DEPTH_TIMESTEPS = 8
"""Timesteps at which depths are compared."""
NEIGHBORS = 25
"""Points whose evidence counts for each other."""
UNSEEN_COST = 0.5
"""Cost of a depth at which a point is not visible."""
REACH_M = 0.2
"""Reach of the torso from its joint."""
MAX_UNEVENNESS_M = 0.001
"""Distance by which positions may miss the mean of those at the timesteps beside: following them
scatters by as much, and means explain held-out points as well."""
ALONG_CAMERAS = appearance.CHANNEL_WEIGHTS * [0, 1, 1]
"""Weights of channels between cameras, from which surfaces are not equally bright."""


@dataclass(frozen=True)
class PosedTorso:
    """Parameters (E + 18,) of a head with its torso; shift (3,) meters, from where the neck's joint
    holds the torso, which is rigid then; None: the model's weights blend it with the neck."""

    parameters: np.ndarray
    shift: np.ndarray | None = None


Motion = Mapping[int, PosedTorso]  # By timestep
Rows = dict[str, np.ndarray]


@dataclass(frozen=True)
class TorsoPose:
    """Orientation (3, 3) of the torso in the world, and shift (3,) in meters, 0 if only turned."""

    turn: np.ndarray
    shift: np.ndarray

    def points(self) -> np.ndarray:
        """(4, 3) meters: where three points around the joint, and the joint, are brought."""
        return np.concatenate([REACH_M * self.turn.T, np.zeros((1, 3))]) + self.shift

    @classmethod
    def of_points(cls, points: np.ndarray) -> "TorsoPose":
        return cls((points[:3] - points[3]).T / REACH_M, points[3])


@dataclass(frozen=True)
class TorsoShot:
    """A timestep: by number of the camera its image, its mask (H, W) uint8, and the pixels (H, W)
    bool of the head at EVIDENCE_LEVEL."""

    timestep: int
    views: Mapping[int, PyramidView]
    masks: Mapping[int, np.ndarray]
    heads: Mapping[int, np.ndarray]

    def shows(self, number: int, at: np.ndarray) -> np.ndarray:
        """(N,) bool: points (N, 3) in the camera's image, not behind or in front of the head."""
        camera = self.views[number].levels[EVIDENCE_LEVEL].camera
        head = self.heads[number]
        pixels, depth = camera.project(at)
        x, y = np.clip(pixels.astype(int), 0, [camera.width - 1, camera.height - 1]).T
        return inside(camera, pixels, depth) & ~head[y, x]


class TorsoTake:
    """The take: images by timestep, and the head's parameters with any turn of the torso, whose
    triangles are `torso` (F,) bool."""

    def __init__(
        self, fit: HeadFit, parameters: Mapping[int, np.ndarray], cameras: Sequence[FootageCamera]
    ) -> None:
        self.model = fit.head.model
        self.parameters = parameters
        self.cameras, self.torso, self.fit = cameras, torso_faces(self.model), fit
        regressor = self.model.j_regressor[[ROOT, NECK]]
        self._joints = regressor @ self.model.v_template
        self._joint_dirs = np.einsum("jv,vak->jak", regressor, self.model.shapedirs)
        self._center = posed_mesh(fit, next(iter(parameters.values()))).mean(0)

    def with_torso(self, timestep: int, pose: TorsoPose, rigid: bool) -> PosedTorso:
        """The timestep's head, where it is, on the torso; rigid: which may be shifted as well."""
        parameters = self.parameters[timestep]
        root, neck = self.joints(parameters)
        turned = with_root(parameters, pose.turn, neck - root)
        return PosedTorso(turned, pose.shift if rigid else None)

    def straight(self, timestep: int) -> TorsoPose:
        """The torso turned as the head is."""
        return TorsoPose(head_turn(self.parameters[timestep]), np.zeros(3))

    def motion(self, poses: Mapping[int, TorsoPose], rigid: bool) -> Motion:
        """The torso posed at each timestep."""
        return {t: self.with_torso(t, pose, rigid) for t, pose in poses.items()}

    def rigid(self, torso: PosedTorso, vertices: np.ndarray) -> np.ndarray:
        """(N, 3) where a torso that is shifted carries some vertices (N,)."""
        assert torso.shift is not None
        expr = torso.parameters[:-RIGID_SIZE]
        (root, _) = self.joints(torso.parameters)
        rest = self.model.v_template[vertices] + self.model.shapedirs[vertices] @ expr
        turned = (rest - root) @ head_rotation(torso.parameters).T
        return turned + root + torso.parameters[-3:] + torso.shift

    def with_offset(
        self, torso: PosedTorso, bend: np.ndarray | float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Parameters (E + 18,) and vertex offsets (V, 3) by which a torso is rigid and shifted, and
        bent by `bend` (V, 3) meters in its own axes. Offsets move FLAME's joints as well; the
        translation undoes that for the head."""
        model = self.model
        parameters = torso.parameters.copy()
        offset = np.zeros_like(model.v_template)
        fraction = np.minimum(model.weights[:, ROOT] / MIN_TORSO_WEIGHT, 1)
        moved = np.flatnonzero(fraction)
        before = posed_mesh(self.fit, parameters)[moved]
        wanted = before + fraction[moved, None] * (self.rigid(torso, moved) - before)
        wanted += np.broadcast_to(bend, offset.shape)[moved] @ head_rotation(parameters).T
        turns = world_turns(model.parents, joint_turns(parameters))
        skin = np.einsum("vj,jab->vab", model.weights[moved], turns)
        for _ in range(OFFSET_STEPS):
            missed = wanted - posed_mesh(self.fit, parameters, offset)[moved]
            offset[moved] += np.linalg.solve(skin, missed[..., None])[..., 0]
            root, neck = model.j_regressor[[ROOT, NECK]] @ offset
            by_offset = root + turns[ROOT] @ (neck - root) - turns[NECK] @ neck
            parameters[-3:] = torso.parameters[-3:] - by_offset
        return parameters, offset

    def pivot(self, timestep: int) -> np.ndarray:
        """(3,) what the torso turns about: the joint of the neck."""
        parameters = self.parameters[timestep]
        root, neck = self.joints(parameters)
        return root + head_rotation(parameters) @ (neck - root) + parameters[-3:]

    def joints(self, parameters: np.ndarray) -> np.ndarray:
        """(2, 3) root, inside the base of the neck, and neck, before posing."""
        return self._joints + self._joint_dirs @ parameters[:-RIGID_SIZE]

    def shot(self, timestep: int) -> TorsoShot:
        """Read a timestep; images are of constant size, as optical flow needs them."""
        mesh = posed_mesh(self.fit, self.parameters[timestep])
        views = {}
        masks = {}
        heads = {}
        for number, source in enumerate(self.cameras):
            mask = source.mask(timestep) if timestep in source.timesteps else None
            if mask is not None:
                camera = self.fit.to_capture.camera(source.camera)
                image = masked(source.image(timestep), mask)
                levels = appearance.pyramid(camera, image, self._center)
                views[number] = PyramidView(bytes([number]), camera, levels)
                masks[number] = mask
                heads[number] = self.beside_head(mesh, levels[EVIDENCE_LEVEL].camera)
        return TorsoShot(timestep, views, masks, heads)

    def beside_head(self, mesh: np.ndarray, camera: Camera) -> np.ndarray:
        """(H, W) bool: the head without its torso, and what is beside it, farther than its
        triangles are wide."""
        corners = mesh[self.model.faces[~self.torso]]
        at = np.concatenate([corners.reshape(-1, 3), corners.mean(1)])
        pixels, depth = camera.project(at)
        x, y = pixels[inside(camera, pixels, depth)].astype(int).T
        found = np.zeros((camera.height, camera.width), bool)
        found[y, x] = True
        return grown(found, HEAD_MARGIN)


def masked(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The image (H, W, 3) uint8, plain outside its mask (H, W) uint8."""
    import cv2

    found = np.full_like(image, PLAIN_LEVEL)
    cv2.copyTo(image, cv2.inRange(mask, 255, 255), found)
    edge = np.nonzero(cv2.inRange(mask, 1, 254))
    fraction = mask[edge][:, None].astype(np.float32) / 255
    found[edge] = image[edge] * fraction + PLAIN_LEVEL * (1 - fraction) + 0.5
    return found


class BothWays:
    """Work along a take, from one timestep to both ends, by helping processes, each on a way."""

    def __init__(self, workers: Workers, stage: Stage, total: int) -> None:
        self._workers = workers
        self._stage = stage
        self._done = 0
        self._total = total

    def along(
        self, follow: Callable[..., Rows], who: Sequence[Any], first: int, timesteps: Iterable[int]
    ) -> list[dict[int, Rows]]:
        """For each of `who`, by timestep, rows of the arrays that follow(who, way, step) gives."""
        later = [first, *sorted(t for t in timesteps if t > first)]
        earlier = [first, *sorted((t for t in timesteps if t < first), reverse=True)]
        every = [(follower, way) for follower in who for way in (later, earlier)]
        found = self._workers.map(follow, every, (self._stage, self._done, self._total), keep=True)
        self._done += len(who) * (len(later) + len(earlier) - 2)
        results: list[dict[int, Rows]] = [{} for _ in who]
        for number, ((_, way), arrays) in enumerate(zip(every, found, strict=True)):
            for row, t in enumerate(way):
                results[number // 2][t] = {name: array[row] for name, array in arrays.items()}
        return [dict(sorted(by_timestep.items())) for by_timestep in results]


def states_along(
    take: TorsoTake,
    way: Sequence[int],
    first: np.ndarray,
    solve: Callable[[TorsoShot, TorsoShot, np.ndarray], np.ndarray],
    step: Step,
) -> np.ndarray:
    """(T, N, 3) positions in meters at each timestep of a way, which begins with `first` (N, 3).

    solve: of a timestep and a later one, and the positions at the first, those at the second. Every
    second one of consecutive timesteps is not solved where the motion is even: it is the mean of
    its neighbors.
    """
    number = {timestep: number for number, timestep in enumerate(sorted(take.parameters))}
    states = [first]
    before = first
    shot = take.shot(way[0])
    is_even = False
    for row in range(0, len(way) - 1, 2):
        start = states[-1]
        (*middle, end) = way[row + 1 : row + 3]
        now = take.shot(end)
        if is_even and middle and abs(number[end] - number[way[row]]) == 2:
            found = solve(shot, now, start)
            # by how much smooth motion misses the mean of two states
            is_even = _distance(2 * start - before, found) / 8 <= MAX_UNEVENNESS_M
            states += [(start + found) / 2, found] if is_even else []
        else:
            is_even = False
        if not is_even:
            for timestep in middle:
                between = take.shot(timestep)
                states.append(solve(shot, between, start))
                shot = between
            states.append(solve(shot, now, states[-1]))
            is_even = _distance((start + states[-1]) / 2, states[-2]) <= MAX_UNEVENNESS_M
        before = start
        shot = now
        for _ in (*middle, end):
            step()
    return np.stack(states)


def _distance(start: np.ndarray, end: np.ndarray) -> float:
    """Upper quartile of the distances of positions (N, 3) from others: hardly visible ones may be
    anywhere."""
    return float(np.quantile(np.linalg.norm(end - start, axis=-1), 0.75))


def with_root(parameters: np.ndarray, rotation: np.ndarray, arm: np.ndarray) -> np.ndarray:
    """Parameters (E + 18,) with the root joint in another orientation (3, 3), and the head in its
    place; arm (3,): from the root joint to the neck's, before posing."""
    before, neck = joint_turns(parameters)[[ROOT, NECK]]
    changed = parameters.copy()
    rigid = changed[-RIGID_SIZE:]
    rigid[3 * ROOT : 3 * ROOT + 3] = axis_angle(rotation)
    rigid[3 * NECK : 3 * NECK + 3] = axis_angle(rotation.T @ before @ neck)
    rigid[-3:] += (before - rotation) @ arm
    return changed


def head_turn(parameters: np.ndarray) -> np.ndarray:
    """(3, 3) orientation of the head in the world."""
    root, neck = joint_turns(parameters)[[ROOT, NECK]]
    return root @ neck


def joint_turns(parameters: np.ndarray) -> np.ndarray:
    """(5, 3, 3) rotations of the joints in (E + 18,) parameters, each before its parent's."""
    return axis_angle_matrices(parameters[-RIGID_SIZE:-3].reshape(-1, 3))


def axis_angle(rotation: np.ndarray) -> np.ndarray:
    """(3,) of a rotation (3, 3)."""
    return to_axis_angle(from_matrices(rotation[None]))[0]


def grown(where: np.ndarray, fraction: float) -> np.ndarray:
    """The pixels (H, W) bool with those around them, as far as a fraction of the image's height."""
    return binary_dilation(where, iterations=max(1, round(fraction * len(where))))


@dataclass(frozen=True)
class ObservedPoints:
    """N points below the head as the cameras see them at one timestep.

    rows       number of a camera -> the rows of its own points, whose depth is a guess
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

    def unexplained(
        self, shot: TorsoShot, at: np.ndarray, level: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """How little the images support the points once they are moved to `at` (N, 3).

        Returns two arrays: (N,) from 0, where the images agree with `reference`, to 1, where they
        contradict it; and (N,) bool, whether the point's camera observes it there.
        """
        fraction = np.zeros(len(at))
        is_observed = np.zeros(len(at), bool)
        for number, rows in self.rows.items():
            if number in shot.views:
                residual = self.residual(shot, number, rows, at[rows], level)
                fraction[rows] = unexplained(residual, level)
                is_observed[rows] = shot.shows(number, at[rows])
        return fraction, is_observed

    def residual(
        self, shot: TorsoShot, number: int, rows: np.ndarray, at: np.ndarray, level: int
    ) -> np.ndarray:
        """Channels (M, 3) of a camera's image at points less the reference's, in NOISE_LEVELS."""
        image = shot.views[number].levels[level]
        values = sampled([image.channels], image.camera.project(at)[0])[0]
        return (values - self.reference[level][rows]) / NOISE_LEVELS


def observed_points(take: TorsoTake, timestep: int) -> ObservedPoints:
    """What cameras see below the head: points on pixels' rays, as deep as the mesh beside."""
    from scipy.spatial import cKDTree

    shot = take.shot(timestep)
    mesh = posed_mesh(take.fit, take.parameters[timestep])
    none = np.zeros((0, 3))
    dark = np.zeros((0, 3), np.float32)
    found = [(none, none, np.zeros(0, bool), *(dark for _ in appearance.OUTLIER_SQUARED))]
    rows_of = {}
    count = 0
    for number, view in shot.views.items():
        camera = view.camera
        mask = shot.masks[number]
        pixels, depth = camera.project(mesh[take.model.faces].mean(1))
        step = max(1.0, POINT_STEP_M * camera.fl_x / float(np.median(depth)))
        rows, columns = np.indices((int(camera.height / step), int(camera.width / step)))
        places = (np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5) * step
        x, y = places.astype(int).T
        _, nearest = cKDTree(pixels).query(places)
        head = silhouette(mesh, take.model.faces[~take.torso], camera)
        body = grown(mask > 127, MASK_MARGIN) & ~grown(head, HEAD_MARGIN)
        kept = np.flatnonzero(body[y, x] & take.torso[nearest])
        kept = kept[:: max(1, -(-len(kept) // MAX_POINTS))]
        if not len(kept):
            continue
        points = camera.unproject(places[kept], depth[nearest[kept]])
        block = (rows // BLOCK_POINTS + columns // BLOCK_POINTS).ravel()[kept]
        shades = [sampled([v.channels], v.camera.project(points)[0])[0] for v in view.levels]
        found.append((points, points - camera.position, block % HELD_OUT != 0, *shades))
        rows_of[number] = count + np.arange(len(points))
        count += len(points)
    at, away, fitted, *reference = map(np.concatenate, zip(*found, strict=True))
    return ObservedPoints(timestep, rows_of, at, unit(away), fitted, reference)


class Carrier:
    """The torso's triangles, which carry points as they carry splats: each the nearest one."""

    def __init__(self, take: TorsoTake, first: PosedTorso, at: np.ndarray) -> None:
        """at (N, 3): where the points are at first."""
        from scipy.spatial import cKDTree

        candidates = np.flatnonzero(take.torso)
        centers = posed_mesh(take.fit, first.parameters)[take.model.faces[candidates]].mean(1)
        used, self._face = np.unique(candidates[cKDTree(centers).query(at)[1]], return_inverse=True)
        corners = SurfacePoints(np.repeat(used, 3), np.tile(np.eye(3), (len(used), 1)))
        self._corners = PosedPoints(take.model, corners)
        self._take = take
        self._vertices = take.model.faces[used].ravel()
        self._neutral = take.model.v_template[self._vertices]
        self._triangles = np.arange(3 * len(used)).reshape(-1, 3)
        self._first = self._frames(first)

    def carried(self, torso: PosedTorso) -> Callable[[np.ndarray], np.ndarray]:
        """What brings points (N, 3) from where they are at first to where this torso has them."""
        before = self._first
        after = self._frames(torso)
        face = self._face
        size = (after.scale / before.scale)[:, None, None]
        turn = (size * after.rotation @ before.rotation.swapaxes(1, 2))[face]
        start = before.origin[face]
        end = after.origin[face]
        return lambda at: np.einsum("nij,nj->ni", turn, at - start) + end

    def _frames(self, torso: PosedTorso) -> FaceFrames:
        values = torso.parameters
        if torso.shift is None:
            corners = self._corners.positions(*split(values))
        else:
            corners = self._take.rigid(torso, self._vertices)
        return face_frames(corners, self._triangles, self._neutral)


def compared(
    take: TorsoTake,
    observed: Mapping[str, ObservedPoints],
    motions: Mapping[str, Motion],
    timesteps: Sequence[int],
) -> dict[str, float]:
    """Motion -> mean misfit of held-out points, where all motions leave them in sight."""
    start = observed["head"].timestep
    total = np.zeros(len(motions))
    count = 0
    carriers = {
        name: Carrier(take, poses[start], observed[name].at) for name, poses in motions.items()
    }
    for timestep in (t for t in timesteps if t != start):
        shot = take.shot(timestep)
        found = []
        for name, poses in motions.items():
            at = carriers[name].carried(poses[timestep])(observed[name].at)
            found.append(observed[name].unexplained(shot, at, EVIDENCE_LEVEL))
        fractions, in_sight = map(np.stack, zip(*found, strict=True))
        use = in_sight.all(0) & ~observed["head"].fitted
        count = count + int(use.sum())
        total = total + fractions[:, use].sum(1)
    return dict(zip(motions, (total / max(count, 1)).tolist(), strict=True))


def at_depth(
    take: TorsoTake, observed: ObservedPoints, motions: Mapping[str, Motion]
) -> dict[str, ObservedPoints]:
    """Motion -> the points at the depths along their rays at which other cameras, and other
    timesteps of the motion, look like them; "stereo": of other cameras alone."""
    candidates = [observed.at + depth * observed.ray for depth in DEPTHS_M]
    shot = take.shot(observed.timestep)
    stereo = np.zeros((len(DEPTHS_M), len(observed.at)))
    for number, rows in observed.rows.items():
        for other in shot.views.keys() - {number}:
            for cost, at in zip(stereo, candidates, strict=True):
                residual = observed.residual(shot, other, rows, at[rows], EVIDENCE_LEVEL)
                fraction = unexplained(residual, EVIDENCE_LEVEL, ALONG_CAMERAS)
                cost[rows] += np.where(shot.shows(other, at[rows]), fraction, UNSEEN_COST)
    costs = {"stereo": stereo, **{name: stereo.copy() for name in motions}}
    carriers = {
        name: Carrier(take, poses[observed.timestep], observed.at)
        for name, poses in motions.items()
    }
    known = (
        sorted(set.intersection(*(set(motion) for motion in motions.values()))) if motions else []
    )
    for timestep in evenly_spread([t for t in known if t != observed.timestep], DEPTH_TIMESTEPS):
        shot = take.shot(timestep)
        for name, poses in motions.items():
            carried = carriers[name].carried(poses[timestep])
            for cost, at in zip(costs[name], candidates, strict=True):
                fraction, in_sight = observed.unexplained(shot, carried(at), EVIDENCE_LEVEL)
                cost += np.where(in_sight, fraction, UNSEEN_COST)
    return {name: _moved_in_depth(observed, cost) for name, cost in costs.items()}


def _moved_in_depth(observed: ObservedPoints, cost: np.ndarray) -> ObservedPoints:
    """The points where the cost (DEPTHS_M, N), averaged over neighbors, is least, if that is
    significant."""
    from scipy.spatial import cKDTree

    moved = observed.at.copy()
    for rows in observed.rows.values():
        if len(rows) >= NEIGHBORS and np.ptp(cost[:, rows]) > 0:
            near = rows[cKDTree(observed.at[rows]).query(observed.at[rows], NEIGHBORS)[1]]
            depth = np.zeros(len(moved))
            depth[rows] = np.array(DEPTHS_M)[cost[:, near].mean(2).argmin(0)]
            moved[rows] += np.median(depth[near], axis=1)[:, None] * observed.ray[rows]
    return replace(observed, at=moved)
