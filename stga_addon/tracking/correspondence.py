"""Where a detector's landmarks lie on a head model, found with the detector itself on pictures of
the model."""

import math
from dataclasses import replace

import numpy as np

from ..capture.camera import Camera, look_at
from ..errors import StgaError
from ..flame.forward import flame_forward, neutral_frame
from ..flame.model import EYEBALL_WEIGHT, JOINTS, FlameModel
from .face_networks import FIRST_IRIS_POINT, IRIS_CENTERS, MESH_POINTS, Detector
from .fit import MIN_LANDMARKS
from .mesh_image import shaded_image
from .posed_points import SurfacePoints
from .seen_surface import large_parts
from .triangulation import Triangulation, triangulate

DIRECTIONS_DEG = (
    (0, 0),
    (-25, 0),
    (25, 0),
    (-50, 0),
    (50, 0),
    (0, 20),
    (0, -20),
    (-30, 15),
    (30, 15),
)
"""Azimuth and elevation of the pictures."""
PICTURE_SIZE = 512
PICTURE_DISTANCE, PICTURE_FOCAL = 3.5, 3.0
"""In extents of the head, and in image widths: the head fills most of the picture, with little
perspective."""
MIN_PICTURES = 3
OPEN_JAW_WEIGHT, OPEN_JAW_RAD = 0.4, 0.2
"""Of ARKit's jawOpen, or of the jaw joint, by which lips part: on a closed mouth, the lower lip's
inner landmarks are as near to the upper lip."""
MIN_OPEN_GAIN = 0.25
"""Share of its squared distances in both pictures that a place leaves that is better than
another."""
MAX_SURFACE_DISTANCE = 0.02
"""Share of the head's extent: a landmark farther from the surface than this (6 mm) is not used."""
MAX_RESIDUAL = 0.013
"""Share of the head's extent: a landmark whose rays miss each other by more (4 mm) is not used."""
CANDIDATES = 48
"""Triangles whose centers are nearest to a point, among which the nearest is looked for."""


def calibrate(model: FlameModel, detector: Detector, name: str) -> tuple[SurfacePoints, np.ndarray]:
    """The detector's landmarks on the neutral head: their places, and (N,) bool which of them are
    reliable.

    Renders the template from nine directions, triangulates what the detector finds and takes the
    nearest points of the skin, or of an eyeball for the irises; with the mouth opened too, where
    the model can. The model looks along +z with y up; `name` is what errors call it. Raises
    StgaError where the detector does not see a face.
    """
    neutral, faces = model.v_template, model.faces
    located, count = _located(neutral, faces, detector)
    if located is None:
        raise StgaError(
            f"{name}: shows a face in {count} of {len(DIRECTIONS_DEG)} pictures from the front, expected at least "
            f"{MIN_PICTURES}; it must look along +z with y up"
        )
    skin = np.flatnonzero(large_parts(model))
    places = _on_skin(neutral, faces, skin, located.position)
    opened = _open_mouth(model)
    parted = None if opened is None else _located(opened, faces, detector)[0]
    if opened is not None and parted is not None:
        places = _on_own_lips(neutral, opened, faces, skin, places, located, parted)
    distance = np.linalg.norm(places.on(neutral, faces) - located.position, axis=1)
    extent = float(np.ptp(neutral, axis=0).max())
    reliable = (distance < MAX_SURFACE_DISTANCE * extent) & (
        located.residual < MAX_RESIDUAL * extent
    )
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


def _located(
    vertices: np.ndarray, faces: np.ndarray, detector: Detector
) -> tuple[Triangulation | None, int]:
    """The landmarks in pictures of a mesh, and how many of these show a face; None where too few
    do."""
    pictures = [
        (camera, shaded_image(vertices, faces, camera)) for camera in picture_cameras(vertices)
    ]
    found = [(camera, detector.detect(picture)) for camera, picture in pictures]
    seen = [(camera, shown[0]) for camera, shown in found if shown]
    if len(seen) < MIN_PICTURES:
        return None, len(seen)
    points = np.stack([face for _, face in seen])
    return triangulate([camera for camera, _ in seen], points, np.ones(points.shape[:2])), len(seen)


