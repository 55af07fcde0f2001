"""The torso's surface as it bends: cloth wrinkles and slides, which a rigid torso cannot follow.

FLAME's mesh ends in shoulders that are a hand wide, on which splats of clothes could only move as
one. Its edge is stretched over the torso as far as cameras see it: then triangles lie where the
splats are, and vertices can bend them.

Each image is warped to a reference timestep. Optical flow between the two measures what the torso's
motion so far misses, and the vertices of its sheet move by that, of all cameras together and
smoothly.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..capture.mesh_geometry import rasterize
from ..flame.model import FlameModel, torso_faces
from ..worker.helpers import Step
from . import appearance
from .appearance import NOISE_LEVELS, box_of, inside, sampled
from .fit import posed_mesh
from .folder import TorsoPoints
from .posed_points import head_rotation
from .torso_take import HELD_OUT, BothWays, Motion, Rows, TorsoShot, TorsoTake, states_along

BLOCK_PX = 12
"""Side of blocks of pixels; one in HELD_OUT is held out, and shows whether to bend."""
ROUGHNESS_M = 0.0005
"""Standard deviation of a vertex from the mean of its neighbors."""
BEND_SIGMA_M = 0.02
"""Standard deviation of a vertex from the rigid torso."""
FLOW_SIGMA_PX = 0.5
"""Standard deviation of optical flow."""
FLOW_FRACTION = 0.3
"""Fraction of the fitted pixels that are independent of each other."""
FLOW_OUTLIER_PX = 4.0
"""Distance beyond which flow is wrong."""
CHANGE_OUTLIER_LEVELS = 5 * NOISE_LEVELS
"""Difference of what flow matches beyond which it is wrong."""
FLOW_MARGIN_PX = 32
"""Margin around the sheet in the images of optical flow."""
PIXEL_STEP = 6
"""One of so many pixels is fitted."""
MIN_GAIN = 0.05
"""Fraction by which the misfit has to fall for the torso to bend."""
MAX_STEPS = 4
"""Gauss–Newton steps for each timestep."""
CONVERGED_STEP_M = 0.0004
"""Root mean square of a step after which there is none: smaller ones follow the noise of optical
flow."""
HELD = 1e10
"""Precision that holds a vertex."""
DEPTH_SIGMA_M = 0.02
"""Distance over which points' depths are averaged."""
MIN_WEIGHT = 0.5
"""Sum of weights from which the surface is observed."""
DIRECTIONS_RAD = np.radians(np.arange(-80, 81, 5))
"""Directions from the base of the neck, seen from the front: 0 is down, positive the person's
left."""
SLOPE = 0.8
"""Factor on the angle around the neck, because shoulders slope down."""
REACH_RAD = np.radians(10)
"""Angle of a direction to both sides."""
DIRECTION_SIGMA = 1.0
"""Standard deviation, in steps, of the smoothing of what is found in the directions."""
MIN_POINTS = 5
"""Points without which a direction is not observed."""
FARTHEST_FRACTION = 0.98
"""Fraction of a direction's points that the mesh reaches."""
BEYOND_M = 0.015
"""Distance that the mesh reaches beyond these."""
FULL_HEIGHT = 0.5  # Height (see `TorsoSheet`) from which vertices lie on the surface alone


@dataclass(frozen=True)
class TorsoSheet:
    """The torso's part of a head model's mesh.

    vertices   (N,) ids
    triangles  (F,) bool of the whole mesh
    laplacian  sparse (N, N): number of a vertex's neighbors, and −1 for each
    height     (N,) from 0 where it joins the head to 1 at the mesh's end
    """

    vertices: np.ndarray
    triangles: np.ndarray
    laplacian: Any
    height: np.ndarray


def torso_sheet(model: FlameModel) -> TorsoSheet | None:
    """The torso of a head model; None where it does not end in an open rim below the head."""
    from scipy.sparse import coo_array, csgraph
    from scipy.sparse.linalg import spsolve

    torso = torso_faces(model)
    vertices = np.unique(model.faces[torso])
    used, count = np.unique(_edges(model.faces), axis=0, return_counts=True)
    rim = np.intersect1d(used[count == 1], vertices)
    top = np.setdiff1d(np.intersect1d(model.faces[~torso], vertices), rim)
    if not len(rim) or not len(top):
        return None
    a, b = np.searchsorted(vertices, np.unique(_edges(model.faces[torso]), axis=0)).T
    near = coo_array((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, a])), shape=(len(vertices),) * 2)
    if csgraph.connected_components(near)[0] > 1:
        return None
    laplacian = csgraph.laplacian(near).tocsr()
    height = np.zeros(len(vertices))
    height[np.searchsorted(vertices, rim)] = 1
    inner = np.flatnonzero(~np.isin(vertices, np.concatenate([rim, top])))
    height[inner] = spsolve(laplacian[inner][:, inner].tocsc(), -(laplacian[inner] @ height))
    return TorsoSheet(vertices, torso, laplacian, height)


