"""Camera-space frames and strain of a posed mesh's triangles, as `avatar.embedding` and `avatar.strain` compute them.

In float64 like them, because a head may be far from the origin and strain is a difference of squares: for some ten
thousand triangles that costs a GPU nothing, while the host would need longer for it than the GPU for an iteration.
"""

# mypy: disable-error-code="valid-type, index"

import numpy as np
import warp as wp

from ...avatar import embedding, strain
from ...capture.camera import Camera
from .buffers import DeviceBufferPool

wp.set_module_options({"enable_backward": False})

MIN_AREA_RATIO, UPRIGHT_COSINE, MIN_DIVISOR = (
    wp.constant(wp.float64(c)) for c in (embedding.MIN_AREA_RATIO, embedding.UPRIGHT_COSINE, embedding.MIN_DIVISOR)
)
STRAIN_GAIN, MAX_STRAIN = wp.constant(wp.float64(strain.STRAIN_GAIN)), wp.constant(wp.float64(strain.MAX_STRAIN))
ZERO, ONE, TWO, THREE = (wp.constant(wp.float64(n)) for n in range(4))

Tensor = wp.types.vector(length=6, dtype=wp.float64)
"""A symmetric tensor as xx, yy, zz, xy, yz, zx."""


@wp.func
def _perpendicular(first: wp.vec3d, normal: wp.vec3d, longest: wp.float64) -> wp.vec3d:
    """The unit normal beside a unit axis; any perpendicular where the triangle is a line."""
    if wp.length(normal) <= TWO * MIN_AREA_RATIO * longest:
        other = wp.vec3d(ZERO, ZERO, ONE)
        if wp.abs(first[2]) > UPRIGHT_COSINE:
            other = wp.vec3d(ONE, ZERO, ZERO)
        normal = wp.cross(first, other)
    normal = normal - wp.dot(normal, first) * first
    return normal / wp.length(normal)


@wp.kernel
def compose_frames(
    vertices: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    neutral_area: wp.array[wp.float64],
    area_scales: wp.bool,
    turn: wp.mat33d,
    shift: wp.vec3d,
    origin: wp.array[wp.vec3],
    matrix: wp.array[wp.mat33],
):
    """camera point = matrix @ local + origin.

    neutral_area (F,), 0 where a triangle counts as a line. area_scales: "stga", otherwise "gaussian_avatars".
    turn, shift: world to camera.
    """
    f = wp.tid()
    corners = faces[f]
    p0, p1, p2 = vertices[corners[0]], vertices[corners[1]], vertices[corners[2]]
    e1, e2, e3 = p1 - p0, p2 - p0, p2 - p1
    longest = wp.max(wp.dot(e1, e1), wp.max(wp.dot(e2, e2), wp.dot(e3, e3)))
    least = MIN_AREA_RATIO * wp.sqrt(longest)
    raw_normal = wp.cross(e1, e2)
    first = e1
    if area_scales:
        first = ((p0 - p1) + (p0 - p2)) / THREE
    length = wp.length(first)
    if length <= least:
        first = wp.vec3d(ONE, ZERO, ZERO)
    else:
        first = first / length
    normal = _perpendicular(first, raw_normal, longest)
    axes = wp.matrix_from_cols(first, normal, wp.cross(first, normal))
    edge = wp.length(e1)
    across = wp.length(e2)
    if edge > least:
        across = wp.length(raw_normal) / edge
    scale = (edge + across) / TWO
    if area_scales:
        axes = wp.matrix_from_cols(first, wp.cross(normal, first), normal)
        scale = ONE
        if neutral_area[f] > ZERO:
            scale = wp.sqrt(wp.length(raw_normal) / TWO / wp.max(neutral_area[f], MIN_DIVISOR))
    m = scale * (turn * axes)
    o = turn * ((p0 + p1 + p2) / THREE) + shift
    origin[f] = wp.vec3(float(o[0]), float(o[1]), float(o[2]))
    matrix[f] = wp.mat33(
        float(m[0, 0]), float(m[0, 1]), float(m[0, 2]), float(m[1, 0]), float(m[1, 1]), float(m[1, 2]),
        float(m[2, 0]), float(m[2, 1]), float(m[2, 2]),
    )  # fmt: skip


@wp.kernel
def strain_faces(
    vertices: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    gram: wp.array[wp.vec3d],
    to_tensor: wp.array2d[Tensor],
    tensor: wp.array[Tensor],
):
    """Green's strain of every triangle; gram (F,) and to_tensor (F, 3) as in `StrainBasis`."""
    f = wp.tid()
    corners = faces[f]
    p0 = vertices[corners[0]]
    e1, e2 = vertices[corners[1]] - p0, vertices[corners[2]] - p0
    change = wp.vec3d(wp.dot(e1, e1), wp.dot(e1, e2), wp.dot(e2, e2)) - gram[f]
    tensor[f] = change[0] * to_tensor[f, 0] + change[1] * to_tensor[f, 1] + change[2] * to_tensor[f, 2]


