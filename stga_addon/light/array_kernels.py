"""The kernels of `raster.cpu.shade` and `raster.cpu.shadow` in NumPy, for Pythons without Numba such as Blender's."""

import numpy as np

CHUNK_TEXELS = 1 << 20
"""Candidate texels that are tested at a time, to bound the memory."""
SUN, SPOT, AREA = 0, 2, 3
MIN_FACING = 0.05


def add_depths(points: np.ndarray, faces: np.ndarray, depth: np.ndarray) -> None:
    """As `raster.cpu.shadow.add_depths`."""
    size = len(depth)
    corners = points[faces].astype(np.float64)
    corners = corners[np.isfinite(corners).all((1, 2))]
    low = np.ceil(np.clip(corners[:, :, :2].min(1), 0, size) - 0.5).astype(np.int64).clip(0)
    high = np.floor(np.clip(corners[:, :, :2].max(1), -1, size) - 0.5).astype(np.int64).clip(-1, size - 1)
    shape = np.maximum(high - low + 1, 0)
    rows = np.flatnonzero(shape.prod(1))
    groups = np.cumsum(shape[rows].prod(1)) // CHUNK_TEXELS
    flat = depth.reshape(-1)
    for group in np.unique(groups):
        _add_group(corners[rows[groups == group]], low[rows[groups == group]], shape[rows[groups == group]], flat, size)


def _add_group(corners: np.ndarray, low: np.ndarray, shape: np.ndarray, flat: np.ndarray, size: int) -> None:
    count = shape.prod(1)
    face = np.repeat(np.arange(len(count)), count)
    place = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    x, y = low[face, 0] + place % shape[face, 0], low[face, 1] + place // shape[face, 0]
    a, b, c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]
    inverse = np.where(np.abs(area) > 1e-12, 1 / np.where(area == 0, 1, area), np.nan)
    dx, dy = x + 0.5 - a[face, 0], y + 0.5 - a[face, 1]
    u = (dx * c[face, 1] - dy * c[face, 0]) * inverse[face]
    v = (dy * b[face, 0] - dx * b[face, 1]) * inverse[face]
    inside = (u >= 0) & (v >= 0) & (u + v <= 1)
    face, u, v = face[inside], u[inside], v[inside]
    z = (a[face, 2] + u * b[face, 2] + v * c[face, 2]).astype(np.float32)
    np.minimum.at(flat, y[inside] * size + x[inside], z)


def lit_shares(depth: np.ndarray, points: np.ndarray, bias: np.ndarray, step: float, lit: np.ndarray) -> None:
    """As `raster.cpu.shadow.lit_shares`."""
    size, reach = len(depth), 1 if step > 0 else 0
    # The map with a border that blocks nothing; farther places are moved onto it.
    padded = np.full((size + 4, size + 4), np.inf, np.float32)
    padded[2:-2, 2:-2] = depth
    flat, width = padded.reshape(-1), size + 4
    z, lit[:] = points[:, 2] - bias, 0
    for across in range(-reach, reach + 1):
        for down in range(-reach, reach + 1):
            x = np.clip(points[:, 0] - np.float32(0.5) + np.float32(across * step), -1.5, size + 0.5)
            y = np.clip(points[:, 1] - np.float32(0.5) + np.float32(down * step), -1.5, size + 0.5)
            left, top = np.floor(x), np.floor(y)
            right_share, lower_share = x - left, y - top
            at = (top.astype(np.int32) + 2) * width + left.astype(np.int32) + 2
            for offset, weight in (
                (0, (1 - right_share) * (1 - lower_share)), (1, right_share * (1 - lower_share)),
                (width, (1 - right_share) * lower_share), (width + 1, right_share * lower_share),
            ):  # fmt: skip
                lit += np.where(z <= flat[at + offset], weight, np.float32(0))
    lit /= np.float32((2 * reach + 1) ** 2)


def add_lights(
    points: np.ndarray, normals: np.ndarray, eye: np.ndarray, roughness: np.ndarray, reflectance: np.ndarray,
    lights: np.ndarray, lit: np.ndarray, irradiance: np.ndarray, highlight: np.ndarray,
) -> None:  # fmt: skip
    """As `raster.cpu.shade.add_lights`."""
    view = eye - points
    view = view / np.sqrt(np.maximum((view * view).sum(1), np.float32(1e-20)))[:, None]
    toward_eye = np.maximum((normals * view).sum(1), np.float32(MIN_FACING))
    alpha = roughness * roughness
    for light in lights:
        toward, strength, width = _toward(light, points)
        facing = np.maximum((normals * toward).sum(1), 0)
        if light[12] >= 0:
            strength = strength * lit[int(light[12])]
        arriving = (strength * facing)[:, None] * light[7:10]
        irradiance += arriving * light[13]
        if light[14] > 0 and alpha.any():
            half = toward + view
            half = half / np.sqrt(np.maximum((half * half).sum(1), np.float32(1e-12)))[:, None]
            gloss = _ggx(
                facing, toward_eye, np.clip((normals * half).sum(1), 0, 1), np.clip((view * half).sum(1), 0, 1),
                alpha, width, reflectance,
            )  # fmt: skip
            highlight += arriving * (gloss * light[14])[:, None]


def _toward(light: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors (N, 3) to a light (a row of `raster.cpu.shade`), factors (N,) of its color, and its width (N,)."""
    if light[0] == SUN:
        ones = np.ones(len(points), np.float32)
        return np.broadcast_to(-light[4:7], points.shape), ones, light[15] * ones
    toward = light[1:4] - points
    square = np.maximum((toward * toward).sum(1), np.float32(1e-8))
    away = 1 / np.sqrt(square)
    toward *= away[:, None]
    strength, along = 1 / square, -(toward @ light[4:7])
    if light[0] == AREA:
        strength = strength * np.maximum(along, 0)
    elif light[0] == SPOT:
        inside = np.clip((along - light[10]) / light[11], 0, 1)
        strength = strength * inside * inside * (3 - 2 * inside)
    return toward, strength, light[15] * away


def _ggx(
    facing: np.ndarray, toward_eye: np.ndarray, half: np.ndarray, fresnel_cosine: np.ndarray, alpha: np.ndarray,
    width: np.ndarray, reflectance: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """As `raster.cpu.shade.ggx`, widened by the light's width."""
    square = np.minimum(alpha * alpha + np.float32(0.125) * width * width, 1)
    spread = half * half * (square - 1) + 1
    distribution = square / np.maximum(np.pi * spread * spread, 1e-12)
    shadowing = facing * np.sqrt(toward_eye * toward_eye * (1 - square) + square)
    shadowing += toward_eye * np.sqrt(facing * facing * (1 - square) + square)
    fresnel = reflectance + (1 - reflectance) * (1 - fresnel_cosine) ** 5
    found = distribution * fresnel / (2 * np.maximum(shadowing, 1e-12))
    return np.asarray(np.where((facing > 0) & (alpha > 0), found, 0), np.float32)
