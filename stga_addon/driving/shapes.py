"""What ARKit's shapes do to points of a face, measured on ICT-FaceKit, and where these points lie
on a FLAME head.

`arkit_shapes.npz` holds samples of the ICT-FaceKit light model (MIT License, Copyright (c) 2020 USC
Institute for Creative Technologies), made by `development/arkit_shapes.py`.

ICT-FaceKit's points are moved onto the head: first by an affine map and ICT-FaceKit's own
identities, iterating nearest points (point to plane, as Chen and Medioni 1992), then by a smooth
warp (radial basis functions) with less and less smoothing. A head must look along +z with y up.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from ..capture.mesh_geometry import nearest_in_triangles, triangle_normals
from ..errors import StgaError
from ..files import read_npz
from ..flame.forward import joint_positions
from ..flame.model import EYEBALL_WEIGHT, JOINTS, FlameModel
from ..flame.quaternions import unit
from ..tracking.posed_points import SurfacePoints
from .performance import ARKIT_SHAPES, COLUMN, COUNT, OPTIONAL

SHAPES_FILE = Path(__file__).with_name("arkit_shapes.npz")
PUPILS = (468, 473)
SKIN_POINTS = 468  # The points after these are the irises', which move with the eyeballs
MOUTH_CLOSE = COLUMN["mouthClose"]
JAW_OPEN = COLUMN["jawOpen"]


@dataclass(frozen=True)
class FaceShapes:
    """ICT-FaceKit at MediaPipe's 478 landmarks, in meters, y up, looking along +z; the person's
    left is +x.

    points, normals  (478, 3) of the neutral face
    reliable  (478,) bool: found on the surface by the detector
    shapes    (52, 478, 3) displacements in the order of `ARKIT_SHAPES`; tongueOut's are zero
    identity  (20, 478, 3) displacements that make other people
    """

    points: np.ndarray
    normals: np.ndarray
    reliable: np.ndarray
    shapes: np.ndarray
    identity: np.ndarray


@cache
def face_shapes() -> FaceShapes:
    """The shapes that come with this package. Raises StgaError in an edition without them."""
    if not SHAPES_FILE.is_file():
        raise StgaError(
            "face performances need data of ICT-FaceKit, which the bare edition leaves out; "
            "install the small or the complete edition"
        )
    arrays = read_npz(SHAPES_FILE)
    shapes = np.zeros((COUNT, *arrays["points"].shape))
    shapes[[COLUMN[name] for name in ARKIT_SHAPES if name not in OPTIONAL]] = arrays["shapes"]
    rest = {name: arrays[name].astype(np.float64) for name in ("points", "normals", "identity")}
    return FaceShapes(reliable=arrays["reliable"], shapes=shapes, **rest)


def effective_weights(weights: np.ndarray) -> np.ndarray:
    """Weights (..., 52) with mouthClose at most jawOpen: it closes the lips of an open jaw."""
    limited = weights.copy()
    opened = np.maximum(weights[..., JAW_OPEN], 0)
    limited[..., MOUTH_CLOSE] = np.minimum(weights[..., MOUTH_CLOSE], opened)
    return limited


EYE_JOINTS = (JOINTS.index("right_eye"), JOINTS.index("left_eye"))
"""Places of the right and the left eye in JOINTS."""

MIN_EYE_DISTANCE_M = 0.03
"""Least distance of a head's eyes."""
MAX_EYE_DISTANCE_M = 0.15
"""Largest distance of a head's eyes."""
EYEBALL_RADIUS_M = 0.012
"""Radius for a head without eyeballs: its pupils are taken to lie in front of the eyes' joints."""
ITERATIONS = 12
"""Steps in which a mesh is laid on the other."""
CANDIDATES = 24
"""Triangles whose centers are nearest to a point, among which the nearest is looked for."""
NEIGHBOURS = 200
"""Triangles around each point that are kept for the next search."""
MAX_MOVE_M = 0.01
"""Distance that a point may move until these are searched anew."""
MIN_COSINE = 0.5
"""Cosine between the normals of a point and of the triangle that it may lie on."""
FAR_M = 1.0
"""Added to the distance of triangles that face another way."""
MAX_MATCH_M = 0.003
"""Distance up to which a nearest point counts."""
MEDIANS = 4.0
"""Multiple of the median distance up to which a nearest point counts as well."""
TANGENTIAL_WEIGHT = 0.1
PUPIL_WEIGHT = 30.0
IDENTITY_DEVIATION_M = 0.002
AFFINE_WEIGHT = 0.09
SMOOTHINGS = (0.3, 0.1, 0.03, 0.01)  # Ridge of the warp's kernel, in meters
MAX_WARP_MATCH_M = 0.006
MAX_SURFACE_DISTANCE_M = 0.003


