"""Points seen at the torso: where they lie, how motions carry them, and which motion the images
agree with."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..avatar.embedding import FaceFrames, face_frames
from ..capture.camera import Camera
from ..capture.model import evenly_spread
from ..flame.forward import RIGID_SIZE
from .appearance import CHANNEL_WEIGHTS, NOISE_LEVELS, sampled
from .dense_terms import OUTLIER_SQUARED
from .posed_points import PosedPoints, SurfacePoints
from .torso_take import EVIDENCE_LEVEL, PosedTorso, TorsoShot, TorsoTake, grown

POINT_STEP_M, MAX_POINTS = 0.005, 800
"""Distance between points at the torso, and how many of them a camera has at most."""
BLOCK_POINTS, HELD_OUT = 4, 3
"""Blocks of so many points by so many; one of so many blocks is not fitted, and tells which motion
is right."""
MASK_MARGIN = 0.01
"""Around the mask, whose edge is compared as well; share of the image's height."""
DEPTHS_M = tuple(np.linspace(-0.12, 0.06, 19).tolist())
"""Along a point's ray, from the depth of the mesh beside it, that are tried: a chest is before the
neck."""
DEPTH_TIMESTEPS, NEIGHBORS, UNSEEN_COST = 8, 25, 0.5
"""Timesteps at which depths are compared; points whose evidence counts for each other; cost where a
point is not in sight."""
ALONG_CAMERAS = CHANNEL_WEIGHTS * [0, 1, 1]
"""Weights of channels between cameras, from which surfaces are not equally bright."""

Motion = Mapping[int, PosedTorso]
"""By timestep."""


