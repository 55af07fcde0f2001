"""The points of a person's face that dense tracking compares with images: positions, normals,
visibility, regions."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..capture.camera import Camera
from ..capture.mesh_geometry import vertex_normals
from ..flame.forward import RIGID_SIZE, flame_forward, frame_of
from ..flame.model import EYEBALL_WEIGHT, JOINTS, FlameModel
from .appearance import LEVELS_M, light_basis, robust
from .head_model import HeadModel
from .photo_consistency import facing, in_sight
from .posed_points import PosedPoints, SurfacePoints, head_rotation
from .seen_surface import large_parts, surface_points
from .solve import prior_terms

HEAD_POINTS = 5000
"""Points over the whole head, of which those near landmarks are used; the landmarks' places come on
top, because they are dense at eyes and lips."""
FACE_RADIUS_M = 0.035  # Distance from the landmarks beyond which there is hair and clothes
LID_DISTANCE_M = 0.005
"""From an eyeball's vertices, up to which a landmark is one of the lids' edges."""
HELD_OUT = 8  # One point of so many is not fitted, and tells whether the fit is better
STEPS = (1, 2, 2, 3)  # By level: one point of so many is fitted
REGIONS = ("lower face", "middle face", "eyes", "brows")
REGION_EDGES = (0.4, 0.62, 0.735)  # Of the landmarks' height on the neutral head
UPPER_FACE = 2  # Regions from this one on stay where they are when the mouth opens
CHIN_SHARE = 0.12  # Landmarks in this lowest share of the landmarks' height are the chin's
CHIN_DIRECTION = np.array([0.0, -1.0, -0.4])  # In which an opening jaw moves it, in the head's axes
OPENING_SIGMA_M = 0.002
MIN_COSINE = 0.25  # Of the angle between normal and camera, below which a point is not compared
VISIBILITY_SIDE_PX = 110  # Size of the depth image that hidden points are found in
DIRECTIONS, OPENING_STEP_M = 8, 0.008
"""Steps of a direction's coordinates, and of the chin's height, within which a head hides the same
of itself."""
REST_QUANTILE, REST_SCALE_M = 0.2, 0.002
"""A region is at rest when it moves as little as at this share of the timesteps, within that
distance."""
HELD_OUT_LEVEL = len(LEVELS_M)
"""Stands for the points that are not fitted, where a level is asked for."""


class DenseHead:
    """N points on a person's face. Parameters (K + 18,) are those of `HeadFit` without components
    that move nothing."""

    def __init__(self, person: HeadModel, places: SurfacePoints, reliable: np.ndarray) -> None:
        model = person.model
        self.active = np.flatnonzero(np.abs(model.shapedirs).max(axis=(0, 1)) > 0)
        dirs = np.ascontiguousarray(model.shapedirs[:, :, self.active])
        names = (
            tuple(model.expression_names[k] for k in self.active) if model.expression_names else ()
        )
        self.head = replace(person, model=replace(model, shapedirs=dirs, expression_names=names))
        self.count = model.n_expression
        self.landmarks = PosedPoints(self.head.model, places)
        skin = large_parts(model)[places.face]
        self.inner = ~skin | _on_lids(model, places)
        """(L,) bool: landmarks on eyeballs and teeth, and at what covers and uncovers eyeballs."""
        used = reliable & skin
        self.points = _face_points(person, places, used if used.any() else reliable)
        held = np.arange(len(self.points)) % HELD_OUT == 0
        self.rows = [np.flatnonzero(~held)[::step] for step in STEPS] + [np.flatnonzero(held)]
        self._posed = [PosedPoints(self.head.model, _some(self.points, rows)) for rows in self.rows]
        self._all = PosedPoints(self.head.model, self.points)
        template, faces = self.head.model.v_template, self.head.model.faces
        height = places.on(template, faces)[:, 1]
        low, high = height[reliable].min(), height[reliable].max()
        edges = low + (high - low) * np.array(REGION_EDGES)
        self.landmark_region = np.digitize(height, edges)
        self.region = np.digitize(self.points.on(template, faces)[:, 1], edges)
        self._chin = reliable & (height < low + CHIN_SHARE * (high - low))
        self._fixed = reliable & (self.landmark_region >= UPPER_FACE)
        rest = np.zeros(len(self.active) + RIGID_SIZE)
        smooth = _unit(self.points.on(vertex_normals(model.v_template, model.faces), model.faces))
        self._bend = smooth - self._all.triangle_normals(*split(rest))
        self._visible: dict[tuple[int, ...], np.ndarray] = {}

    def reduced(self, parameters: np.ndarray) -> np.ndarray:
        """The active ones of parameters (E + 18,) of a `HeadFit`."""
        return np.concatenate([parameters[:-RIGID_SIZE][self.active], parameters[-RIGID_SIZE:]])

    def complete(self, values: np.ndarray) -> np.ndarray:
        """Parameters of a `HeadFit` (E + 18,) from active ones."""
        parameters = np.zeros(self.count + RIGID_SIZE)
        parameters[self.active], parameters[-RIGID_SIZE:] = split(values)
        return parameters

    def positions(self, values: np.ndarray) -> np.ndarray:
        """(N, 3) of all points."""
        return self._all.positions(*split(values))

    def level_positions(self, values: np.ndarray, level: int) -> np.ndarray:
        """(M, 3) of the points of a level, which are `rows[level]`."""
        return self._posed[level].positions(*split(values))

    def linearized(self, values: np.ndarray, level: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions (M, 3) of a level's points, and derivatives (M, 3, K + 18)."""
        return self._posed[level].linearized(*split(values))

    def light_basis(self, values: np.ndarray, level: int | None = None) -> np.ndarray:
        """(M, 9) of the smooth normals of a level's points, or of all (N, 9)."""
        rows = slice(None) if level is None else self.rows[level]
        posed = self._all if level is None else self._posed[level]
        bend = self._bend[rows] @ head_rotation(values).T
        return light_basis(_unit(posed.triangle_normals(*split(values)) + bend))

    def visibility(self, values: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
        """(C, N) squared cosine at which each camera sees each point, 0 where the head hides it;
        kept by direction and by how far the mouth is open."""
        at, turn = self.positions(values), head_rotation(values)
        opening = round(self.opening(values) / OPENING_STEP_M)
        seen, faces = [], self.head.model.faces
        for camera in cameras:
            direction = (camera.position - at.mean(0)) @ turn
            steps = np.round(DIRECTIONS * direction / np.linalg.norm(direction)).astype(int)
            key = opening, *steps.tolist()
            if key not in self._visible:
                vertices = flame_forward(self.head.model, np.zeros(0), frame_of(values))
                normals = self.points.on(vertex_normals(vertices, faces), faces)
                cosine = facing(camera, at, _unit(normals))
                share = min(1.0, VISIBILITY_SIDE_PX / max(camera.width, camera.height))
                shown = in_sight(camera.scaled(share), vertices, faces, at)
                self._visible[key] = np.where((cosine > MIN_COSINE) & shown, cosine**2, 0.0)
            seen.append(self._visible[key])
        return np.stack(seen)

    def opening(self, values: np.ndarray) -> float:
        """Height in meters of the upper face above the chin."""
        height = (self.landmarks.positions(*split(values)) @ head_rotation(values))[:, 1]
        return (
            float(height[self._fixed].mean() - height[self._chin].mean())
            if self._fixed.any()
            else 0.0
        )

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
        at rest, where detectors are mostly right, and low where it is moved far."""
        moved = []
        for values in take:
            still = values.copy()
            still[:-RIGID_SIZE], still[-RIGID_SIZE + 3 : -3] = 0, 0
            distance = ((self.positions(values) - self.positions(still)) ** 2).sum(1)
            moved.append(
                [
                    np.sqrt(distance[self.region == number].mean())
                    for number in np.unique(self.region)
                ]
            )
        beyond = np.maximum(moved - np.quantile(moved, REST_QUANTILE, axis=0), 0)
        return robust(beyond, REST_SCALE_M)[:, np.searchsorted(np.unique(self.region), self.region)]


def split(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients, and pose with translation (18,)."""
    return values[:-RIGID_SIZE], values[-RIGID_SIZE:]


def _on_lids(model: FlameModel, places: SurfacePoints) -> np.ndarray:
    """(N,) bool: places next to an eyeball."""
    from scipy.spatial import cKDTree

    eyeballs = model.weights[:, [JOINTS.index(f"{side}_eye") for side in ("left", "right")]]
    inside = model.v_template[(eyeballs > EYEBALL_WEIGHT).any(1)]
    if not len(inside):
        return np.zeros(len(places), bool)
    distance, _ = cKDTree(inside).query(places.on(model.v_template, model.faces))
    return np.asarray(distance < LID_DISTANCE_M)


def _face_points(head: HeadModel, places: SurfacePoints, used: np.ndarray) -> SurfacePoints:
    """Points near the landmarks, and those of the landmarks' places that are used."""
    from scipy.spatial import cKDTree

    template, faces = head.model.v_template, head.model.faces
    points, own = surface_points(head, HEAD_POINTS), _some(places, np.flatnonzero(used))
    distance, _ = cKDTree(own.on(template, faces)).query(points.on(template, faces))
    near = _some(points, np.flatnonzero(distance < FACE_RADIUS_M))
    return SurfacePoints(
        np.concatenate([near.face, own.face]), np.concatenate([near.barycentric, own.barycentric])
    )


def _some(points: SurfacePoints, rows: np.ndarray) -> SurfacePoints:
    return SurfacePoints(points.face[rows], points.barycentric[rows])


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9))