def _on_skin(
    vertices: np.ndarray, faces: np.ndarray, skin: np.ndarray, positions: np.ndarray
) -> SurfacePoints:
    """The nearest points of the triangles `skin`: those of lids would lie on the eyeball, which
    does not blink."""
    on, _ = nearest_points(vertices, faces[skin], positions)
    return SurfacePoints(skin[on.face], on.barycentric)


def _on_own_lips(
    neutral: np.ndarray, opened: np.ndarray, faces: np.ndarray, skin: np.ndarray, places: SurfacePoints,
    located: Triangulation, parted: Triangulation,
) -> SurfacePoints:  # fmt: skip
    """The places, where they do not open with the landmarks moved to the nearest skin that does.

    neutral, opened (V, 3): the head with closed and open mouth, on which `located` and `parted`
    are.
    """
    others = _on_skin(opened, faces, skin, parted.position)
    pairs = ((neutral, located), (opened, parted))
    before, after = (
        np.sum([((on.on(mesh, faces) - seen.position) ** 2).sum(1) for mesh, seen in pairs], axis=0)
        for on in (places, others)
    )
    motion = opened - neutral
    moves = motion[faces[skin]].mean(1)
    face, barycentric = places.face.copy(), places.barycentric.copy()
    for row in np.flatnonzero(after < MIN_OPEN_GAIN * before):
        wrong, right = (
            np.linalg.norm(moves - on.on(motion, faces)[row], axis=1) for on in (places, others)
        )
        found = _on_skin(neutral, faces, skin[right < wrong], located.position[row : row + 1])
        face[row], barycentric[row] = found.face[0], found.barycentric[0]
    return SurfacePoints(face, barycentric)


def _open_mouth(model: FlameModel) -> np.ndarray | None:
    """The neutral head's vertices (V, 3) with the mouth open; None where no shape or joint is known
    to open it."""
    frame = neutral_frame(model)
    if "jawOpen" in model.expression_names:
        weights = OPEN_JAW_WEIGHT * (np.array(model.expression_names) == "jawOpen")
        return flame_forward(model, np.zeros(model.n_identity), replace(frame, expr=weights))
    if not model.weights[:, JOINTS.index("jaw")].any():
        return None
    return flame_forward(
        model, np.zeros(model.n_identity), replace(frame, jaw_pose=np.array([OPEN_JAW_RAD, 0, 0]))
    )


def picture_cameras(vertices: np.ndarray) -> list[Camera]:
    """Cameras in front of a head (V, 3), in DIRECTIONS_DEG."""
    low, high = vertices.min(0), vertices.max(0)
    center, distance = (low + high) / 2, PICTURE_DISTANCE * float((high - low).max())
    cameras = []
    for azimuth, elevation in DIRECTIONS_DEG:
        turn, rise = math.radians(azimuth), math.radians(elevation)
        direction = np.array(
            [math.sin(turn) * math.cos(rise), math.sin(rise), math.cos(turn) * math.cos(rise)]
        )
        eye = center + distance * direction
        cameras.append(
            look_at(eye, center, PICTURE_SIZE, PICTURE_SIZE, PICTURE_FOCAL * PICTURE_SIZE)
        )
    return cameras


def nearest_points(
    vertices: np.ndarray, faces: np.ndarray, points: np.ndarray
) -> tuple[SurfacePoints, np.ndarray]:
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


def _with_pupils(
    model: FlameModel, places: SurfacePoints, located: np.ndarray
) -> tuple[SurfacePoints, list[int]]:
    """The places with the centers of the irises on the foremost points of the eyeballs, where the
    model has any."""
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
