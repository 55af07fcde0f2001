"""What lights add to surface points, and the shadow maps that say where. Vectors are rows of their
own, (3, N): NumPy is slow where the last axis is short."""

from typing import NamedTuple

import numpy as np

CHUNK_TEXELS = 1 << 17
"""Texels in the boxes around triangles that are drawn at a time, to bound the memory."""
CHUNK_POINTS = 1 << 13
"""Points that are computed at a time, whose arrays stay in the processor's cache."""
MIN_FACING = np.float32(0.05)
"""Least cosine between a highlight's normal and the direction to the eye; smaller ones are
raised."""
SUN = 0
"""Number of a sun in `values.KINDS`."""
SPOT = 2
"""Number of a spot in `values.KINDS`."""
AREA = 3
"""Number of an area light in `values.KINDS`."""

# Columns of a table of lights (L, 16) float32.
KIND = 0
"""Number in `values.KINDS`."""
POSITION = slice(1, 4)
"""Position in meters."""
DIRECTION = slice(4, 7)
"""Direction in which the light shines."""
COLOR = slice(7, 10)
"""Color: irradiance of a sun, else intensity in W/sr towards what faces the light."""
CONE = 10
"""Cosine of half a spot's cone."""
FADE = 11
"""How far above CONE the cosine has risen where a spot no longer fades."""
MAP = 12
"""Row of the table of visibility; -1: the light is visible from every point."""
DIFFUSE = 13
"""Factor of diffuse light."""
SPECULAR = 14
"""Factor of specular light."""
WIDTH = 15
"""Tangent of half the angle that a sun takes, else half the light's width in meters."""


class Surface(NamedTuple):
    """Points (N, 3) float32 of a surface, their unit normals (N, 3) float32, and roughness (N,)."""

    points: np.ndarray
    normals: np.ndarray
    roughness: np.ndarray


