"""Where a detector's landmarks lie on a head model, found with the detector itself on pictures of the model."""

import math

import numpy as np

from ..capture.camera import Camera, look_at
from ..errors import StgaError
from ..flame.model import EYEBALL_WEIGHT, JOINTS, FlameModel
from .face_networks import FIRST_IRIS_POINT, IRIS_CENTERS, MESH_POINTS, Detector
from .fit import MIN_LANDMARKS
from .mesh_image import shaded_image
from .posed_points import SurfacePoints
from .triangulation import triangulate

DIRECTIONS_DEG = ((0, 0), (-25, 0), (25, 0), (-50, 0), (50, 0), (0, 20), (0, -20), (-30, 15), (30, 15))
"""Azimuth and elevation of the pictures."""
PICTURE_SIZE = 512
PICTURE_DISTANCE, PICTURE_FOCAL = 3.5, 3.0
"""In extents of the head, and in image widths: the head fills most of the picture, with little perspective."""
MIN_PICTURES = 3
MAX_SURFACE_DISTANCE = 0.02
"""Share of the head's extent: a landmark farther from the surface than this (6 mm) is not used."""
MAX_RESIDUAL = 0.013
"""Share of the head's extent: a landmark whose rays miss each other by more (4 mm) is not used."""
CANDIDATES = 48
"""Triangles whose centers are nearest to a point, among which the nearest is looked for."""


def calibrate(model: FlameModel, detector: Detector, name: str) -> tuple[SurfacePoints, np.ndarray]:
    """The detector's landmarks on the neutral head: their places, and (N,) bool which of them are reliable.

    Renders the template from nine directions, triangulates what the detector finds and takes the nearest points of the
    surface. The model looks along +z with y up; `name` is what errors call it. Raises StgaError where the detector does
    not see a face.
    """
    cameras = picture_cameras(model.v_template)
    found = [(camera, detector.detect(shaded_image(model.v_template, model.faces, camera))) for camera in cameras]
    seen = [(camera, faces[0]) for camera, faces in found if faces]
    if len(seen) < MIN_PICTURES:
        raise StgaError(
            f"{name}: shows a face in {len(seen)} of {len(cameras)} pictures from the front, expected at least "
            f"{MIN_PICTURES}; it must look along +z with y up"
        )
    points = np.stack([face for _, face in seen])
    located = triangulate([camera for camera, _ in seen], points, np.ones(points.shape[:2]))
    places, distance = nearest_points(model.v_template, model.faces, located.position)
    extent = float(np.ptp(model.v_template, axis=0).max())
    reliable = (distance < MAX_SURFACE_DISTANCE * extent) & (located.residual < MAX_RESIDUAL * extent)
    if len(reliable) == MESH_POINTS:
        reliable[FIRST_IRIS_POINT:] = False
        places, pupils = _with_pupils(model, places, located.position)
        reliable[pupils] = True
    if reliable.sum() < MIN_LANDMARKS:
        raise StgaError(
            f"{name}: {reliable.sum()} of {len(reliable)} landmarks that are found in its pictures lie on its surface, "
            f"expected at least {MIN_LANDMARKS}"
        )
    return places, reliable


def picture_cameras(vertices: np.ndarray) -> list[Camera]:
    """Cameras in front of a head (V, 3), in DIRECTIONS_DEG."""
    low, high = vertices.min(0), vertices.max(0)
    center, distance = (low + high) / 2, PICTURE_DISTANCE * float((high - low).max())
    cameras = []
    for azimuth, elevation in DIRECTIONS_DEG:
        turn, rise = math.radians(azimuth), math.radians(elevation)
        direction = np.array([math.sin(turn) * math.cos(rise), math.sin(rise), math.cos(turn) * math.cos(rise)])
        eye = center + distance * direction
        cameras.append(look_at(eye, center, PICTURE_SIZE, PICTURE_SIZE, PICTURE_FOCAL * PICTURE_SIZE))
    return cameras


def nearest_points(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> tuple[SurfacePoints, np.ndarray]:
    """The points of a mesh nearest to `points` (N, 3), and their distances (N,)."""
    from scipy.spatial import cKDTree
    from trimesh.triangles import closest_point, points_to_barycentric

    corners = vertices[faces]
    candidates = min(CANDIDATES, len(faces))
    _, near = cKDTree(corners.mean(1)).query(points, candidates)
    near = near.reshape(len(points), candidates)
    repeated = np.repeat(points, candidates, axis=0)
    closest = closest_point(corners[near.ravel()], repeated)  # type: ignore[no-untyped-call]
    closest = closest.reshape(len(points), candidates, 3)
    distance = np.linalg.norm(closest - points[:, None], axis=2)
    best = distance.argmin(1)
    rows = np.arange(len(points))
    triangle, nearest = near[rows, best], closest[rows, best]
    barycentric = points_to_barycentric(corners[triangle], nearest)  # type: ignore[no-untyped-call]
    return SurfacePoints(triangle, np.nan_to_num(barycentric, nan=1 / 3)), distance[rows, best]


def _with_pupils(model: FlameModel, places: SurfacePoints, located: np.ndarray) -> tuple[SurfacePoints, list[int]]:
    """The places with the centers of the irises on the foremost points of the eyeballs, where the model has any."""
    face, barycentric, moved = places.face.copy(), places.barycentric.copy(), []
    for joint in (JOINTS.index("left_eye"), JOINTS.index("right_eye")):
        eyeball = np.flatnonzero((model.weights[model.faces, joint] > EYEBALL_WEIGHT).all(1))
        if not len(eyeball):
            continue
        corners = model.v_template[model.faces[eyeball]]
        foremost = corners.reshape(-1, 3)[corners.reshape(-1, 3)[:, 2].argmax()]
        center = np.array([*corners.mean((0, 1))[:2], foremost[2]])
        pupil = min(IRIS_CENTERS, key=lambda number: abs(located[number, 0] - center[0]))
        on, _ = nearest_points(model.v_template, model.faces[eyeball], center[None])
        face[pupil], barycentric[pupil] = eyeball[on.face[0]], on.barycentric[0]
        moved.append(pupil)
    return SurfacePoints(face, barycentric), moved
