"""Triangle meshes: normals, parts, rigid alignment, and which triangle a camera's pixels show."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ..flame.quaternions import unit
from .camera import Camera

ArrayPair = tuple[np.ndarray, np.ndarray]
"""Two arrays, as the function that returns them describes."""
MAX_ITERATIONS = 100
"""Reweighted fits of a posed mesh to the neutral one, at most."""

MIN_RESIDUAL = 1e-7
"""Fraction of the mesh's size below which residuals are rounding."""
CHUNK_PIXELS = 1 << 21
"""Candidate pixels that are tested at a time, to bound the memory."""
LIPS_AHEAD = np.radians(12.4)
"""Radians between straight down and where the lips are, seen from between the eyes."""
MIN_EYE_HEIGHT_FRACTION = 0.1
"""Least height of the eyes over the mouth, in distances of the eyes from each other."""
MIN_DEPTH_M = 0.01  # Triangles nearer to the camera's plane, or behind it, are not drawn


def triangle_normals(corners: np.ndarray) -> np.ndarray:
    """(F, 3) of triangles with corners (F, 3, 3), as long as twice their area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) unit normals, weighted by the area of triangles; 0 where a vertex has none."""
    corners = np.ascontiguousarray(vertices.T)[:, faces.T]  # a coordinate a row: faster
    u = corners[:, 1] - corners[:, 0]
    v = corners[:, 2] - corners[:, 0]
    flat = faces.ravel()
    count = len(vertices)
    normal = [u[k - 2] * v[k - 1] - u[k - 1] * v[k - 2] for k in range(3)]
    total = np.stack([np.bincount(flat, np.repeat(n, 3), count) for n in normal], axis=-1)
    return unit(total, 1e-20)