def face_points(model: FlameModel, name: str) -> tuple[SurfacePoints, np.ndarray]:
    """The 478 points on the neutral head, and (478,) bool which lie reliably on its skin. Raises
    StgaError, with `name`, where its eyes are not where a head has them."""
    source = face_shapes()
    surface = _Surface(model.v_template, model.faces)
    joints = joint_positions(model, model.v_template)
    foremost = []  # points of right and left eyeball
    for joint in EYE_JOINTS:
        eyeball = model.v_template[model.weights[:, joint] > EYEBALL_WEIGHT]
        if len(eyeball):
            foremost.append([*eyeball[:, :2].mean(axis=0), eyeball[:, 2].max()])
        else:
            foremost.append(joints[joint] + [0, 0, EYEBALL_RADIUS_M])
    apart = float(foremost[1][0] - foremost[0][0])
    if not MIN_EYE_DISTANCE_M <= apart <= MAX_EYE_DISTANCE_M:
        low = 1000 * MIN_EYE_DISTANCE_M
        high = 1000 * MAX_EYE_DISTANCE_M
        raise StgaError(
            f"{name}: its eyes lie {1000 * apart:.0f} mm apart along x, expected {low:.0f} to "
            f"{high:.0f}: ARKit's shapes need a head in meters that looks along +z with y up"
        )
    pupils = np.array(foremost)
    skin = source.reliable & (np.arange(len(source.points)) < SKIN_POINTS)
    points, normals = _aligned(surface, pupils, skin)
    points = _warped(surface, points, normals, pupils, skin)
    face, barycentric, _, distance = surface.nearest(points, normals)
    return SurfacePoints(face, barycentric), skin & (distance < MAX_SURFACE_DISTANCE_M)


class _Surface:
    """Triangles of a mesh, for nearest points."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self.corners = vertices[faces]
        self.centers = self.corners.mean(axis=1)
        self.normals = unit(triangle_normals(self.corners), 1e-20)
        self._seen: np.ndarray | None = None

    def nearest(
        self, points: np.ndarray, normals: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Triangle, barycentric, position and distance of the nearest points that face alike."""
        if self._seen is None or abs(points - self._seen).max() > MAX_MOVE_M:
            middle = points.mean(0)  # about which single precision is enough
            centers = (self.centers - middle).astype(np.float32)
            squared = (points - middle).astype(np.float32) @ (-2 * centers.T)
            squared += (centers**2).sum(1)
            self._seen = points
            self._around = _least(squared, NEIGHBOURS)
            self._centers = self.centers[self._around]
            self._normals = self.normals[self._around]
        away = self._centers - points[:, None]
        squared = np.einsum("nkc,nkc->nk", away, away)
        squared += FAR_M * (np.einsum("nkc,nc->nk", self._normals, normals) < MIN_COSINE)
        near = np.take_along_axis(self._around, _least(squared, CANDIDATES), axis=1)
        barycentric = nearest_in_triangles(self.corners[near], points)
        positions = np.einsum("nkb,nkbc->nkc", barycentric, self.corners[near])
        distance = np.linalg.norm(positions - points[:, None], axis=2)
        turned = np.einsum("nkc,nc->nk", self.normals[near], normals) < MIN_COSINE
        best = (distance + FAR_M * turned).argmin(axis=1)
        at = np.arange(len(points)), best
        return near[at], barycentric[at], positions[at], distance[at]


