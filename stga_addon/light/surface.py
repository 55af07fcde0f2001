"""How a head receives light: transfer of distant light, where splats lie on the mesh, and lashes:
dark splats around the eyes that stand off the mesh and throw their own shadows."""

from dataclasses import dataclass

import numpy as np

from ..avatar.embedding import face_areas, face_frames, points_to_world
from ..avatar.file import Avatar
from ..capture.mesh_geometry import connected_parts, vertex_normals
from ..flame.quaternions import to_matrices
from .harmonics import basis, even_directions
from .lamps import ShadowMap
from .values import Caster, Light, is_wet

DIRECTIONS = 192
# As in `lamps`, for maps of half the size
MAP_SIZE = 256
BIAS_M = 0.0015
LIFT_M = 0.002


def transfer_of(
    vertices: np.ndarray, faces: np.ndarray, directions: int = DIRECTIONS
) -> tuple[np.ndarray, np.ndarray]:
    """Transfer (V, 9) and occlusion (V,) float32 (`AvatarLight`) of a mesh (V, 3) meters: Σ over
    even directions d of visible(d) · max(0, n·d) · basis(d) · 4π / directions (Sloan, Kautz and
    Snyder 2002); visibility of a direction is one depth map."""
    vertices = np.asarray(vertices, np.float64)
    normals = vertex_normals(vertices, faces)
    points = vertices + LIFT_M * normals
    sky = even_directions(directions)
    harmonics = basis(sky) * (4 * np.pi / directions)
    transfer = np.zeros((len(vertices), harmonics.shape[1]))
    open_sky, whole_sky = np.zeros((2, len(vertices)))
    for direction, harmonic in zip(sky, harmonics, strict=True):
        cosine = np.maximum(normals @ direction, 0)
        sun = Light("sun", np.ones(3), direction=-direction)
        depths = ShadowMap(vertices, faces, sun, size=MAP_SIZE)
        reached = cosine * depths.lit(points, BIAS_M, step=0)
        transfer += reached[:, None] * harmonic
        open_sky += reached
        whole_sky += cosine
    return transfer.astype(np.float32), (open_sky / np.maximum(whole_sky, 1e-9)).astype(np.float32)


CELL_M = 0.02
"""Side of the cells in which irradiance is averaged, with the 26 around a vertex's."""
MAX_CELLS = 40
"""Cells along an axis; a mesh that is larger, as one in centimeters, has larger cells."""
SKIN = np.array([0.5, 0.33, 0.25])
"""Albedo of the skin that light is reflected by."""
MIN_OPEN = 0.3
"""Fraction of the sky that a vertex must face to count as lit skin: those inside the head do
not."""


class Bounce:
    """For a neutral mesh (V, 3) meters with its ambient occlusion (V,)."""

    def __init__(self, neutral: np.ndarray, faces: np.ndarray, occlusion: np.ndarray) -> None:
        beyond = neutral - neutral.min(0)
        side = max(CELL_M, float(beyond.max()) / MAX_CELLS)
        place = np.floor(beyond / side).astype(np.int64) + 1
        self._shape = tuple(int(n) + 2 for n in place.max(0))
        self._cell = np.ravel_multi_index(tuple(place.T), self._shape)
        area = np.bincount(faces.ravel(), np.repeat(face_areas(neutral, faces), 3), len(neutral))
        self._weight = np.where(occlusion > MIN_OPEN, area, 0)
        self._blocked = (1 - np.asarray(occlusion, np.float64))[:, None] * SKIN
        self._sum_of_weights = self._around(self._weight)

    def light(self, irradiance: np.ndarray) -> np.ndarray:
        """(V, 3) irradiance from skin around a vertex, by what arrives at vertices (V, 3)."""
        columns = np.asarray(irradiance).T
        near = np.stack([self._around(self._weight * column) for column in columns], axis=-1)
        return self._blocked * near / np.maximum(self._sum_of_weights, 1e-12)[:, None]

    def _around(self, values: np.ndarray) -> np.ndarray:
        """(V,): sum of values (V,) in each vertex's cell and those around it."""
        total = np.bincount(self._cell, values, int(np.prod(self._shape))).reshape(self._shape)
        for axis in range(3):  # the outermost cells are empty
            total = total + np.roll(total, 1, axis) + np.roll(total, -1, axis)
        return total.ravel()[self._cell]


MAX_STEPS = 6
"""Triangles that a splat walks over: with more, splats come nearer to the mesh by less than 1 %."""


