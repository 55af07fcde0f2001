"""Local frames of triangles, in which splats are stored, and baking to world space (STGA,
embedding)."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..flame.quaternions import from_matrices, multiply, normalized, to_matrices
from .splats import SH_C0, Splats, turned_harmonics
from .strain import StrainBasis, gram_deformation

CONVENTIONS = ("stga", "gaussian_avatars")
"""Names of the ways to derive a local frame from a triangle (`face_frames`)."""
MIN_DIVISOR = 1e-30
"""Least value that is divided by, or whose logarithm is taken, in place of zero."""

MAX_UNEVENNESS = 1e-6
"""Relative difference between a matrix's scales that is float32's rounding."""
MIN_AREA_RATIO = 1e-4
"""A triangle whose area is below this fraction of its longest edge's square counts as a line:
vertices on a line, rounded to float32, have ratios of 1e-6 to 1e-5, and their normal and area are
those of the rounding."""
# from this z on, the perpendicular of a unit vector is sought in the x direction
UPRIGHT_COSINE = 0.8
"""z component of a triangle's first axis above which x replaces z in the cross product that stands
for a missing normal."""
NO_COLUMNS = np.zeros((1, 0), np.float32)
"""`FaceFrames.deformation` and `color` where nothing needs or drives them."""


@dataclass(frozen=True)
class FaceFrames:
    """Per triangle: world = scale · rotation @ local + origin.

    origin (F, 3) meters, rotation (F, 3, 3) proper, scale (F,).
    deformation (F, D) float32 (`avatar.strain`), D = 6, or 0 where it is not needed.
    color (F, C) float32 sRGB, added to the colors of a triangle's splats (`avatar.offsets`), C = 3,
    or 0 where nothing is.
    """

    origin: np.ndarray
    rotation: np.ndarray
    scale: np.ndarray
    deformation: np.ndarray = field(default_factory=lambda: NO_COLUMNS)
    color: np.ndarray = field(default_factory=lambda: NO_COLUMNS)

    @cached_property
    def quaternion(self) -> np.ndarray:
        """(F, 4) wxyz of the same rotation; needed for baking, not for rendering."""
        return from_matrices(self.rotation)


WORLD = FaceFrames(np.zeros((1, 3)), np.eye(3)[None], np.ones(1))
"""The single frame of a world-space set of splats (face 0)."""


def face_frames(
    vertices: np.ndarray,
    faces: np.ndarray,
    neutral: np.ndarray,
    convention: str = "stga",
    strain: StrainBasis | None = None,
    neutral_areas: np.ndarray | None = None,
) -> FaceFrames:
    """Local frame of every triangle of a posed mesh.

    vertices, neutral (V, 3) meters; faces (F, 3). Computed and returned in float64. strain: the
    neutral mesh's basis where splats follow strain. neutral_areas (F,): `face_areas` of the neutral
    mesh, where they are known. "stga": axes [n(p0−o), ·, normal], scale = sqrt(area / neutral
    area), local unit meters of the neutral mesh (STGA, embedding). "gaussian_avatars": axes
    [n(p1−p0), normal, ·], scale = mean of edge and height, local unit the triangle
    (GaussianAvatars' released code). A triangle without area (see MIN_AREA_RATIO) keeps a proper
    rotation and a finite scale.
    """
    triangles = _triangles(vertices, faces)
    to_p1, to_p2 = triangles.edges
    if convention == "stga":
        # p0 - origin without computing the origin, whose rounding would not vanish where the
        # corners coincide.
        first, normal = _orthonormal((to_p1 + to_p2) / -3, triangles)
        axes = first, _cross(normal, first), normal
        before = face_areas(neutral, faces) if neutral_areas is None else neutral_areas
        # A triangle without area in the neutral mesh has no meaningful ratio: its scale is 1.
        ratio = triangles.twice_area / 2 / np.maximum(before, MIN_DIVISOR)
        scale = np.where(before > 0, np.sqrt(ratio), 1.0)
    elif convention == "gaussian_avatars":
        edge = _length(to_p1)
        side = _length(to_p2)
        first, normal = _orthonormal(to_p1, triangles)
        axes = first, normal, _cross(first, normal)
        no_edge = edge <= MIN_AREA_RATIO * np.sqrt(triangles.longest_squared)
        height = triangles.twice_area / np.where(no_edge, 1.0, edge)
        scale = (edge + np.where(no_edge, side, height)) / 2
    else:
        raise ValueError(f"embedding convention {convention!r} is not one of {CONVENTIONS}")
    deformed = NO_COLUMNS
    if strain is not None:
        first_squared, second_squared = triangles.squared
        products = first_squared, _dot(to_p1, to_p2), second_squared
        deformed = gram_deformation(strain, *products, triangles.normal)
    p0, p1, p2 = triangles.corners
    origin = np.ascontiguousarray(((p0 + p1 + p2) / 3).T)
    rotation = np.empty((len(faces), 3, 3))
    for column, axis in enumerate(axes):
        for row in range(3):
            rotation[:, row, column] = axis[row]
    return FaceFrames(origin, rotation, scale, deformed)


def frame_backward(
    vertices: np.ndarray, faces: np.ndarray, frames: FaceFrames, by_frame: np.ndarray
) -> np.ndarray:
    """Gradient (V, 3) of a scalar with respect to the vertices, from its gradient with respect to
    "stga" frames.

    The reverse of `face_frames`, with all vectors in the frame's own axes: by_frame (F, 7) are the
    gradients with respect to the origin (3), to a small rotation of the frame (3) and to the
    logarithm of its scale. Deformation passes no gradient on, and a line (see MIN_AREA_RATIO)
    only its force.
    """
    force = by_frame[:, :3]
    torque = by_frame[:, 3:6]
    enlargement = by_frame[:, 6]
    corners = (np.asarray(vertices, np.float64)[faces] - frames.origin[:, None]) @ frames.rotation
    x = corners[..., 0]
    y = corners[..., 1]
    twice = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0])
    edges = corners - corners[:, [1, 2, 0]]
    longest_squared = np.einsum("fkc,fkc->fk", edges, edges).max(1)
    flat = twice <= np.maximum(2 * MIN_AREA_RATIO * longest_squared, MIN_DIVISOR)
    per_area = np.where(flat, 0.0, 1 / np.where(flat, 1.0, twice))[:, None]
    # Slopes (F, 3) of the corners' barycentric coordinates: the edge across, turned to the left,
    # over twice the area.
    slope_x = (y[:, [1, 2, 0]] - y[:, [2, 0, 1]]) * per_area
    slope_y = (x[:, [2, 0, 1]] - x[:, [1, 2, 0]]) * per_area
    # The first axis points from the origin to p0.
    spin = np.where(flat, 0.0, torque[:, 2] / np.where(flat, 1.0, x[:, 0]))
    pull = np.repeat(force[:, None] / 3, 3, axis=1)
    pull[..., 0] += enlargement[:, None] / 2 * slope_x
    turn = np.array([2 / 3, -1 / 3, -1 / 3])
    pull[..., 1] += enlargement[:, None] / 2 * slope_y + spin[:, None] * turn
    pull[..., 2] += torque[:, :1] * slope_y - torque[:, 1:2] * slope_x
    pull = (pull @ frames.rotation.transpose(0, 2, 1)).reshape(-1, 3)
    return np.stack([np.bincount(faces.ravel(), column, len(vertices)) for column in pull.T], -1)


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area (F,) in square meters of every triangle; exactly 0 where it counts as a line (see
    MIN_AREA_RATIO)."""
    triangles = _triangles(vertices, faces)
    area = triangles.twice_area / 2
    least = MIN_AREA_RATIO * triangles.longest_squared
    return np.where(area > np.maximum(least, MIN_DIVISOR), area, 0.0)


def points_to_world(points: np.ndarray, frames: FaceFrames, face: np.ndarray) -> np.ndarray:
    """(N, 3) in meters of points (N, 3) in the frames of the triangles `face` (N,)."""
    turned = np.einsum("nij,nj->ni", frames.rotation[face], points)
    return frames.scale[face, None] * turned + frames.origin[face]


def to_world(splats: Splats, frames: FaceFrames) -> Splats:
    """Bake local splats into world space. SH keep their coefficients: their directions are world
    directions.

    The frames' color is added to the constant coefficient.
    """
    face = splats.face
    scale = frames.scale[splats.face]
    xyz = points_to_world(splats.xyz, frames, face)
    rotation = multiply(frames.quaternion[face], normalized(splats.rotation))
    log_scale = splats.log_scale + np.log(np.maximum(scale, MIN_DIVISOR))[:, None]
    return replace(
        splats,
        xyz=xyz.astype(np.float32),
        rotation=rotation.astype(np.float32),
        log_scale=log_scale.astype(np.float32),
        sh=colored_sh(splats, frames),
        face=np.zeros_like(face),
    )


def placed(world: Splats, matrix: np.ndarray) -> Splats:
    """World-space splats in a space that `matrix` (4, 4) leads to: it may turn, scale, mirror and
    shear. Harmonics turn along, of a matrix that shears by the rotation nearest to it."""
    linear = np.asarray(matrix, np.float64)[:3, :3]
    left, stretches, right = np.linalg.svd(linear)
    turn = left @ right
    rotation = normalized(world.rotation)
    log_scale = world.log_scale.astype(np.float64)
    if np.ptp(stretches) <= MAX_UNEVENNESS * stretches[0]:
        # an ellipsoid is its own mirror image
        rotation = multiply(from_matrices(turn * np.linalg.det(turn)), rotation)
        log_scale = log_scale + np.log(max(stretches[0], MIN_DIVISOR))
    else:
        axes = linear @ (to_matrices(rotation) * np.exp(log_scale)[:, None])
        axes, lengths, _ = np.linalg.svd(axes)
        rotation = from_matrices(axes * np.linalg.det(axes)[:, None, None])
        log_scale = np.log(np.maximum(lengths, MIN_DIVISOR))
    is_turned = not np.array_equal(turn, np.eye(3)) and world.sh_degree > 0
    return replace(
        world,
        xyz=(world.xyz @ linear.T + matrix[:3, 3]).astype(np.float32),
        rotation=rotation.astype(np.float32),
        log_scale=log_scale.astype(np.float32),
        sh=turned_harmonics(world.sh, turn) if is_turned else world.sh,
    )


def colored_sh(splats: Splats, frames: FaceFrames) -> np.ndarray:
    """The splats' `sh` (N, K, 3) with the frames' color."""
    if not frames.color.shape[1]:
        return splats.sh
    sh = splats.sh.copy()
    sh[:, 0] += frames.color[splats.face] / np.float32(SH_C0)
    return sh


def to_local(world: Splats, frames: FaceFrames, face: np.ndarray) -> Splats:
    """Express world-space splats in the frames of the triangles `face` (N,): the inverse of
    `to_world`."""
    scale = np.maximum(frames.scale[face], MIN_DIVISOR)
    offset = world.xyz - frames.origin[face]
    xyz = np.einsum("nji,nj->ni", frames.rotation[face], offset) / scale[:, None]
    inverse = frames.quaternion[face] * np.array([1.0, -1.0, -1.0, -1.0])
    rotation = multiply(inverse, normalized(world.rotation))
    return replace(
        world,
        xyz=xyz.astype(np.float32),
        rotation=rotation.astype(np.float32),
        log_scale=(world.log_scale - np.log(scale)[:, None]).astype(np.float32),
        face=np.asarray(face, np.int32),
    )


# Vectors of triangles are (3, F) here: arithmetic on whole rows takes a fraction of the time of
# that on columns.


class _Triangles(NamedTuple):
    """corners (3 corners, 3, F); edges p1 − p0 and p2 − p0, each (3, F), their squared lengths (F,)
    and that of the longest of three; normal (3, F), as long as twice the area; twice_area (F,)."""

    corners: np.ndarray
    edges: tuple[np.ndarray, np.ndarray]
    squared: tuple[np.ndarray, np.ndarray]
    longest_squared: np.ndarray
    normal: np.ndarray
    twice_area: np.ndarray


def _triangles(vertices: np.ndarray, faces: np.ndarray) -> _Triangles:
    rows = np.ascontiguousarray(np.asarray(vertices, np.float64).T)
    corners = np.take(rows, np.ascontiguousarray(faces.T), axis=1).transpose(1, 0, 2)
    edges = corners[1] - corners[0], corners[2] - corners[0]
    third = corners[2] - corners[1]
    first = _dot(edges[0], edges[0])
    second = _dot(edges[1], edges[1])
    longest = np.maximum(np.maximum(first, second), _dot(third, third))
    normal = _cross(*edges)
    return _Triangles(corners, edges, (first, second), longest, normal, _length(normal))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def _length(v: np.ndarray) -> np.ndarray:
    return np.sqrt(_dot(v, v))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _orthonormal(first: np.ndarray, triangles: _Triangles) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors along `first` (3, F) and the triangles' normals, perpendicular to each other.

    Where the triangle is a line, any perpendicular of `first` is used as the normal; where `first`
    is negligible beside the longest edge, the x axis is used for it. `scene.display.frame_nodes`
    follows the same rules.
    """
    longest = triangles.longest_squared
    length = _length(first)
    normal = triangles.normal
    no_first = length <= MIN_AREA_RATIO * np.sqrt(longest)
    x_axis = np.array([[1.0], [0.0], [0.0]])
    if no_first.any():
        first = np.where(no_first, x_axis, first / np.where(no_first, 1.0, length))
    else:
        first = first / length
    no_normal = triangles.twice_area <= 2 * MIN_AREA_RATIO * longest
    if no_normal.any():
        upright = np.abs(first[2]) > UPRIGHT_COSINE
        z_axis = np.array([[0.0], [0.0], [1.0]])
        substitute = _cross(first, np.where(upright, x_axis, z_axis))
        normal = np.where(no_normal, substitute, normal)
    normal = normal - _dot(normal, first) * first
    return first, normal / _length(normal)
