"""Deformation of triangles, which colors and positions may follow: strain, and how the normal
turned."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

STRAIN_COMPONENTS = 3
"""Stretch along two directions of the triangle's plane, and the shear between them."""
STRAIN_GAIN = 5.0
"""Unit of strain: a stretch of 18 % (E = 0.2) counts as 1."""
MAX_STRAIN = 2.0
"""Bound to which strain is clipped, on both sides."""
MIN_COMPRESSION = 0.2
"""Compression that colors do not follow yet (E = 0.04): coefficients fitted to so little are mostly
noise."""
MAX_NORMAL_CHANGE = 2.0
"""Largest change of a unit normal, in each component."""
TRAINED_RANGE = np.array(
    [
        [-MAX_STRAIN, -MAX_STRAIN, -MAX_STRAIN, *3 * [-MAX_NORMAL_CHANGE]],
        [-MIN_COMPRESSION, -MIN_COMPRESSION, MAX_STRAIN, *3 * [MAX_NORMAL_CHANGE]],
    ],
    np.float32,
)
"""Lowest and highest deformation that colors and positions are trained to follow. Folds and their
shadows come with compression and shear; what is fitted to compression is not to be continued into
stretch. Within this range, a mesh at rest has a strain of −MIN_COMPRESSION, not 0."""
RANGE_MARGIN = 1.2
"""Largest strain that splats follow, as a multiple of the largest strain in training: other
expressions are sometimes a little stronger."""
AVERAGING_ROUNDS = 3
"""Rounds in which `smoothed_strain` averages over triangles that share an edge: a bulge moves more
than one triangle."""
MIN_SQUARED_NORMAL = 1e-24
"""Squared normal (m⁴) of a neutral triangle with edges of a micrometer; a smaller one counts as
having no area."""