def surface_points(avatar: Avatar) -> tuple[np.ndarray, np.ndarray]:
    """Where splats are on the neutral mesh: a triangle (N,), and weights (N, 3) of its corners.
    From its own triangle on, a splat walks over the edge beyond which it lies, up to MAX_STEPS
    times; the nearest of the triangles on its way counts."""
    frames = face_frames(avatar.neutral, avatar.faces, avatar.neutral, avatar.convention)
    face = avatar.splats.face.astype(np.int64)
    points = points_to_world(avatar.splats.xyz, frames, face)
    edges = np.sort(avatar.faces[:, [[1, 2], [2, 0], [0, 1]]].astype(np.int64)).reshape(-1, 2)
    key = edges[:, 0] * (int(avatar.faces.max(initial=0)) + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(key[order][1:] == key[order][:-1])
    found = np.full(len(key), -1)
    found[order[same]] = order[same + 1] // 3
    found[order[same + 1]] = order[same] // 3
    corners = avatar.neutral[avatar.faces].astype(np.float64)
    beyond = found.reshape(-1, 3)
    inside, weights, distance = _nearest(points, corners[face])
    found = face.copy()
    walking = np.arange(len(face))
    at = face
    for _ in range(MAX_STEPS):
        edge = inside.argmin(1)
        following = np.where(inside.min(1) < 0, beyond[at, edge], -1)
        goes = following >= 0
        walking = walking[goes]
        at = following[goes]
        inside, there, away = _nearest(points[walking], corners[at])
        nearer = away < distance[walking]
        rows = walking[nearer]
        found[rows] = at[nearer]
        weights[rows] = there[nearer]
        distance[rows] = away[nearer]
    return found, weights.astype(np.float32)


def _nearest(points: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Barycentric coordinates (N, 3) in triangles' planes, clamped, and squared distance (N,)."""
    a = corners[:, 0]
    first = corners[:, 1] - corners[:, 0]
    second = corners[:, 2] - corners[:, 0]
    offset = points - a
    uu = row_dot(first, first)
    uv = row_dot(first, second)
    vv = row_dot(second, second)
    pu = row_dot(offset, first)
    pv = row_dot(offset, second)
    area = np.maximum(uu * vv - uv * uv, 1e-30)
    u = (vv * pu - uv * pv) / area
    v = (uu * pv - uv * pu) / area
    inside = np.stack([1 - u - v, u, v], axis=-1)
    weights = np.clip(inside, 0, 1)
    weights /= weights.sum(1, keepdims=True)
    away = points - np.einsum("nk,nkc->nc", weights, corners)
    return inside, weights, row_dot(away, away)


def row_dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("nk,nk->n", a, b)


def at_splats(values: np.ndarray, faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(N, C) float32 of values (V, C) at corners `faces` (N, 3) with weights (N, 3)."""
    values = np.ascontiguousarray(values, np.float32)
    found = np.zeros((len(faces), values.shape[1]), np.float32)
    for k in range(3):
        part = values.take(faces[:, k], axis=0)
        part *= weights[:, k, None]
        found += part
    return found


REACH_M = 0.025
"""Distance from the middle of an eye within which dark splats are its lashes."""
MIN_HEIGHT_M = 0.002
"""Height above the mesh: shadow maps have a bias, and splats of skin lie within 1.5 mm."""
MIN_OPACITY = 0.3
MAX_ALBEDO = 0.15
EXTENT = 2.0  # A lash's half length in standard deviations of the splat: gaps close
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


@dataclass(frozen=True)
class Lashes:
    """Four-cornered cards (M, 4, 3) in the frames (`avatar.embedding`) of triangles (M,)."""

    avatar: Avatar
    face: np.ndarray
    corners: np.ndarray

    def caster(self, mesh: np.ndarray) -> Caster:
        """The cards of a head posed as mesh (V, 3), as what throws shadows."""
        avatar = self.avatar
        used = self.avatar.faces[self.face]
        frames = face_frames(mesh, used, avatar.neutral, avatar.convention)
        corners = self.corners.reshape(-1, 3)
        vertices = points_to_world(corners, frames, np.repeat(np.arange(len(self.face)), 4))
        faces = 4 * np.arange(len(self.face))[:, None, None] + TRIANGLES
        return Caster(vertices, faces.reshape(-1, 3).astype(np.int32))


def find_lashes(
    avatar: Avatar,
    corners: np.ndarray,
    weights: np.ndarray,
    roughness: np.ndarray,
    albedo: np.ndarray,
) -> Lashes:
    """The lashes of an avatar with light; corners, weights (N, 3) of `surface_points`, roughness
    (N,) and albedo (N, 3) of the splats."""
    assert avatar.light is not None
    splats = avatar.splats
    neutral = avatar.neutral.astype(np.float64)
    frames = face_frames(neutral, avatar.faces, neutral, avatar.convention)
    dark = (albedo.mean(1) < MAX_ALBEDO) & ~is_wet(roughness) & (splats.opacities() > MIN_OPACITY)
    found = np.flatnonzero(dark)
    points = points_to_world(splats.xyz[found], frames, splats.face[found])
    wet = is_wet(avatar.light.roughness)
    part = connected_parts(len(neutral), avatar.faces[wet[avatar.faces].all(1)])
    near = np.zeros(len(points), bool)
    for label in np.unique(part[wet]):
        middle = neutral[wet & (part == label)].mean(0)
        near |= np.linalg.norm(points - middle, axis=1) < REACH_M
    found = found[near]
    points = points[near]
    normal = at_splats(vertex_normals(neutral, avatar.faces), corners[found], weights[found])
    above = points - at_splats(neutral, corners[found], weights[found])
    height = (above * normal).sum(1) / np.maximum(np.linalg.norm(normal, axis=1), 1e-9)
    found = found[height > MIN_HEIGHT_M]
    rows = avatar.splats.rows(found)
    scale = np.exp(rows.log_scale.astype(np.float64))
    longest = np.argsort(-scale, axis=1, kind="stable")[:, :2]
    axes = np.swapaxes(to_matrices(rows.rotation), 1, 2)
    splat = np.arange(len(found))
    lengths = EXTENT * np.take_along_axis(scale, longest, 1)
    first, second = (lengths[:, k, None] * axes[splat, longest[:, k]] for k in range(2))
    offsets = np.stack([first, second, -first, -second], axis=1)
    return Lashes(avatar, splats.face[found], np.asarray(rows.xyz[:, None] + offsets, np.float32))
