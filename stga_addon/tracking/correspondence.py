"""Places of a detector's landmarks on a head model, found by running the detector on pictures of
the model."""

import math
from dataclasses import replace

import numpy as np

from ..capture.camera import Camera, look_at
from ..capture.mesh_geometry import nearest_in_triangles, rasterize, vertex_normals
from ..errors import StgaError
from ..flame.forward import flame_forward, neutral_frame
from ..flame.model import EYEBALL_WEIGHT, JOINTS, FlameModel
from ..flame.quaternions import unit
from .face_networks import FIRST_IRIS_POINT, IRIS_CENTERS, MESH_POINTS, FaceNetworks
from .fit import MIN_LANDMARKS, Triangulation, triangulate
from .observed_surface import large_parts
from .posed_points import SurfacePoints

SKIN_RGB = np.array([0.78, 0.58, 0.48])
"""Color of the drawn head."""
BACKGROUND = 0.45
"""Gray behind it, 0…1."""
KEY_LIGHT = np.array([0.35, 0.55, 0.75])
"""Direction towards the light in camera axes: x right, y up, z towards the camera."""
AMBIENT = 0.38
"""Fraction of the light that comes from everywhere."""
VIEWS_DEG = (0, 0), (-25, 0), (25, 0), (-50, 0), (50, 0), (0, 20), (0, -20), (-30, 15), (30, 15)
"""Azimuth and elevation of the pictures."""
PICTURE_SIZE = 512
"""Side of the pictures in pixels."""
PICTURE_DISTANCE = 3.5
"""Distance of their camera in extents of the head: there is little perspective."""
PICTURE_FOCAL = 3.0
"""Focal length in image widths: the head fills most of the picture."""
MIN_PICTURES = 3
"""Pictures that a landmark must be found in."""
OPEN_JAW_WEIGHT = 0.4
"""Weight of ARKit's jawOpen by which lips part in the pictures: on a closed mouth, the lower lip's
inner landmarks are as near to the upper lip."""
OPEN_JAW_RAD = 0.2
"""Rotation of the jaw joint that parts the lips of heads without this shape."""
BLINKS = "eyeBlinkLeft", "eyeBlinkRight"
"""ARKit's shapes that close the eyes."""
EYE_JOINTS = JOINTS.index("left_eye"), JOINTS.index("right_eye")
"""Indices of the joints that turn the eyes, the left one first."""
SCLERA_RGB = (0.95, 0.93, 0.9)
"""Color of the drawn eyeballs."""
IRIS_RGB = (0.15, 0.09, 0.05)
"""Color of the drawn irises."""
IRIS_RADIUS = 0.4
"""Radius of the iris as a fraction of the eyeball's."""
MAX_SURFACE_DISTANCE = 0.02
"""Distance from the surface beyond which a landmark is not used, as a fraction of the head's extent
(6 mm)."""
MAX_RESIDUAL = 0.013
"""Fraction of the head's extent: a landmark whose rays miss each other by more (4 mm) is not
used."""
CANDIDATES = 48  # Triangles of the nearest centers, among which the nearest one is looked for


def shaded_image(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, colors: np.ndarray | None = None
) -> np.ndarray:
    """The mesh in soft light on gray: (H, W, 3) uint8. colors (V, 3), 0 to 1; None: skin's."""
    triangle, weights = rasterize(vertices, faces, camera)
    covered = triangle >= 0
    corners = faces[triangle[covered]]
    inside = weights[covered][..., None]
    axes = camera.rotation
    smooth = (vertex_normals(vertices, faces)[corners] * inside).sum(1) @ axes.T
    normal = unit(smooth * [1, -1, -1])
    lit = (1 - AMBIENT) * np.clip(normal @ unit(KEY_LIGHT), 0, 1)
    brightness = AMBIENT * (0.75 + 0.25 * normal[:, 1]) + lit
    color = SKIN_RGB if colors is None else (colors[corners] * inside).sum(1)
    image = np.full((camera.height, camera.width, 3), BACKGROUND)
    image[covered] = np.clip(brightness[:, None], 0, 1) * color * 1.15
    return np.asarray(255 * np.clip(image, 0, 1) ** (1 / 1.8) + 0.5, np.uint8)


def calibrate(
    model: FlameModel, detector: FaceNetworks, name: str
) -> tuple[SurfacePoints, np.ndarray]:
    """The detector's landmarks on the neutral head: their places, and (N,) bool which of them are
    reliable.

    Renders the template from nine directions, triangulates what the detector finds and takes the
    nearest points of the skin, or of an eyeball for the irises; where the model can, with the mouth
    opened and the eyes closed too. The model looks along +z with y up; `name` is what errors call
    it. Raises StgaError where the detector does not see a face.
    """
    neutral = model.v_template
    faces = model.faces
    colors = head_colors(model)
    located, count = _located(neutral, faces, colors, detector)
    if located is None:
        raise StgaError(
            f"{name}: shows a face in {count} of {len(VIEWS_DEG)} pictures from the front, "
            f"expected at least {MIN_PICTURES}; it must look along +z with y up"
        )
    samples = [(neutral, located.position)]
    # with the mouth open, and with the eyes closed, as far as shapes or a joint are known for that
    frame = neutral_frame(model)
    names = np.array(model.expression_names)
    weights = [OPEN_JAW_WEIGHT * (names == "jawOpen"), np.isin(names, BLINKS)]
    frames = [
        replace(frame, expr=1.0 * weight) for weight in weights if len(names) and weight.any()
    ]
    if not len(names) and model.weights[:, JOINTS.index("jaw")].any():
        frames = [replace(frame, jaw_pose=np.array([OPEN_JAW_RAD, 0, 0]))]
    for pose in frames:
        mesh = flame_forward(model, np.zeros(model.n_identity), pose)
        found, _ = _located(mesh, faces, colors, detector)
        samples += [] if found is None else [(mesh, found.position)]
    # Of lids, the nearest points would lie on the eyeball, which does not blink.
    skin = np.flatnonzero(large_parts(model))
    meshes, positions = (np.concatenate(arrays, axis=1) for arrays in zip(*samples, strict=True))
    on, _ = nearest_points(meshes, faces[skin], positions)
    places = SurfacePoints(skin[on.face], on.barycentric)
    distance = np.linalg.norm(places.on(neutral, faces) - located.position, axis=1)
    extent = float(np.ptp(neutral, axis=0).max())
    reliable = distance < MAX_SURFACE_DISTANCE * extent
    reliable &= located.residual < MAX_RESIDUAL * extent
    if len(reliable) == MESH_POINTS:
        reliable[FIRST_IRIS_POINT:] = False
        places, pupils = _with_pupils(model, places, located.position)
        reliable[pupils] = True
    if reliable.sum() < MIN_LANDMARKS:
        raise StgaError(
            f"{name}: {reliable.sum()} of {len(reliable)} landmarks that are found in its "
            f"pictures lie on its surface, expected at least {MIN_LANDMARKS}"
        )
    return places, reliable


