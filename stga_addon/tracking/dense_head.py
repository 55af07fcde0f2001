"""Points of a person's face that dense tracking compares with images, by texture and by optical
flow."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..capture.mesh_geometry import facing, vertex_normals
from ..flame.forward import RIGID_SIZE, flame_forward, frame_of
from ..flame.model import EYEBALL_WEIGHT, JOINTS, FlameModel
from ..flame.quaternions import unit
from . import appearance
from .appearance import Sample, Texture, Views
from .fit import RecordedTake
from .head_model import HeadModel
from .observed_surface import (
    VisiblePoints,
    in_sight,
    large_parts,
    rounded_direction,
    surface_points,
)
from .posed_points import PosedPoints, head_rotation, split
from .solve import prior_terms

HEAD_POINTS = 5000
"""Points over the whole head, of which those near landmarks are used; the landmarks' places come on
top, because they are dense at eyes and lips."""
FACE_RADIUS_M = 0.035
"""Distance from the landmarks beyond which there is hair and clothes."""
LID_DISTANCE_M = 0.005
"""Distance from an eyeball up to which a landmark is one of the lids' edges."""
HELD_OUT = 8
"""One point of so many is held out, and shows whether the fit is better."""
STEPS = (1, 2, 2, 3)
"""One point of so many is fitted, for each level."""
REGIONS = ("lower face", "middle face", "eyes", "brows")
"""Parts of the face from the chin up, whose misfit is reported apart."""
REGION_EDGES = (0.4, 0.62, 0.735)
"""Edges of the REGIONS, in the landmarks' height on the neutral head."""
UPPER_FACE = 2
"""Regions from this one on stay where they are when the mouth opens."""
CHIN_FRACTION = 0.12
"""Landmarks in this lowest fraction of the landmarks' height are the chin's."""
CHIN_DIRECTION = np.array([0.0, -1.0, -0.4])
"""Direction in which an opening jaw moves the chin, in the head's axes."""
OPENING_SIGMA_M = 0.002
"""Standard deviation of the chin's height from the one that is asked for."""
MIN_COSINE = 0.25
"""Cosine between normal and camera below which a point is not compared."""
VISIBILITY_SIDE_PX = 110
"""Side of the depth image that hidden points are found in."""
DIRECTIONS = 8
"""Steps of a direction's coordinates within which a head hides the same of itself."""
OPENING_STEP_M = 0.008
"""Step of the chin's height within which a head hides the same of itself."""
REST_QUANTILE = 0.2
"""Fraction of the timesteps at which a region moves so little that it is at rest."""
REST_SCALE_M = 0.002
"""Additional distance that a region at rest may move."""
HELD_OUT_LEVEL = len(appearance.LEVELS_M)
"""Stands for the points that are not fitted, where a level is asked for."""
ALL_POINTS = HELD_OUT_LEVEL + 1
"""Stands for all points, where a level is asked for."""

NO_TEXTURE = Texture({}, {}, np.zeros(0))


def in_single_precision(model: FlameModel) -> FlameModel:
    names = ("v_template", "shapedirs", "posedirs", "j_regressor", "weights")
    return replace(model, **{name: getattr(model, name).astype(np.float32) for name in names})


@dataclass(frozen=True)
class Misfit:
    """Fraction in 0…1 of the images that points do not explain: of all points, and by region (R,);
    0 where no point is visible."""

    all: float
    regions: np.ndarray