@wp.kernel
def average_at_vertices(
    tensor: wp.array[Tensor], start: wp.array[wp.int32], touching: wp.array[wp.int32], out: wp.array[Tensor]
):  # fmt: skip
    """Mean over the triangles that touch a vertex: touching[start[v]] to touching[start[v + 1] − 1], in this order."""
    v = wp.tid()
    total = Tensor()
    for n in range(start[v], start[v + 1]):
        total += tensor[touching[n]]
    out[v] = total / wp.float64(wp.max(start[v + 1] - start[v], 1))


@wp.kernel
def strain_in_plane(
    at_vertex: wp.array[Tensor], faces: wp.array[wp.vec3i], to_plane: wp.array2d[Tensor], out: wp.array2d[wp.float32]
):  # fmt: skip
    """The mean of a triangle's vertices, in its own directions, as `face_strain` gives it."""
    f = wp.tid()
    corners = faces[f]
    mean = (at_vertex[corners[0]] + at_vertex[corners[1]] + at_vertex[corners[2]]) / THREE
    for k in range(out.shape[1]):
        out[f, k] = float(wp.clamp(STRAIN_GAIN * wp.dot(mean, to_plane[f, k]), -MAX_STRAIN, MAX_STRAIN))


class Embedding:
    """A mesh's topology and neutral form on the device, computed once."""

    def __init__(
        self,
        device: wp.Device,
        neutral: np.ndarray,
        faces: np.ndarray,
        convention: str,
        basis: strain.StrainBasis | None = None,
    ) -> None:
        """neutral (V, 3), faces (F, 3); convention as in `face_frames`; basis: where colors follow strain,
        within ±MAX_STRAIN: its range concerns what training has not seen."""
        if convention not in embedding.CONVENTIONS:
            raise ValueError(f"embedding convention {convention!r} is not one of {embedding.CONVENTIONS}")
        self._buffers, self._area_scales = DeviceBufferPool(device), convention == "stga"

        def array(values: np.ndarray, dtype: type) -> wp.array:
            return wp.array(values, dtype=dtype, device=device)

        self._faces = array(faces.astype(np.int32), wp.vec3i)
        self._area = array(embedding.face_areas(neutral, faces), wp.float64)
        self._strain: tuple[wp.array, ...] | None = None
        if basis is not None:
            corner = faces.ravel()
            by_vertex = np.argsort(corner, kind="stable")
            start = np.searchsorted(corner[by_vertex], np.arange(len(neutral) + 1))
            self._strain = (
                array(basis.gram, wp.vec3d), array(basis.to_tensor, Tensor), array(basis.to_plane, Tensor),
                array(start.astype(np.int32), wp.int32), array((by_vertex // 3).astype(np.int32), wp.int32),
            )  # fmt: skip

    def frames(self, vertices: wp.array, camera: Camera) -> tuple[wp.array, wp.array, wp.array]:
        """origin (F,), matrix (F,) and strain (F, S) of the posed mesh, as in `CameraFrames`; valid until called again.

        vertices (V,) float64 vectors, world meters.
        """
        n, device, array = self._faces.size, self._buffers.device, self._buffers.get
        origin, matrix = array("origin", n, wp.vec3), array("matrix", n, wp.mat33)
        pose = camera.world_to_camera
        turn, shift = wp.mat33d(*pose[:3, :3].ravel().tolist()), wp.vec3d(*pose[:3, 3].tolist())
        given = [vertices, self._faces, self._area, self._area_scales, turn, shift]
        wp.launch(compose_frames, n, given, [origin, matrix], device=device)
        if self._strain is None:
            return origin, matrix, wp.empty((n, 0), wp.float32, device=device)
        gram, to_tensor, to_plane, start, touching = self._strain
        tensor, at_vertex = array("tensor", n, Tensor), array("at_vertex", vertices.size, Tensor)
        out = array("strain", (n, strain.STRAIN_COMPONENTS))
        wp.launch(strain_faces, n, [vertices, self._faces, gram, to_tensor], [tensor], device=device)
        wp.launch(average_at_vertices, vertices.size, [tensor, start, touching], [at_vertex], device=device)
        wp.launch(strain_in_plane, n, [at_vertex, self._faces, to_plane], [out], device=device)
        return origin, matrix, out