def head_colors(model: FlameModel) -> np.ndarray:
    """(V, 3) colors for the pictures. A detector needs irises to distinguish open eyes from closed
    ones on models that can close their eyes."""
    colors = np.tile(SKIN_RGB, (len(model.v_template), 1))
    for joint in EYE_JOINTS if BLINKS[0] in model.expression_names else ():
        eyeball = np.flatnonzero(model.weights[:, joint] > EYEBALL_WEIGHT)
        at = model.v_template[eyeball]
        if len(at):
            away = (at - (at.min(0) + at.max(0)) / 2) / (np.ptp(at, axis=0).max() / 2)
            iris = (np.hypot(away[:, 0], away[:, 1]) < IRIS_RADIUS) & (away[:, 2] > 0)
            colors[eyeball] = np.where(iris[:, None], IRIS_RGB, SCLERA_RGB)
    return colors


def _located(
    vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray, detector: FaceNetworks
) -> tuple[Triangulation | None, int]:
    """The landmarks in pictures of a mesh, and how many of these show a face; None where too few
    do."""
    cameras = picture_cameras(vertices)
    found = [detector.detect(shaded_image(vertices, faces, camera, colors)) for camera in cameras]
    detected = [
        (camera, faces_found[0])
        for camera, faces_found in zip(cameras, found, strict=True)
        if faces_found
    ]
    if len(detected) < MIN_PICTURES:
        return None, len(detected)
    points = np.stack([face for _, face in detected])
    return triangulate([camera for camera, _ in detected], points, np.ones(points.shape[:2])), len(
        detected
    )


def picture_cameras(vertices: np.ndarray) -> list[Camera]:
    """Cameras in front of a head (V, 3), in VIEWS_DEG."""
    low = vertices.min(0)
    high = vertices.max(0)
    center = (low + high) / 2
    distance = PICTURE_DISTANCE * float((high - low).max())
    cameras = []
    for azimuth, elevation in VIEWS_DEG:
        turn = math.radians(azimuth)
        rise = math.radians(elevation)
        across = math.cos(rise)
        direction = np.array([math.sin(turn) * across, math.sin(rise), math.cos(turn) * across])
        focal = PICTURE_FOCAL * PICTURE_SIZE
        eye = center + distance * direction
        cameras.append(look_at(eye, center, PICTURE_SIZE, PICTURE_SIZE, focal))
    return cameras


def nearest_points(
    vertices: np.ndarray, faces: np.ndarray, points: np.ndarray
) -> tuple[SurfacePoints, np.ndarray]:
    """The points of a mesh nearest to `points` (N, D), and their distances (N,).

    vertices (V, D): D is 3, or 3 times the number of poses of a mesh, side by side; squared
    distances in all poses then add up.
    """
    from scipy.spatial import cKDTree

    corners = vertices[faces]
    candidates = min(CANDIDATES, len(faces))
    _, near = cKDTree(corners.mean(1)).query(points, candidates)
    near = near.reshape(len(points), candidates)
    barycentric = nearest_in_triangles(corners[near], points)
    found = np.einsum("nkb,nkbd->nkd", barycentric, corners[near])
    distance = np.linalg.norm(found - points[:, None], axis=2)
    at = np.arange(len(points)), distance.argmin(1)
    return SurfacePoints(near[at], barycentric[at]), distance[at]


def _with_pupils(
    model: FlameModel, places: SurfacePoints, located: np.ndarray
) -> tuple[SurfacePoints, list[int]]:
    """The places with the centers of the irises on the foremost points of the eyeballs, where the
    model has any."""
    face = places.face.copy()
    barycentric = places.barycentric.copy()
    moved = []
    for joint in EYE_JOINTS:
        eyeball = np.flatnonzero((model.weights[model.faces, joint] > EYEBALL_WEIGHT).all(1))
        if not len(eyeball):
            continue
        corners = model.v_template[model.faces[eyeball]]
        foremost = corners.reshape(-1, 3)[corners.reshape(-1, 3)[:, 2].argmax()]
        center = np.array([*corners.mean((0, 1))[:2], foremost[2]])
        pupil = min(IRIS_CENTERS, key=lambda number: abs(located[number, 0] - center[0]))
        on, _ = nearest_points(model.v_template, model.faces[eyeball], center[None])
        face[pupil] = eyeball[on.face[0]]
        barycentric[pupil] = on.barycentric[0]
        moved.append(pupil)
    return SurfacePoints(face, barycentric), moved