def add_depths(points: np.ndarray, faces: np.ndarray, depth: np.ndarray) -> None:
    """As `raster.cpu.shadow.add_depths`, for Pythons without Numba."""
    size = len(depth)
    corners = np.stack([points[faces[:, k]].T for k in range(3)]).astype(np.float64)
    low = np.clip(corners.min(0)[:2], 0, size)
    high = np.clip(corners.max(0)[:2], 0, size)
    area = _crossed(corners[1] - corners[0], corners[2] - corners[0], 0, 1)
    drawn = np.isfinite(corners).all((0, 1)) & (np.abs(area) > 1e-12)
    drawn &= (low < size).all(0) & (high > 0).all(0)
    order = np.flatnonzero(drawn)
    # From far to near, so that the nearest are mostly written last.
    order = order[np.argsort(-corners[:, 2, order].sum(0))]
    boxes = np.cumsum((np.ceil(high - low) + 1)[:, order].prod(0))
    for group in np.split(order, np.flatnonzero(np.diff(boxes // CHUNK_TEXELS)) + 1):
        _add_group(corners[:, :, group], area[group], depth)


def _add_group(corners: np.ndarray, area: np.ndarray, depth: np.ndarray) -> None:
    """Draw triangles (3 corners, 3, F) row by row, from texel to texel."""
    size = len(depth)
    u = corners[1] - corners[0]
    v = corners[2] - corners[0]
    across = _crossed(u, v, 2, 1) / area
    down = _crossed(u, v, 0, 2) / area
    plane = across, down, corners[0, 2] - across * corners[0, 0] - down * corners[0, 1]
    order = np.argsort(corners[:, 1], axis=0)[:, None]
    high, middle, low = np.take_along_axis(corners, order, axis=0)
    rows = np.ceil(high[1] - 0.5) - 1, np.floor(middle[1] - 0.5), np.floor(low[1] - 0.5)
    limits = [np.clip(row, -1, size - 1).astype(np.int64) for row in rows]
    long = _line(high, low)
    lines = _line(high, middle), _line(middle, low)
    for before, last, short in zip(limits, limits[1:], lines, strict=False):
        count = last - before
        row = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count - before - 1, count)
        y = row + 0.5
        edges = [np.repeat(slope, count) * y + np.repeat(b, count) for slope, b in (long, short)]
        begin = np.ceil(np.maximum(np.minimum(*edges), 0) - 0.5).clip(0)
        end = np.floor(np.minimum(np.maximum(*edges), size) - 0.5)
        texels = np.maximum(end - begin + 1, 0).astype(np.int64)
        steepness, down, z = (np.repeat(values, count) for values in plane)
        z += steepness * (begin + 0.5) + down * y
        along = np.arange(int(texels.sum())) - np.repeat(np.cumsum(texels) - texels, texels)
        at = np.repeat(row * size + begin.astype(np.int64), texels) + along
        z, steepness = (np.repeat(values.astype(np.float32), texels) for values in (z, steepness))
        z = z + steepness * along.astype(np.float32)
        flat = depth.reshape(-1)
        # As `np.minimum.at`, slow in older NumPy: what is less after writing is written again.
        while len(at):
            less = z < flat[at]
            at = at[less]
            z = z[less]
            flat[at] = z


def _crossed(u: np.ndarray, v: np.ndarray, i: int, j: int) -> np.ndarray:
    return u[i] * v[j] - u[j] * v[i]


def _line(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slope and begin of the lines through a and b (3, F): x = slope · y + begin."""
    height = b[1] - a[1]
    slope = (b[0] - a[0]) / np.where(height == 0, 1, height)
    return slope, a[0] - slope * a[1]


def lit_fractions(
    depth: np.ndarray, points: np.ndarray, bias: np.ndarray, reach: int
) -> np.ndarray:
    """(N,) float32: fraction 0…1 of the depth map's texels around each point that do not block it.

    points (N, 3) as in `add_depths`. bias (N,): depth by which a texel must be nearer to block.
    reach: texels between the 3 × 3 places that are looked up bilinearly around a point; 0: one
    place.
    """
    size = len(depth)
    lit = np.empty(len(points), np.float32)
    border = 2 * reach + 3
    # The map with a border that blocks nothing; farther places are moved onto it.
    padded = np.full((size + 2 * border,) * 2, np.inf, np.float32)
    padded[border:-border, border:-border] = depth
    flat = padded.reshape(-1)
    width = len(padded)
    taps = (-reach, 0, reach) if reach else (0,)
    for start in range(0, len(points), CHUNK_POINTS):
        part = slice(start, start + CHUNK_POINTS)
        x, y = (
            np.clip(points[part, k] - np.float32(0.5), -1.5 - reach, size + reach + 0.5) + border
            for k in range(2)
        )
        z = points[part, 2] - bias[part]
        left = np.floor(x)
        top = np.floor(y)
        at = top.astype(np.int64) * width + left.astype(np.int64)
        found = np.zeros(len(z), np.float32)
        columns = _texel_weights(taps, x - left)
        for row, weight in _texel_weights(taps, y - top).items():
            open_ = np.zeros(len(z), np.float32)
            for column, fraction in columns.items():
                open_ += np.where(z <= flat.take(at + (row * width + column)), fraction, 0)
            found += weight * open_
        lit[part] = found / np.float32(len(taps) ** 2)
    return lit


def _texel_weights(taps: tuple[int, ...], fraction: np.ndarray) -> dict[int, np.ndarray]:
    """Texel along an axis -> its weights in linear lookups at whole-numbered taps, moved by the
    fraction (N,) of a texel."""
    weights: dict[int, np.ndarray] = {}
    for tap in taps:
        weights[tap] = weights.get(tap, np.float32(0)) + (1 - fraction)
        weights[tap + 1] = weights.get(tap + 1, np.float32(0)) + fraction
    return weights


def shaded(
    surface: Surface, eye: np.ndarray, reflectance: float, lights: np.ndarray, lit: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Irradiance and highlight (N, 3) float32 that a table of lights adds, seen from eye (3,).

    lit: rows (N,) of what shadows leave of lights. A highlight is a GGX lobe with Smith's shadowing
    and Schlick's Fresnel term of the given reflectance, as wide as the light makes it; none where
    the roughness is 0.
    """
    points, normals, roughness = surface
    irradiance, highlight = np.zeros((2, len(points), 3), np.float32)
    ahead = np.float32(reflectance)
    for start in range(0, len(points), CHUNK_POINTS):
        part = slice(start, start + CHUNK_POINTS)
        place, normal = (np.ascontiguousarray(rows[part].T) for rows in (points, normals))
        view = eye[:, None] - place
        view *= 1 / np.sqrt(np.maximum(_dot(view, view), np.float32(1e-20)))
        toward_eye = np.maximum(_dot(normal, view), MIN_FACING)
        alpha = roughness[part] ** 2
        arriving = np.zeros_like(view)
        reflected = np.zeros_like(view)
        for light in lights:
            toward, strength, width = toward_light(light, place)
            facing = np.maximum(_dot(normal, toward), 0)
            strength = strength * facing
            if light[MAP] >= 0:
                strength *= lit[int(light[MAP]), part]
            if not strength.any():
                continue
            arriving += (light[DIFFUSE] * light[COLOR])[:, None] * strength
            if light[SPECULAR] <= 0:
                continue
            half = toward + view
            half *= 1 / np.sqrt(np.maximum(_dot(half, half), np.float32(1e-12)))
            square = np.minimum(alpha * alpha + width * width / 8, 1)
            half_cosine = np.clip(_dot(normal, half), 0, 1)
            spread = half_cosine * half_cosine * (square - 1) + 1
            shadowing = facing * np.sqrt(toward_eye * toward_eye * (1 - square) + square)
            shadowing += toward_eye * np.sqrt(facing * facing * (1 - square) + square)
            fade = 1 - np.clip(_dot(view, half), 0, 1)
            fade_square = fade * fade
            fresnel = ahead + (1 - ahead) * fade_square * fade_square * fade
            least = np.float32(1e-12)
            gloss = square * fresnel / np.maximum(2 * np.pi * spread * spread * shadowing, least)
            strength *= np.where(alpha > 0, gloss, 0)
            reflected += (light[SPECULAR] * light[COLOR])[:, None] * strength
        irradiance[part] = arriving.T
        highlight[part] = reflected.T
    return irradiance, highlight


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N,) of vectors (3, N)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def toward_light(
    light: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors (3, N) to a light's row, factors (N,) of its color, and its width (N,)."""
    if light[KIND] == SUN:
        ones = np.ones(points.shape[1], np.float32)
        return np.broadcast_to(-light[DIRECTION, None], points.shape), ones, light[WIDTH] * ones
    toward = light[POSITION, None] - points
    square = np.maximum(_dot(toward, toward), np.float32(1e-8))
    away = 1 / np.sqrt(square)
    toward *= away
    strength = 1 / square
    along = -_dot(toward, light[DIRECTION])
    if light[KIND] == AREA:
        strength = strength * np.maximum(along, 0)
    elif light[KIND] == SPOT:
        inside = np.clip((along - light[CONE]) / light[FADE], 0, 1)
        strength = strength * inside * inside * (3 - 2 * inside)
    return toward, strength, light[WIDTH] * away