class DenseHead:
    """N points on a person's face; parameters (E + 18,) are those of `HeadFit`."""

    def __init__(self, head: HeadModel, take: RecordedTake, texture: Texture = NO_TEXTURE) -> None:
        """texture: of the points, which `photo_term` and `misfit` compare with images."""
        from scipy.spatial import cKDTree

        self.head = head
        self._texture = texture
        model = head.model
        places = take.places
        reliable = take.reliable
        template = model.v_template
        faces = model.faces
        self.landmarks = PosedPoints(model, places)
        at = places.on(template, faces)
        skin = large_parts(model)[places.face]
        eyeballs = model.weights[:, [JOINTS.index(f"{side}_eye") for side in ("left", "right")]]
        balls = template[(eyeballs > EYEBALL_WEIGHT).any(1)]
        on_lids = cKDTree(balls).query(at)[0] < LID_DISTANCE_M if len(balls) else False
        # (L,) bool: landmarks on eyeballs and teeth, and at what covers and uncovers eyeballs
        self.inner = ~skin | on_lids
        used = reliable & skin
        used = used if used.any() else reliable
        points = surface_points(head, HEAD_POINTS)
        distance, _ = cKDTree(at[used]).query(points.on(template, faces))
        self.points = points[distance < FACE_RADIUS_M] + places[used]
        held = np.arange(len(self.points)) % HELD_OUT == 0
        fitted = np.flatnonzero(~held)
        others = np.flatnonzero(held)
        self.rows = [*(fitted[::step] for step in STEPS), others, np.arange(len(self.points))]
        single = in_single_precision(model)  # images determine no more
        self._posed = [PosedPoints(single, self.points[rows]) for rows in self.rows]
        height = at[:, 1]
        low = height[reliable].min()
        high = height[reliable].max()
        edges = low + (high - low) * np.array(REGION_EDGES)
        self.landmark_region = np.digitize(height, edges)
        self.region = np.digitize(self.points.on(template, faces)[:, 1], edges)
        self._chin = reliable & (height < low + CHIN_FRACTION * (high - low))
        self._fixed = reliable & (self.landmark_region >= UPPER_FACE)
        rest = np.zeros(model.n_expression), np.zeros(RIGID_SIZE)
        smooth = unit(self.points.on(vertex_normals(template, faces), faces))
        self._bend = smooth - self._posed[ALL_POINTS].triangle_normals(*rest)
        self._visible: VisiblePoints = {}

    def positions(self, values: np.ndarray, level: int = ALL_POINTS) -> np.ndarray:
        """(M, 3) of the points of a level, which are `rows[level]`."""
        return self._posed[level].positions(*split(values))

    def linearized(self, values: np.ndarray, level: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions (M, 3) of the points of a pyramid level, and their derivatives
        (M, 3, K + 18) by `values`."""
        return self._posed[level].linearized(*split(values))

    def light_basis(self, values: np.ndarray, level: int = ALL_POINTS) -> np.ndarray:
        """(M, 9) of the smooth normals of a level's points."""
        bend = self._bend[self.rows[level]] @ head_rotation(values).T
        flat = self._posed[level].triangle_normals(*split(values))
        return appearance.light_basis(unit(flat + bend))

    def visibility(self, values: np.ndarray, views: Views) -> np.ndarray:
        """(C, N) squared cosine at which each camera sees each point, 0 where the head hides it;
        kept by direction and by how far the mouth is open."""
        at = self.positions(values)
        turn = head_rotation(values)
        opening = round(self.opening(values) / OPENING_STEP_M)
        weights = []
        faces = self.head.model.faces
        for camera in (view.camera for view in views):
            key = opening, *rounded_direction((camera.position - at.mean(0)) @ turn, DIRECTIONS)
            if key not in self._visible:
                vertices = flame_forward(self.head.model, np.zeros(0), frame_of(values))
                normals = self.points.on(vertex_normals(vertices, faces), faces)
                cosine = facing(camera, at, unit(normals))
                fraction = min(1.0, VISIBILITY_SIDE_PX / max(camera.width, camera.height))
                visible = in_sight(camera.scaled(fraction), vertices, faces, at)
                self._visible[key] = np.where((cosine > MIN_COSINE) & visible, cosine**2, 0.0)
            weights.append(self._visible[key])
        return np.stack(weights)

    def opening(self, values: np.ndarray) -> float:
        """Height in meters of the upper face above the chin."""
        height = (self.landmarks.positions(*split(values)) @ head_rotation(values))[:, 1]
        apart = height[self._fixed].mean() - height[self._chin].mean() if self._fixed.any() else 0
        return float(apart)

    def opened(self, values: np.ndarray, distance: float) -> np.ndarray:
        """Parameters whose chin lies so many meters lower, with the upper face where it is."""
        _, jacobian = self.landmarks.linearized(*split(values))
        wanted = np.where(
            self._chin[:, None], distance * CHIN_DIRECTION @ head_rotation(values).T, 0.0
        )
        use = self._chin | self._fixed
        moving = jacobian[use].reshape(-1, len(values)) / OPENING_SIGMA_M
        moving[:, -RIGID_SIZE : -RIGID_SIZE + 3] = moving[:, -3:] = 0  # the head stays
        matrix = moving.T @ moving + np.diag(prior_terms(self.head, values)[0])
        return values + np.linalg.solve(matrix, moving.T @ wanted[use].ravel() / OPENING_SIGMA_M)

    def rest(self, take: Sequence[np.ndarray]) -> np.ndarray:
        """(T, N) weights of the timesteps' parameters for a point's texture: 1 where its region is
        at rest, where detectors are mostly right; low where it has moved far."""
        moved: Any = []
        regions, of_region = np.unique(self.region, return_inverse=True)
        for values in take:
            still = values.copy()
            still[:-RIGID_SIZE] = 0
            still[-RIGID_SIZE + 3 : -3] = 0
            distance = ((self.positions(values) - self.positions(still)) ** 2).sum(1)
            by_region = (distance[self.region == region] for region in regions)
            moved.append([np.sqrt(squared.mean()) for squared in by_region])
        beyond = np.maximum(moved - np.quantile(moved, REST_QUANTILE, axis=0), 0)
        return appearance.robust(beyond, REST_SCALE_M)[:, of_region]

    def samples(self, views: Views, values: np.ndarray, weight: np.ndarray) -> list[Sample]:
        """What the views show of the points; weight (C, N)."""
        at = self.positions(values)
        basis = self.light_basis(values)
        found = []
        for view, view_weight in zip(views, weight, strict=True):
            projected = [level.camera.project(at) for level in view.levels]
            levels = [
                appearance.sampled([level.channels], pixels)[0].astype(np.float64)
                for level, (pixels, _) in zip(view.levels, projected, strict=True)
            ]
            inside = appearance.inside(view.levels[0].camera, *projected[0])
            found.append(Sample(view.key, levels, basis, view_weight * inside))
        return found

    def photo_term(
        self, views: Views, visible: np.ndarray, values: np.ndarray, level: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Gauss–Newton terms of a level's points by their positions: H (M, 3, 3) and b (M, 3)."""
        at = self.positions(values, level)
        matrix = np.zeros((len(at), 3, 3))
        right = np.zeros((len(at), 3))
        basis = self.light_basis(values, level)
        rows = self.rows[level]
        for view, visibility in zip(views, visible, strict=True):
            image = view.levels[level]
            pixels, depth = image.camera.project(at)
            within = appearance.inside(image.camera, pixels, depth)
            weight = visibility[rows] * self._texture.trust[rows] * within
            near = np.flatnonzero(weight)
            if not len(near):
                continue
            channels, *slopes = appearance.sampled([image.channels, *image.gradient], pixels[near])
            known = self._texture.values[view.key][level][rows[near]], basis[near], weight[near]
            lit = appearance.relit(channels, *known, self._texture.lights[view.key])
            residual = (channels - lit) / appearance.NOISE_LEVELS
            used = weight[near] * appearance.point_weights(residual, level)
            by_x, by_y = (slope / appearance.NOISE_LEVELS for slope in slopes)
            # The channels' slopes along x and y, multiplied and summed, before they become those by
            # position.
            pairs = (by_x, by_x), (by_x, by_y), (by_y, by_y), (by_x, residual), (by_y, residual)
            sums = ((one * other) @ appearance.CHANNEL_WEIGHTS for one, other in pairs)
            xx, xy, yy, x, y = ((used * pair_sum)[:, None] for pair_sum in sums)
            of_x, of_y = appearance.projection_derivative(image.camera, at[near]).swapaxes(0, 1)
            along_x = xx * of_x + xy * of_y
            along_y = xy * of_x + yy * of_y
            matrix[near] += of_x[:, :, None] * along_x[:, None]
            matrix[near] += of_y[:, :, None] * along_y[:, None]
            right[near] -= x * of_x + y * of_y
        return matrix, right

    def misfit(
        self, views: Views, visible: np.ndarray, values: np.ndarray, points: int, level: int
    ) -> Misfit:
        """How badly a level's images are explained at the points of a level."""
        at = self.positions(values, points)
        basis = self.light_basis(values, points)
        rows = self.rows[points]
        total = np.zeros(len(REGIONS))
        weights = np.zeros(len(REGIONS))
        for view, visibility in zip(views, visible, strict=True):
            weight = visibility[rows] * self._texture.trust[rows]
            image = view.levels[level]
            pixels, depth = image.camera.project(at)
            inside = appearance.inside(image.camera, pixels, depth)
            (found,) = appearance.sampled([image.channels], pixels)
            known = self._texture.values[view.key][level][rows], basis, weight * inside
            lit = appearance.relit(found, *known, self._texture.lights[view.key])
            residual = (found - lit) / appearance.NOISE_LEVELS
            fraction = np.where(inside, appearance.unexplained(residual, level), 1.0)
            total += np.bincount(self.region[rows], weight * fraction, len(REGIONS))
            weights += np.bincount(self.region[rows], weight, len(REGIONS))
        regions = total / np.maximum(weights, 1e-9)
        return Misfit(float(total.sum() / max(weights.sum(), 1e-9)), regions)

    def flow_start(
        self, before: Views, visible: np.ndarray, values: np.ndarray, now: Views
    ) -> np.ndarray:
        """Parameters at a timestep to which optical flow carries the head from another one, which
        `before`, visible (C, N) and values describe."""
        start = self.positions(values, appearance.FLOW_POINTS)
        targets = list(appearance.flow_targets(start, before, now))
        rows = self.rows[appearance.FLOW_POINTS]
        moved = values
        weights = {
            view.key: visibility[rows] for view, visibility in zip(before, visible, strict=True)
        }
        for _ in range(appearance.FLOW_ITERATIONS):
            at, jacobian = self.linearized(moved, appearance.FLOW_POINTS)
            precision, right = prior_terms(self.head, moved)
            matrix = np.diag(precision)
            for key, camera, target in targets:
                miss = camera.project(at)[0] - target
                weight = np.repeat(weights[key] * appearance.flow_weights(miss), 2)
                rate = appearance.projection_derivative(camera, at) @ jacobian
                flat = rate.reshape(len(weight), -1)
                matrix = matrix + (flat.T * weight) @ flat
                right = right - flat.T @ (weight * miss.ravel())
            moved = moved + np.linalg.solve(matrix, right)
        return moved