def facing(camera: Camera, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Cosine (N,) of the angle between unit normals (N, 3) and the direction to the camera."""
    towards = camera.position - points
    return np.asarray((towards * normals).sum(1) / np.linalg.norm(towards, axis=1))


def pixels_of(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel columns (N,), rows (N,) of world points (N, 3), and (N,) bool: within the image; 0
    where they are not."""
    pixels, depth = camera.project(points)
    x, y = np.floor(pixels).T
    inside = (depth > MIN_DEPTH_M) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    return np.where(inside, x, 0).astype(int), np.where(inside, y, 0).astype(int), inside


def connected_parts(vertices: int, faces: np.ndarray) -> np.ndarray:
    """(V,) int: the least vertex that each vertex is connected with."""
    part = np.arange(vertices)
    while True:
        least = part[faces].min(1)
        before = part.copy()
        for corner in faces.T:
            np.minimum.at(part, corner, least)
        part = part[part]
        if np.array_equal(part, before):
            return part


@dataclass(frozen=True)
class Similarity:
    """x ↦ scale · rotation x + translation."""

    scale: float = 1.0
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    translation: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def apply(self, points: np.ndarray) -> np.ndarray:
        return self.scale * points @ self.rotation.T + self.translation

    def camera(self, camera: Camera) -> Camera:
        """The camera in the world that `apply` leads to."""
        pose = np.eye(4)
        pose[:3, :3] = camera.rotation @ self.rotation.T
        pose[:3, 3] = self.scale * camera.translation - pose[:3, :3] @ self.translation
        return replace(camera, world_to_camera=pose)


def without_head_motion(mesh: np.ndarray, neutral: np.ndarray) -> np.ndarray:
    """The mesh (V, 3) moved rigidly onto the neutral mesh (V, 3), without scale (STGA, selective
    training).

    A robust Procrustes fit: vertices that the expression moves, such as those of an open jaw, get
    hardly any weight, provided that less than half of all vertices move against the skull. A plain
    least-squares fit would tilt the head. The neutral mesh must have an extent
    (`meshes.check_extent`).
    """
    size = np.linalg.norm(np.ptp(neutral, axis=0))
    weights = np.ones(len(mesh))
    fitted = np.asarray(mesh, np.float64)
    for _ in range(MAX_ITERATIONS):
        rotation, translation = weighted_procrustes(mesh, neutral, weights)
        before = fitted
        fitted = mesh @ rotation.T + translation
        residual = np.linalg.norm(fitted - neutral, axis=1)
        # Geman-McClure weights, scaled by the median residual: they fall with its fourth power.
        scale = max(float(np.median(residual)), MIN_RESIDUAL * size)
        weights = 1 / (1 + (residual / scale) ** 2) ** 2
        if np.abs(fitted - before).max() < MIN_RESIDUAL * size:
            break
    return fitted


def weighted_procrustes(source: np.ndarray, target: np.ndarray, weights: np.ndarray) -> ArrayPair:
    """Rotation (3, 3) and translation (3,) with least Σ w·|R·source + t − target|² (Kabsch); points
    (N, 3)."""
    fraction = (weights / weights.sum())[:, None]
    source_center = (fraction * source).sum(0)
    target_center = (fraction * target).sum(0)
    u, _, vt = np.linalg.svd((target - target_center).T @ (fraction * (source - source_center)))
    rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return rotation, target_center - rotation @ source_center


def similarity(source: np.ndarray, target: np.ndarray, metric: bool = False) -> Similarity:
    """The similarity with the least Σ |apply(source) − target|² over points (N, 3) that do not
    coincide (Umeyama). metric: of those with a scale of 1."""
    rotation, _ = weighted_procrustes(source, target, np.ones(len(source)))
    a = source - source.mean(0)
    b = target - target.mean(0)
    scale = 1.0 if metric else float((b * (a @ rotation.T)).sum() / (a**2).sum())
    return Similarity(scale, rotation, target.mean(0) - scale * rotation @ source.mean(0))


def nearest_in_triangles(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (N, K, 3) of the points of triangles, corners (N, K, 3, D), that are
    nearest to points (N, D)."""
    a, b, c = np.moveaxis(corners, 2, 0)
    from_a = points[:, None] - a
    from_b = points[:, None] - b

    def dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return (first * second).sum(axis=-1)

    def along(edge: np.ndarray, offset: np.ndarray) -> np.ndarray:
        return np.clip(dot(offset, edge) / np.maximum(dot(edge, edge), 1e-20), 0, 1)

    ab = b - a
    ac = c - a
    d00 = dot(ab, ab)
    d01 = dot(ab, ac)
    d11 = dot(ac, ac)
    d20 = dot(from_a, ab)
    d21 = dot(from_a, ac)
    determinant = np.maximum(d00 * d11 - d01**2, 1e-20)
    second = (d11 * d20 - d01 * d21) / determinant
    third = (d00 * d21 - d01 * d20) / determinant
    inside = (second >= 0) & (third >= 0) & (second + third <= 1)
    on_ab = along(ab, from_a)
    on_ac = along(ac, from_a)
    on_bc = along(c - b, from_b)
    zero = np.zeros_like(on_ab)
    second = np.stack([second, on_ab, zero, 1 - on_bc])
    third = np.stack([third, zero, on_ac, on_bc])
    options = np.stack([1 - second - third, second, third], axis=-1)
    offset = np.einsum("onkb,nkbc->onkc", options, corners) - points[:, None]
    distance = np.linalg.norm(offset, axis=-1)
    distance[0] = np.where(inside, distance[0], np.inf)
    nearest = distance.argmin(axis=0)[None, ..., None]
    return np.take_along_axis(options, nearest, axis=0)[0]


def rasterize(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> ArrayPair:
    """What a camera sees of a mesh: triangle (H, W) int32, -1 for none, and barycentric coordinates
    (H, W, 3). Both sides of a triangle are visible. Triangles that reach behind the camera are left
    out; barycentric coordinates are those in the image, without perspective."""
    flat, depth = camera.project(vertices)
    inverse_depth = 1 / np.where(depth > 0, depth, np.nan)[faces]
    rows = np.flatnonzero(np.isfinite(inverse_depth).all(1) & np.isfinite(flat[faces]).all((1, 2)))
    corners = flat[faces[rows]]
    slopes = _barycentric_slopes(corners)
    closeness_slopes = (slopes * inverse_depth[rows][:, :, None]).sum(1)
    nearest = np.zeros(camera.width * camera.height)
    owner = np.full(len(nearest), -1)
    # triangles that may show a pixel, in groups whose bounding boxes hold about CHUNK_PIXELS
    low = corners.min(1)
    high = corners.max(1)
    size = np.minimum(high, [camera.width, camera.height]) - np.maximum(low, 0)
    drawn = np.flatnonzero((size >= 0).all(1))
    groups = np.cumsum(np.ceil(size[drawn] + 1).prod(1)) // CHUNK_PIXELS
    for group in np.split(drawn, np.flatnonzero(np.diff(groups)) + 1):
        # pixel by pixel along the lines of the image that cross a triangle, between its edges
        face, line = _counted(group, *_whole(low[group, 1], high[group, 1], camera.height))
        left, right = _crossings(corners, face, line + 0.5)
        row, x = _counted(np.arange(len(face)), *_whole(left, right, camera.width))
        face = face[row]
        y = line[row]
        closeness = _at(closeness_slopes[face], x, y)
        pixel = y * camera.width + x
        np.maximum.at(nearest, pixel, closeness)
        # of several triangles at one depth, the last
        wins = (closeness > 0) & (closeness == nearest[pixel])
        owner[pixel[wins]] = face[wins]
    covered = np.flatnonzero(owner >= 0)
    triangle = np.full(len(nearest), -1, np.int32)
    weights = np.zeros((len(nearest), 3))
    triangle[covered] = rows[owner[covered]]
    y, x = np.divmod(covered, camera.width)
    weights[covered] = np.maximum(_at(slopes[owner[covered]], x[:, None], y[:, None]), 0)
    shape = camera.height, camera.width
    return triangle.reshape(shape), weights.reshape(*shape, 3)


def silhouette(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) bool: the pixels whose centers a mesh covers, as those of `rasterize`, in half its
    time. Triangles that reach near the camera's plane are left out."""
    flat, depth = camera.project(vertices)
    drawn = faces[(depth > MIN_DEPTH_M)[faces].all(1)]
    corners = flat[drawn]
    high = corners[..., 1].max(1)
    face, line = _counted(
        np.arange(len(corners)), *_whole(corners[..., 1].min(1), high, camera.height)
    )
    first, count = _whole(*_crossings(corners, face, line + 0.5), camera.width)
    # where triangles begin along a line of the image, and behind their ends
    stride = camera.width + 1
    size = camera.height * stride
    begin = line * stride + first
    change = np.zeros(size + 1, np.int64)
    np.add.at(change, begin, 1)
    np.subtract.at(change, begin + count, 1)
    covered = np.cumsum(change[:size].reshape(camera.height, stride), axis=1) > 0
    return covered[:, :-1]


def _whole(low: np.ndarray, high: np.ndarray, size: int) -> ArrayPair:
    """The first pixel with its center from `low` to `high` in an image of this size; how many."""
    first = np.ceil(np.clip(low, 0, size + 1) - 0.5).astype(np.int64)
    last = np.floor(np.clip(high, -1, size) - 0.5).astype(np.int64)
    return first, np.maximum(np.minimum(last, size - 1) - first + 1, 0)


def _counted(values: np.ndarray, first: np.ndarray, count: np.ndarray) -> ArrayPair:
    """Each value `count` times, and numbers that count from its `first`."""
    begin = np.cumsum(count) - count
    return np.repeat(values, count), np.arange(count.sum()) + np.repeat(first - begin, count)


def _crossings(corners: np.ndarray, face: np.ndarray, y: np.ndarray) -> ArrayPair:
    """x (R,) of the leftmost and the rightmost point of a triangle on a line of the image; face, y
    (R,). An edge's ends are taken in the order of y, so that two triangles with a common edge agree
    where it lies to the last bit and leave no pixel between them."""
    left = np.full(len(y), np.inf)
    right = np.full(len(y), -np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        first = corners[:, a]
        second = corners[:, b]
        turned = second[:, 1] < first[:, 1]
        x0, y0 = np.where(turned, second.T, first.T)
        x1, y1 = np.where(turned, first.T, second.T)
        slope = np.divide(x1 - x0, y1 - y0, out=np.zeros_like(x0), where=y1 > y0)
        top = y0[face]
        x = x0[face] + slope[face] * (y - top)
        crosses = (top <= y) & (y <= y1[face])
        np.minimum(left, x, out=left, where=crosses)
        np.maximum(right, x, out=right, where=crosses)
    return left, right


def _barycentric_slopes(corners: np.ndarray) -> np.ndarray:
    """(T, 3, 3): the barycentric coordinate of corner k at pixel (x, y) is [k, 0]·x + [k, 1]·y +
    [k, 2]. Zero for triangles that are seen edge-on."""
    x = corners[..., 0] - 0.5
    y = corners[..., 1] - 0.5
    along_x = np.roll(y, -1, 1) - np.roll(y, 1, 1)
    along_y = np.roll(x, 1, 1) - np.roll(x, -1, 1)
    constant = -(along_x * np.roll(x, -1, 1) + along_y * np.roll(y, -1, 1))
    area = _at(np.stack([along_x[:, 0], along_y[:, 0], constant[:, 0]], -1), x[:, 0], y[:, 0])
    with np.errstate(divide="ignore"):
        inverse = np.where(area != 0, 1 / area, 0.0)
    return np.stack([along_x, along_y, constant], -1) * inverse[:, None, None]


def _at(slopes: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return slopes[..., 0] * x + slopes[..., 1] * y + slopes[..., 2]


def head_axes(
    centers: np.ndarray, regions: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """The middle of the eyes (3,); the unit vectors (3, 3) to the head's left, up and ahead; the
    height of the eyes over the mouth. Of triangles' centers (F, 3); None where eyes and mouth are
    not known, or not apart."""
    found = [regions.get(name) for name in ("left_eye", "right_eye", "mouth")]
    if not all(region is not None and region.any() for region in found):
        return None
    left, right, mouth = (centers[region].mean(0) for region in found)
    eyes = (left + right) / 2
    across = unit(left - right)
    up = eyes - mouth
    up = up - (up @ across) * across
    height = float(np.linalg.norm(up))
    if not height > MIN_EYE_HEIGHT_FRACTION * np.linalg.norm(left - right):
        return None
    # The inside of the mouth is in some heads' regions only; lips are in the front half of all.
    depth = centers[found[2]] @ np.cross(across, up)
    lips = centers[found[2]][depth >= np.median(depth)].mean(0)
    up = eyes - lips
    up = unit(up - (up @ across) * across)
    up = np.cos(LIPS_AHEAD) * up + np.sin(LIPS_AHEAD) * np.cross(across, up)
    return eyes, np.stack([across, up, np.cross(across, up)]), height