def draped(sheet: TorsoSheet, at: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Where the sheet's vertices (N, 3) lie when it is drawn over the surface that points (P, 3)
    show.

    Both in meters along the torso's axes, from the base of the neck: x to the person's left, y up,
    z forward. The ring around the neck is unrolled into the plane of these x and y: its front
    straight down, its sides toward the shoulders. Vertices where nothing is seen, as at the back,
    stay.
    """
    from scipy.ndimage import gaussian_filter1d

    # how far the points reach in directions around the neck, and how surely these are seen
    angle = np.arctan2(points[:, 0], -points[:, 1])
    distance = np.linalg.norm(points[:, :2], axis=1)
    found = np.zeros(len(DIRECTIONS_RAD))
    observed = np.zeros(len(DIRECTIONS_RAD))
    for number, direction in enumerate(DIRECTIONS_RAD):
        near = np.abs(angle - direction) < REACH_RAD
        if near.sum() >= MIN_POINTS:
            found[number] = np.quantile(distance[near], FARTHEST_FRACTION) + BEYOND_M
            observed[number] = 1
    sure = gaussian_filter1d(observed, DIRECTION_SIGMA, mode="constant")
    found = gaussian_filter1d(found, DIRECTION_SIGMA, mode="constant") / np.maximum(sure, 1e-6)
    around = SLOPE * np.arctan2(at[:, 0], at[:, 2])
    is_observed, reach_m, certainty = (
        np.interp(around, DIRECTIONS_RAD, values, 0, 0) for values in (observed, found, sure)
    )
    trust = np.where(is_observed > 0.5, certainty, 0.0)
    outer = reach_m[:, None] * np.stack([np.sin(around), -np.cos(around)], axis=1)
    flat = at[:, :2] + sheet.height[:, None] * (outer - at[:, :2])
    near = np.exp(-((flat[:, None] - points[:, :2]) ** 2).sum(2) / (2 * DEPTH_SIGMA_M**2))
    weight = near.sum(1)
    target = np.column_stack([flat, near @ points[:, 2] / np.maximum(weight, 1e-9)])
    fraction = np.minimum(sheet.height / FULL_HEIGHT, 1) * trust * (weight > MIN_WEIGHT)
    return at + fraction[:, None] * (target - at)


def _edges(faces: np.ndarray) -> np.ndarray:
    """(3 F, 2) vertex ids, the smaller one first."""
    return np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)


@dataclass(frozen=True)
class Bending:
    """A torso that bends, by offsets of its vertices in its own axes, in meters.

    vertices  (N,) ids of those that may move
    drape     (V, 3) that draw the mesh over the torso
    bends     timestep -> (N, 3) beside these
    """

    vertices: np.ndarray
    drape: np.ndarray
    bends: Mapping[int, np.ndarray]

    def at(self, timestep: int) -> np.ndarray:
        """All offsets (V, 3) of a timestep."""
        whole = self.drape.copy()
        whole[self.vertices] += self.bends[timestep]
        return whole


def found_bending(
    take: TorsoTake, motion: Motion, points: TorsoPoints, some: Sequence[int], walk: BothWays
) -> Bending | None:
    """The bending of a torso with a rigid motion; None where it does not explain images better."""
    sheet = torso_sheet(take.model)
    if sheet is None:
        return None
    first = motion[points.timestep]
    turn = head_rotation(first.parameters)
    base = take.joints(first.parameters)[0]
    base = base + first.parameters[-3:] + first.shift
    before = (take.rigid(first, sheet.vertices) - base) @ turn
    drape = draped(sheet, before, (points.at - base) @ turn) - before
    cloth = _Cloth(take, sheet, motion, points.timestep, drape)
    (found,) = walk.along(_Cloth.follow, [cloth], points.timestep, motion)
    bends = {timestep: arrays["bend"] for timestep, arrays in found.items()}
    rigid, bent = cloth.misfit(bends, [t for t in some if t != points.timestep])
    if not bent < (1 - MIN_GAIN) * rigid:
        return None
    whole = np.zeros_like(take.model.v_template)
    whole[sheet.vertices] = drape
    return Bending(sheet.vertices, whole, bends)


@dataclass(frozen=True)
class _Reference:
    """What a camera, whose images have a shape, shows of the sheet at the first timestep, in P
    pixels of a part (H, W) of its image: where they are, the part's luma (H, W) uint8, of the
    pixels rows (P, 3) of the sheet's vertices, barycentric coordinates (P, 3), and whether they are
    fitted (P,)."""

    shape: tuple[int, ...]
    covered: np.ndarray
    luma: np.ndarray
    corners: np.ndarray
    barycentric: np.ndarray
    fitted: np.ndarray

    @cached_property
    def pixels(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns (P,)."""
        rows, columns = np.nonzero(self.covered)
        return rows, columns


@dataclass(frozen=True)
class _Returned:
    """An image of another timestep brought back to the reference: its luma (H, W), of the P
    pixels the positions (P, 3), the pixels (P, 2) that show them there, and whether they do
    (P,)."""

    luma: np.ndarray
    at: np.ndarray
    source: np.ndarray
    visible: np.ndarray


class _Cloth:
    """How the sheet bends: (N, 3) offsets of its vertices in the torso's axes, in meters."""

    def __init__(
        self, take: TorsoTake, sheet: TorsoSheet, motion: Motion, first: int, drape: np.ndarray
    ) -> None:
        """motion: of the rigid torso; drape (N, 3): that draws the sheet over the surface, in the
        torso's axes; first: the timestep that the others are compared with."""
        from scipy.sparse import diags_array, eye_array, kron

        self._take = take
        self._sheet = sheet
        self._motion = motion
        self._drape = drape
        mean = diags_array(1 / sheet.laplacian.diagonal()) @ sheet.laplacian
        held = HELD * ~drape.any(1)
        prior = mean.T @ mean / ROUGHNESS_M**2 + diags_array(BEND_SIGMA_M**-2 + held)
        self._precision = kron(prior, eye_array(3)).tocsr()
        shot = take.shot(first)
        model = take.model
        mesh = posed_mesh(take.fit, motion[first].parameters)
        mesh[sheet.vertices] = self._positions(first, np.zeros_like(drape))
        self._references: dict[int, _Reference] = {}
        for number, view in shot.views.items():
            triangle, barycentric = rasterize(mesh, model.faces, view.levels[0].camera)
            covered = (triangle >= 0) & sheet.triangles[np.maximum(triangle, 0)]
            rows, columns = np.nonzero(covered)
            corners = np.searchsorted(sheet.vertices, model.faces[triangle[rows, columns]])
            weights = barycentric[rows, columns]
            at = np.einsum("pk,pki->pi", weights, mesh[sheet.vertices][corners])
            visible = self._visible(shot, number, *view.levels[0].camera.project(at))
            covered[rows, columns] = visible
            fitted = (rows // BLOCK_PX + columns // BLOCK_PX) % HELD_OUT != 0
            chosen = corners[visible], weights[visible], fitted[visible]
            part = box_of(covered, FLOW_MARGIN_PX)
            bright = view.levels[0].luma[part].copy()  # in one piece
            self._references[number] = _Reference(covered.shape, covered[part], bright, *chosen)

    def follow(self, way: Sequence[int], step: Step) -> Rows:
        """Offsets at the timesteps of a way, which begins with the first one, where they are 0."""

        def bent(_: TorsoShot, now: TorsoShot, bend: np.ndarray) -> np.ndarray:
            for _step in range(MAX_STEPS):
                last = bend
                bend = self._moved(now, last)
                if ((bend - last) ** 2).sum(1).mean() < CONVERGED_STEP_M**2:
                    break
            return bend

        first = np.zeros_like(self._drape)
        return {"bend": states_along(self._take, way, first, bent, step)}

    def misfit(self, bends: Mapping[int, np.ndarray], timesteps: Sequence[int]) -> list[float]:
        """Fraction in 0…1 of held-out pixels that is not explained: by the rigid torso, and by the
        bent one."""
        total = np.zeros(2)
        count = 0
        rigid = np.zeros_like(self._drape)
        for timestep in timesteps:
            shot = self._take.shot(timestep)
            for number in self._numbers(shot):
                reference = self._references[number]
                each = rigid, bends[timestep]
                both = [self._returned(shot, number, bend) for bend in each]
                use = both[0].visible & both[1].visible & ~reference.fitted
                change = np.stack(
                    [returned.luma.astype(float) - reference.luma for returned in both]
                )
                squared = change[:, *reference.pixels][:, use] ** 2
                total += (squared / (CHANGE_OUTLIER_LEVELS**2 + squared)).sum(1)
                count += int(use.sum())
        return [float(fraction) for fraction in total / max(count, 1)]

    def _numbers(self, shot: TorsoShot) -> list[int]:
        """Numbers of the cameras that see the sheet at first and now, in images of one size."""
        return [
            number
            for number, reference in self._references.items()
            if number in shot.views
            and reference.corners.size
            and shot.views[number].levels[0].channels.shape[:2] == reference.shape
            and min(reference.covered.shape) >= appearance.MIN_FLOW_SIDE_PX
        ]

    def _positions(self, timestep: int, bend: np.ndarray) -> np.ndarray:
        """(N, 3) of the sheet's vertices."""
        torso = self._motion[timestep]
        drawn = self._drape + bend
        rigid = self._take.rigid(torso, self._sheet.vertices)
        return rigid + drawn @ head_rotation(torso.parameters).T

    @staticmethod
    def _visible(shot: TorsoShot, number: int, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """(P,) bool: points that lie in the mask and are not hidden by the head; pixels (P, 2) of
        the finest image, which project one of another size alike."""
        finest = shot.views[number].levels[0].camera
        size = np.array([finest.width, finest.height])
        mask = shot.masks[number]
        head = shot.heads[number]
        fraction = sampled([mask], pixels * (mask.shape[::-1] / size))[0]
        (height, width) = head.shape
        x, y = np.clip(pixels * ([width, height] / size), 0, [width - 1, height - 1]).astype(int).T
        return inside(finest, pixels, depth) & (fraction > 127) & ~head[y, x]

    def _returned(self, shot: TorsoShot, number: int, bend: np.ndarray) -> _Returned:
        reference = self._references[number]
        corners = self._positions(shot.timestep, bend)[reference.corners]
        at = np.einsum("pk,pki->pi", reference.barycentric, corners)
        source, depth = shot.views[number].levels[0].camera.project(at)
        returned = reference.luma.copy()
        values = sampled([shot.views[number].levels[0].luma.astype(np.float32)], source)[0]
        returned[reference.pixels] = values.astype(np.uint8)
        return _Returned(returned, at, source, self._visible(shot, number, source, depth))

    def _moved(self, shot: TorsoShot, bend: np.ndarray) -> np.ndarray:
        """The offsets after a Gauss–Newton step."""
        from scipy.sparse import csr_array, diags_array

        matrix = self._precision
        right = -(self._precision @ bend.ravel())
        axes = head_rotation(self._motion[shot.timestep].parameters)
        for number in self._numbers(shot):
            reference = self._references[number]
            now = self._returned(shot, number, bend)
            miss, weight = _missed(reference, now)
            used = np.flatnonzero(weight)[::PIXEL_STEP]
            turned = (
                appearance.projection_derivative(shot.views[number].levels[0].camera, now.at[used])
                @ axes
            )
            rates = turned[:, :, None, :] * reference.barycentric[used][:, None, :, None]
            rows = np.broadcast_to(np.arange(2 * len(used)).reshape(-1, 2, 1, 1), rates.shape)
            moved = 3 * reference.corners[used][..., None] + np.arange(3)
            places = rows.ravel(), np.broadcast_to(moved[:, None], rates.shape).ravel()
            rate = csr_array((rates.ravel(), places), shape=(2 * len(used), bend.size))
            precision = np.repeat(FLOW_FRACTION / FLOW_SIGMA_PX**2 * weight[used], 2)
            weighted = rate.T @ diags_array(precision)
            matrix = matrix + weighted @ rate
            right = right + weighted @ miss[used].ravel()
        return bend + _solved(matrix.tocsr(), right).reshape(-1, 3)


def _solved(matrix: Any, right: np.ndarray) -> np.ndarray:
    """Solution (M,) of equations with a sparse, symmetric, positive definite matrix (M, M), in a
    narrow band once they are ordered (reverse Cuthill-McKee): in a fifth of SuperLU's time."""
    from scipy.linalg import solveh_banded
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    order = reverse_cuthill_mckee(matrix, symmetric_mode=True)
    entries = matrix[order][:, order].tocoo()
    below = entries.row >= entries.col
    row = entries.row[below]
    column = entries.col[below]
    band = np.zeros(((row - column).max() + 1, len(right)))
    band[row - column, column] = entries.data[below]
    found = np.empty_like(right)
    found[order] = solveh_banded(band, right[order], lower=True)
    return found


def _missed(reference: _Reference, now: _Returned) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (P, 2) from points to where images show them, and weights (P,), 0 to 1."""
    import cv2

    opencv: Any = cv2  # whose type stubs lack DIS
    flow = opencv.DISOpticalFlow_create(opencv.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(
        reference.luma, now.luma, None
    )
    rows, columns = reference.pixels
    places = np.stack([columns, rows], axis=1) + 0.5 + flow[rows, columns]
    image = np.full((*reference.covered.shape, 3), np.nan, np.float32)
    image[rows, columns] = np.concatenate([now.source, now.luma[rows, columns][:, None]], axis=1)
    found = sampled([image], places)[0]
    weight = now.visible & reference.fitted & np.isfinite(found).all(1)
    found = np.where(weight[:, None], found, 0)
    miss = np.where(weight[:, None], found[:, :2] - now.source, 0)
    far = np.linalg.norm(miss, axis=1) / FLOW_OUTLIER_PX
    changed = (found[:, 2] - reference.luma[rows, columns]) / CHANGE_OUTLIER_LEVELS
    return miss, weight * (1 / ((1 + far**2) * (1 + changed**2)))
