"""Which triangle of a mesh each pixel of a camera shows, in NumPy; and which pixels show any, with Pillow."""

import numpy as np

from .camera import Camera

CHUNK_PIXELS = 1 << 21
"""Candidate pixels that are tested at a time, to bound the memory."""
MIN_DEPTH_M = 0.01
"""Triangles nearer to the camera's plane, or behind it, are not drawn."""


def rasterize(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """What a camera sees of a mesh: triangle (H, W) int32, -1 for none, and barycentric coordinates (H, W, 3).

    Both sides of a triangle are visible. Triangles that reach behind the camera are left out; barycentric coordinates
    are those in the image, without perspective.
    """
    flat, depth = camera.project(vertices)
    corners, inverse_depth = flat[faces], 1 / np.where(depth > 0, depth, np.nan)[faces]
    low = np.floor(np.clip(corners.min(1) - 0.5, -1, [camera.width, camera.height]))
    high = np.ceil(np.clip(corners.max(1) + 0.5, -1, [camera.width, camera.height]))
    usable = np.isfinite(inverse_depth).all(1)
    size = np.where(usable[:, None], np.maximum(high - np.maximum(low, 0), 0), 0).astype(np.int64)
    low = np.maximum(np.nan_to_num(low), 0).astype(np.int64)
    nearest = np.zeros(camera.width * camera.height)
    triangle = np.full(len(nearest), -1, np.int32)
    weights = np.zeros((len(nearest), 3))
    for rows in _chunks(size.prod(1)):
        pixel, face, inside = _covered(rows, size[rows], low[rows], corners, camera)
        closeness = (inside * inverse_depth[face]).sum(1)
        order = np.argsort(closeness, kind="stable")  # of equal pixels, the last assignment counts: the nearest
        order = order[closeness[order] > nearest[pixel[order]]]
        nearest[pixel[order]], triangle[pixel[order]] = closeness[order], face[order]
        weights[pixel[order]] = inside[order]
    shape = camera.height, camera.width
    return triangle.reshape(shape), weights.reshape(*shape, 3)


def silhouette(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) bool: the pixels that a mesh covers; faster than `rasterize`."""
    from PIL import Image, ImageDraw  # Blender lacks it, and needs `rasterize` alone

    pixels, depth = camera.project(vertices)
    pixels -= 0.5  # Pillow's pixel centers lie at whole numbers
    picture = Image.new("1", (camera.width, camera.height))
    draw = ImageDraw.Draw(picture)
    for corners in pixels[faces[(depth > MIN_DEPTH_M)[faces].all(1)]].reshape(-1, 6).tolist():
        draw.polygon(corners, fill=1)
    return np.asarray(picture)


def _chunks(candidates: np.ndarray) -> list[np.ndarray]:
    """Triangles with any candidate pixel, in groups of about CHUNK_PIXELS."""
    rows = np.flatnonzero(candidates)
    groups = np.cumsum(candidates[rows]) // CHUNK_PIXELS
    return [rows[groups == group] for group in np.unique(groups)]


def _covered(
    rows: np.ndarray, size: np.ndarray, low: np.ndarray, corners: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel index, triangle and barycentric coordinates (M, 3) of each pixel center that lies in a triangle."""
    count = size.prod(1)
    face = np.repeat(rows, count)
    place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    width = np.repeat(size[:, 0], count)
    start = np.repeat(low, count, axis=0)
    x, y = start[:, 0] + place % width, start[:, 1] + place // width
    a, b, c = (corners[face, k] for k in range(3))
    center = np.stack([x, y], -1) + 0.5
    area = _cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        second, third = _cross(center - a, c - a) / area, _cross(b - a, center - a) / area
    inside = np.stack([1 - second - third, second, third], -1)
    keep = (inside >= 0).all(1) & (x < camera.width) & (y < camera.height)
    return (y * camera.width + x)[keep], face[keep], inside[keep]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