def _least(values: np.ndarray, count: int) -> np.ndarray:
    """(N, at most count): indices of the least of each row, in any order."""
    count = min(count, values.shape[1])
    return np.argpartition(values, count - 1, axis=1)[:, :count]


def _aligned(
    surface: _Surface, pupils: np.ndarray, skin: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (478, 3) after the affine map and the identities."""
    source = face_shapes()
    source_pupils = source.points[list(PUPILS)]
    linear = np.eye(3) * np.ptp(pupils[:, 0]) / np.ptp(source_pupils[:, 0])
    points = source.points @ linear + pupils.mean(axis=0) - source_pupils.mean(axis=0) @ linear
    normals = source.normals
    count = len(source.identity)
    affine = np.einsum("ac,nb->nacb", np.eye(3), _homogeneous(source.points)).reshape(-1, 3, 12)
    identities = source.identity.transpose(1, 2, 0) * linear[0, 0]
    basis = np.concatenate([affine, identities], axis=2)
    entries = [0, 1, 2, 4, 5, 6, 8, 9, 10]  # of the affine map without its translation
    anchors = PUPIL_WEIGHT * basis[list(PUPILS)].reshape(6, -1)
    prior = np.zeros((9 + count, 12 + count))
    prior[np.arange(9), entries] = AFFINE_WEIGHT
    deviation = IDENTITY_DEVIATION_M * np.sqrt(skin.sum() / count)
    prior[9 + np.arange(count), 12 + np.arange(count)] = deviation
    for _ in range(ITERATIONS):
        found = surface.nearest(points, normals)
        face, _, target, distance = (values[skin] for values in found)
        kept = distance < max(MEDIANS * float(np.median(distance)), MAX_MATCH_M)
        moved = basis[skin][kept]
        normal = surface.normals[face[kept]]
        target = target[kept]
        towards = np.einsum("na,nak->nk", normal, moved)
        along = TANGENTIAL_WEIGHT * moved.reshape(-1, 12 + count)
        rows = np.concatenate([towards, along, anchors, prior])
        expected = AFFINE_WEIGHT * np.trace(linear) / 3 * np.eye(3).ravel()
        wanted = [(normal * target).sum(1), TANGENTIAL_WEIGHT * target.ravel()]
        wanted += [PUPIL_WEIGHT * pupils.ravel(), expected]
        found = np.linalg.lstsq(rows, np.concatenate([*wanted, np.zeros(count)]), rcond=None)[0]
        linear = found[entries].reshape(3, 3)
        points = basis @ found
        normals = unit(source.normals @ np.linalg.inv(linear))
    return points, normals


def _warped(
    surface: _Surface, points: np.ndarray, normals: np.ndarray, pupils: np.ndarray, skin: np.ndarray
) -> np.ndarray:
    """The points (478, 3) moved towards the surface by a smooth warp."""
    warped = points
    for smoothing in SMOOTHINGS:
        _, _, target, distance = (values[skin] for values in surface.nearest(warped, normals))
        kept = distance < MAX_WARP_MATCH_M
        fixed = np.concatenate([points[skin][kept], points[list(PUPILS)]])
        moved = np.concatenate([target[kept], pupils]) - fixed
        plain = _homogeneous(fixed)
        kernel = smoothing * np.eye(len(fixed)) - _distances(fixed, fixed)
        system = np.block([[kernel, plain], [plain.T, np.zeros((4, 4))]])
        weights = np.linalg.solve(system, np.concatenate([moved, np.zeros((4, 3))]))
        terms = np.hstack([-_distances(points, fixed), _homogeneous(points)])
        warped = points + terms @ weights
    return warped


def _homogeneous(points: np.ndarray) -> np.ndarray:
    return np.pad(points, ((0, 0), (0, 1)), constant_values=1.0)


def _distances(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.linalg.norm(first[:, None] - second, axis=2)