@dataclass(frozen=True)
class IndexLists:
    """Lists of indices, compressed: the i-th is indices[indptr[i] : indptr[i + 1]]."""

    indptr: np.ndarray
    indices: np.ndarray

    @property
    def counts(self) -> np.ndarray:
        """Length of each list."""
        return np.diff(self.indptr)

    @cached_property
    def by_rank(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """Lists by falling length; for each rank, the index at that place of every list that is
        long enough. So numpy adds along them without a loop over lists."""
        order = np.argsort(-self.counts, kind="stable")
        starts = self.indptr[:-1][order]
        counts = self.counts[order]
        lengths = ((counts > rank).sum() for rank in range(int(counts.max(initial=0))))
        return order, [self.indices[starts[:n] + rank] for rank, n in enumerate(lengths)]


@dataclass(frozen=True)
class StrainBasis:
    """Precomputed terms of a neutral mesh with V vertices and F triangles.

    faces (F, 3); gram (F, 3) squared lengths and product of the neutral edges: d1·d1, d1·d2, d2·d2.
    to_tensor (F, 3, 6): change of gram → E in neutral space, a symmetric tensor as xx, yy, zz, xy,
    yz, zx.
    to_plane (F, 3, 6): tensor → E along the first edge, across it, and their shear; both float32.
    corners (3, F): `faces` by corner.
    vertex_faces: V lists of the triangles that touch a vertex.
    vertex_weight (V,): a third of one over how many these are.
    normal (3, F): unit normals of the neutral mesh, 0 of triangles without area.
    range (F, 2, 6): lowest and highest deformation; beyond, it is clipped.
    neighbors: `edge_neighbors`.
    neighbor_weight (F,): one over how many neighbors a triangle has and itself.
    """

    faces: np.ndarray
    gram: np.ndarray
    to_tensor: np.ndarray
    to_plane: np.ndarray
    corners: np.ndarray
    vertex_faces: IndexLists
    vertex_weight: np.ndarray
    normal: np.ndarray
    range: np.ndarray
    neighbors: IndexLists
    neighbor_weight: np.ndarray


def strain_basis(
    neutral: np.ndarray, faces: np.ndarray, limits: np.ndarray | None = None
) -> StrainBasis:
    """The basis of a neutral mesh: neutral (V, 3) meters, faces (F, 3). A triangle without area
    stays unstrained.

    limits: (F, 2, 6) `StrainBasis.range`; None: ±MAX_STRAIN and ±MAX_NORMAL_CHANGE.
    """
    p0, p1, p2 = np.asarray(neutral, np.float64)[faces.T]
    d1 = p1 - p0
    d2 = p2 - p0
    normal = np.cross(d1, d2)
    square = _dot(normal, normal)
    flat = square < MIN_SQUARED_NORMAL
    inverse = np.where(flat, 0.0, 1 / np.where(flat, 1.0, square))[:, None]
    # The dual edges: a1·d1 = a2·d2 = 1, a1·d2 = a2·d1 = 0, both in the triangle's plane.
    a1 = np.cross(d2, normal) * inverse
    a2 = np.cross(normal, d1) * inverse
    along = np.where(flat, 0.0, 1 / np.sqrt(np.where(flat, 1.0, _dot(d1, d1))))[:, None] * d1
    across = np.cross(normal, along) * np.sqrt(inverse)
    corners = np.ascontiguousarray(faces.T, np.intp)
    vertex_faces = _index_lists(corners.ravel(), np.tile(np.arange(len(faces)), 3), len(neutral))
    neighbors = edge_neighbors(faces)
    to_tensor = _product(a1, a1) / 2, _product(a1, a2), _product(a2, a2) / 2
    to_plane = _product(along, along), _product(across, across), _product(along, across)
    twice = np.array([1.0, 1, 1, 2, 2, 2])  # a tensor has each of the mixed components twice
    if limits is None:
        highest = np.repeat([MAX_STRAIN, MAX_NORMAL_CHANGE], STRAIN_COMPONENTS)
        ends = np.stack([-highest, highest]).astype(np.float32)
        limits = np.broadcast_to(ends, (len(faces), *ends.shape))
    return StrainBasis(
        faces=faces,
        gram=_by_component(np.stack([_dot(d1, d1), _dot(d1, d2), _dot(d2, d2)], -1)),
        to_tensor=_by_component(np.stack(to_tensor, 1), np.float32),
        to_plane=_by_component(twice * np.stack(to_plane, 1), np.float32),
        corners=corners,
        vertex_faces=vertex_faces,
        vertex_weight=(1 / (3 * np.maximum(vertex_faces.counts, 1))).astype(np.float32),
        normal=_unit(normal.T),
        range=_by_component(limits),
        neighbors=neighbors,
        neighbor_weight=(1 / (1 + neighbors.counts)).astype(np.float32),
    )


def _index_lists(owners: np.ndarray, indices: np.ndarray, count: int) -> IndexLists:
    """The lists of `count` owners, from pairs of an owner (N,) and an index (N,), which stay in
    order."""
    indptr = np.concatenate([[0], np.cumsum(np.bincount(owners, minlength=count))])
    return IndexLists(indptr, indices[np.argsort(owners, kind="stable")])


def _add_listed(lists: IndexLists, rows: np.ndarray, total: np.ndarray) -> None:
    """Add to the columns of total (·, L) the columns of rows (·, N) that each of L lists names, in
    the list's order.

    Not by `np.add.at`, which numpy before 1.25, as in Blender 4.2, carries out element by element.
    """
    order, ranks = lists.by_rank
    for row, sums in zip(rows, total, strict=True):
        ordered = np.take(sums, order)
        for indices in ranks:
            ordered[: len(indices)] += np.take(row, indices)
        sums[order] = ordered


def edge_neighbors(faces: np.ndarray) -> IndexLists:
    """F lists of the triangles that share an edge with each of faces (F, 3), once an edge.

    An edge of more than two triangles makes all of them neighbors.
    """
    start = np.asarray(faces, np.int64).ravel()
    end = np.roll(faces, -1, axis=1).ravel()
    number = np.minimum(start, end) * (int(start.max(initial=0)) + 1) + np.maximum(start, end)
    _, edge, count = np.unique(number, return_inverse=True, return_counts=True)
    order = np.argsort(edge, kind="stable")
    owner = order // 3
    size = count[edge[order]]
    place = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    pairs = [np.zeros((0, 2), np.intp)]
    for step in range(1, int(count.max(initial=1))):
        other = owner[np.arange(len(order)) - place + (place + step) % size]
        shared = (size > step) & (other != owner)
        pairs.append(np.stack([owner[shared], other[shared]], -1))
    one, other = np.concatenate(pairs).T
    return _index_lists(one, other, len(faces))


def strain_from_rest(basis: StrainBasis, deformed: np.ndarray) -> np.ndarray:
    """Strain (F, 3) float32 of `deformation` (F, 6), less that of a mesh at rest."""
    return np.asarray((deformed - at_rest(basis.range))[:, :STRAIN_COMPONENTS], np.float32)


def smoothed_strain(basis: StrainBasis, deformed: np.ndarray) -> np.ndarray:
    """Strain (F, 3) float32 around each triangle: 0 for a mesh at rest.

    deformed (F, 6): of `deformation`. `strain_from_rest`, then AVERAGING_ROUNDS times the mean of a
    triangle and those that share an edge with it, component by component.
    """
    smoothed = np.ascontiguousarray(strain_from_rest(basis, deformed).T)
    for _ in range(AVERAGING_ROUNDS):
        total = smoothed.copy()
        _add_listed(basis.neighbors, smoothed, total)
        smoothed = total * basis.neighbor_weight
    return np.ascontiguousarray(smoothed.T)


def trained_range(count: int) -> np.ndarray:
    """TRAINED_RANGE for each of `count` triangles: (count, 2, 6) float32."""
    return np.broadcast_to(TRAINED_RANGE, (count, *TRAINED_RANGE.shape)).copy()


def at_rest(limits: np.ndarray) -> np.ndarray:
    """Deformation (…, 6) of a mesh at rest within limits (…, 2, 6)."""
    return np.asarray(np.clip(np.float32(0), limits[..., 0, :], limits[..., 1, :]))


def observed_range(basis: StrainBasis, meshes: Iterable[np.ndarray]) -> np.ndarray:
    """Lowest and highest deformation (F, 2, 6) float32 of each triangle in posed meshes (V, 3),
    with a margin.

    It includes the neutral mesh, and stays within that of the basis. What is fitted to a few
    expressions is not extrapolated to stronger ones.
    """
    limits = range_with_margin(at_rest(basis.range), (deformation(basis, mesh) for mesh in meshes))
    return np.clip(limits, basis.range[:, :1], basis.range[:, 1:]).astype(np.float32)


def range_with_margin(rest: np.ndarray, values: Iterable[np.ndarray]) -> np.ndarray:
    """Lowest and highest (F, 2, D) of rest (F, D) and of values (F, D) that are RANGE_MARGIN times
    as far from it."""
    limits = np.stack([rest, rest], axis=1)
    for value in values:
        wider = rest + np.float32(RANGE_MARGIN) * (value - rest)
        limits[:, 0] = np.minimum(limits[:, 0], wider)
        limits[:, 1] = np.maximum(limits[:, 1], wider)
    return np.asarray(limits)


def deformation(basis: StrainBasis, vertices: np.ndarray) -> np.ndarray:
    """Strain (3) and change of the unit normal (3) of every triangle of a posed mesh within their
    ranges, (F, 6) float32. Strain is 5·E, and E = 0 for a mesh moved rigidly.

    vertices (V, 3) meters. E = ½(FᵀF − I) is Green's strain of the map from the neutral to the
    posed mesh, averaged over the triangles that touch a triangle (each vertex's mean over its
    triangles, then the mean of its three vertices), so that colors do not jump at edges. Columns:
    along the neutral triangle's first edge, across it, shear, then the normal's x, y, z in world
    axes.
    """
    rows = np.ascontiguousarray(np.asarray(vertices, np.float64).T)
    p0, p1, p2 = np.take(rows, basis.corners, axis=1).transpose(1, 0, 2)
    e1 = p1 - p0
    e2 = p2 - p0
    products = _dot(e1.T, e1.T), _dot(e1.T, e2.T), _dot(e2.T, e2.T)
    return gram_deformation(basis, *products, np.cross(e1, e2, axis=0))


def gram_deformation(
    basis: StrainBasis, d11: np.ndarray, d12: np.ndarray, d22: np.ndarray, normal: np.ndarray
) -> np.ndarray:
    """`deformation` from scalar products (F,) of the posed triangles' edges p1 − p0 and p2 − p0,
    and their cross product (3, F), in square meters."""
    # Vectors and tensors are rows (·, F) here: numpy computes whole rows in a fraction of the time
    # of short columns.
    change = np.asarray(np.stack([d11, d12, d22]) - basis.gram.T, np.float32)
    tensor = np.einsum("kf,kdf->df", change, basis.to_tensor.transpose(1, 2, 0))
    at_vertex = np.zeros((len(tensor), len(basis.vertex_weight)), np.float32)
    _add_listed(basis.vertex_faces, tensor, at_vertex)
    p0, p1, p2 = np.take(at_vertex * basis.vertex_weight, basis.corners, axis=1).transpose(1, 0, 2)
    strain = np.einsum("df,kdf->kf", p0 + p1 + p2, basis.to_plane.transpose(1, 2, 0))
    turned = np.where(basis.normal.any(0), _unit(normal) - basis.normal, 0.0)
    found = np.concatenate([np.float32(STRAIN_GAIN) * strain, turned.astype(np.float32)])
    lowest, highest = basis.range.transpose(1, 2, 0)
    return np.ascontiguousarray(np.minimum(np.maximum(found, lowest), highest).T)


def _unit(normal: np.ndarray) -> np.ndarray:
    """Unit vectors (3, F); 0 where triangles have no area."""
    square = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]
    flat = square < MIN_SQUARED_NORMAL
    return np.where(flat, 0.0, normal / np.sqrt(np.where(flat, 1.0, square)))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Scalar products (F,) of vectors (F, 3)."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _by_component(per_face: np.ndarray, dtype: Any = None) -> np.ndarray:
    """The same array (F, …), with the values of one component side by side in memory."""
    return np.moveaxis(np.ascontiguousarray(np.moveaxis(per_face, 0, -1), dtype), -1, 0)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The symmetric part (F, 6) of the outer product of vectors (F, 3): xx, yy, zz, xy, yz, zx."""
    outer = (a[:, :, None] * b[:, None, :] + b[:, :, None] * a[:, None, :]) / 2
    return outer[:, [0, 1, 2, 0, 1, 2], [0, 1, 2, 1, 2, 0]]