@dataclass(frozen=True)
class SeenPoints:
    """N points below the head as the cameras see them at one timestep.

    rows       number of a camera -> the rows of its own points: how deep they lie is a guess that
               other cameras lack
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
        """Share (N,) from 0 to 1 of each point, moved to `at` (N, 3), that the images do not
        explain, and (N,) bool whether it is seen."""
        share, seen = np.zeros(len(at)), np.zeros(len(at), bool)
        for number, rows in self.rows.items():
            if number in shot.views:
                share[rows] = self.share(shot, number, rows, at[rows], level)
                seen[rows] = shot.shows(number, at[rows])
        return share, seen

    def share(
        self,
        shot: TorsoShot,
        number: int,
        rows: np.ndarray,
        at: np.ndarray,
        level: int,
        weights: np.ndarray = CHANNEL_WEIGHTS,
    ) -> np.ndarray:
        """(M,) from 0 to 1: how little a camera's image at points (M, 3) looks like the reference
        of the rows."""
        squared = self.residual(shot, number, rows, at, level) ** 2 @ weights
        return np.asarray(squared / (OUTLIER_SQUARED[level] + squared))

    def residual(
        self, shot: TorsoShot, number: int, rows: np.ndarray, at: np.ndarray, level: int
    ) -> np.ndarray:
        """Channels (M, 3) of a camera's image at points, minus those of the reference, in
        NOISE_LEVELS."""
        own = shot.views[number].levels[level]
        values = sampled([own.channels], own.camera.project(at)[0])[0]
        return np.asarray((values - self.reference[level][rows]) / NOISE_LEVELS)


def seen_points(take: TorsoTake, timestep: int) -> SeenPoints:
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
        pixels = {
            number: own.camera.project(every[rows[number]])[0] for number, own in images.items()
        }
        values = [sampled([own.channels], pixels[number])[0] for number, own in images.items()]
        reference.append(np.concatenate(values) if values else np.zeros((0, 3)))
    ray = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    return SeenPoints(timestep, rows, every, ray, np.concatenate(fitted), reference)


def _below_head(
    take: TorsoTake, timestep: int, mesh: np.ndarray, number: int, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) on the rays of the pixels below the head, as deep as the mesh beside them;
    which are fitted."""
    from scipy.spatial import cKDTree

    mask = take.cameras[number].mask(timestep)
    assert mask is not None
    pixels, depth = camera.project(mesh[take.model.faces].mean(1))
    step = max(1.0, POINT_STEP_M * camera.fl_x / float(np.median(depth)))
    rows, columns = np.indices((int(camera.height / step), int(camera.width / step)))
    at = (np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5) * step
    x, y = at.astype(int).T
    _, nearest = cKDTree(pixels).query(at)
    shown = grown(mask > 127, MASK_MARGIN) & ~take.head_pixels(mesh, camera)
    kept = np.flatnonzero(shown[y, x] & take.torso[nearest])
    kept = kept[:: max(1, -(-len(kept) // MAX_POINTS))]
    block = (rows // BLOCK_POINTS + columns // BLOCK_POINTS).ravel()[kept]
    return camera.unproject(at[kept], depth[nearest[kept]]), block % HELD_OUT != 0


class Carrier:
    """The torso's triangles, which carry points as they carry splats: each the nearest one."""

    def __init__(self, take: TorsoTake, first: PosedTorso, at: np.ndarray) -> None:
        """at (N, 3): where the points are at first."""
        from scipy.spatial import cKDTree

        candidates = np.flatnonzero(take.torso)
        centers = take.mesh(first.parameters)[take.model.faces[candidates]].mean(1)
        used, self._face = np.unique(candidates[cKDTree(centers).query(at)[1]], return_inverse=True)
        self._corners = PosedPoints(
            take.model, SurfacePoints(np.repeat(used, 3), np.tile(np.eye(3), (len(used), 1)))
        )
        self._take, self._vertices = take, take.model.faces[used].ravel()
        self._neutral = take.model.v_template[self._vertices]
        self._triangles = np.arange(3 * len(used)).reshape(-1, 3)
        self._first = self._frames(first)

    def carried(self, torso: PosedTorso) -> Callable[[np.ndarray], np.ndarray]:
        """What brings the points (N, 3) from where they are at first to where this torso has
        them."""
        before, after, face = self._first, self._frames(torso), self._face
        turn = (
            (after.scale / before.scale)[:, None, None]
            * after.rotation
            @ before.rotation.swapaxes(1, 2)
        )
        return lambda at: (
            np.einsum("nij,nj->ni", turn[face], at - before.origin[face]) + after.origin[face]
        )

    def _frames(self, torso: PosedTorso) -> FaceFrames:
        if torso.shift is None:
            corners = self._corners.positions(
                torso.parameters[:-RIGID_SIZE], torso.parameters[-RIGID_SIZE:]
            )
        else:
            corners = self._take.rigid(torso.parameters, self._vertices) + torso.shift
        return face_frames(corners, self._triangles, self._neutral)


def compared(
    take: TorsoTake,
    seen: Mapping[str, SeenPoints],
    motions: Mapping[str, Motion],
    timesteps: Sequence[int],
) -> dict[str, float]:
    """Motion -> mean misfit of the points that were not fitted, where all motions leave them in
    sight."""
    first = seen["head"]
    carriers = {
        name: Carrier(take, own[first.timestep], seen[name].at) for name, own in motions.items()
    }
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


def at_depth(
    take: TorsoTake, seen: SeenPoints, motions: Mapping[str, Motion]
) -> dict[str, SeenPoints]:
    """Motion -> the points at the depths along their rays at which other cameras, and other
    timesteps of the motion, look like them; "stereo": of other cameras alone."""
    candidates = [seen.at + depth * seen.ray for depth in DEPTHS_M]
    shot, stereo = take.shot(seen.timestep), np.zeros((len(DEPTHS_M), len(seen.at)))
    for number, rows in seen.rows.items():
        for other in shot.views.keys() - {number}:
            for cost, at in zip(stereo, candidates, strict=True):
                share = seen.share(shot, other, rows, at[rows], EVIDENCE_LEVEL, ALONG_CAMERAS)
                cost[rows] += np.where(shot.shows(other, at[rows]), share, UNSEEN_COST)
    costs = {"stereo": stereo, **{name: stereo.copy() for name in motions}}
    carriers = {name: Carrier(take, own[seen.timestep], seen.at) for name, own in motions.items()}
    known = sorted(set.intersection(*(set(own) for own in motions.values()))) if motions else []
    for timestep in evenly_spread([t for t in known if t != seen.timestep], DEPTH_TIMESTEPS):
        shot = take.shot(timestep)
        for name, own in motions.items():
            carried = carriers[name].carried(own[timestep])
            for cost, at in zip(costs[name], candidates, strict=True):
                share, shown = seen.unexplained(shot, carried(at), EVIDENCE_LEVEL)
                cost += np.where(shown, share, UNSEEN_COST)
    return {name: _moved_in_depth(seen, cost) for name, cost in costs.items()}


def _moved_in_depth(seen: SeenPoints, cost: np.ndarray) -> SeenPoints:
    """The points where the cost (DEPTHS_M, N), averaged over neighbors, is least; where it tells
    nothing, as they are."""
    from scipy.spatial import cKDTree

    moved = seen.at.copy()
    for rows in seen.rows.values():
        if len(rows) >= NEIGHBORS and np.ptp(cost[:, rows]) > 0:
            near = rows[cKDTree(seen.at[rows]).query(seen.at[rows], NEIGHBORS)[1]]
            depth = np.zeros(len(moved))
            depth[rows] = np.array(DEPTHS_M)[cost[:, near].mean(2).argmin(0)]
            moved[rows] += np.median(depth[near], axis=1)[:, None] * seen.ray[rows]
    return replace(seen, at=moved)
