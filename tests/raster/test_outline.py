"""Which rows of a tile a splat reaches, against every pixel of it in float64."""

import numpy as np
import pytest

from stga_addon.raster.cpu.outline import outline, rows_within


def covariances(
    rng: np.random.Generator, count: int, longest: float, shortest: float, thin: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Axes (count, 2) in pixels between two lengths, and xx, xy, yy (count,) of ellipses turned at
    random.

    thin: the second axis is the shortest.
    """
    turn = rng.uniform(0, np.pi, count)
    axes = np.stack(
        [np.stack([np.cos(turn), np.sin(turn)], -1), np.stack([-np.sin(turn), np.cos(turn)], -1)], 1
    )
    sigma = np.exp(rng.uniform(np.log(shortest), np.log(longest), (count, 2)))
    if thin:
        sigma[:, 1] = shortest
    covariance = np.einsum("nki,nk,nkj->nij", axes, sigma**2, axes)
    return sigma, covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]


def splats(kind: str, count: int = 400) -> np.ndarray:
    """(count, 6) float32 mean_x, mean_y, precision_x, shear, precision_y, extent_y around a tile of
    16 × 16 pixels."""
    rng = np.random.default_rng(0)
    longest, shortest = {
        "round": (6, 2),
        "needles": (40, 0.6),
        "tiny": (0.7, 0.55),
        "huge": (3000, 200),
    }[kind]
    sigma, xx, xy, yy = covariances(rng, count, longest, shortest, kind == "needles")
    reach = 2 * np.log(255 * rng.uniform(0.005, 1, count))
    mean = rng.uniform(-8, 24, (count, 2)) + rng.normal(size=(count, 2)) * 2 * sigma.max(
        1, keepdims=True
    )
    columns = mean[:, 0], mean[:, 1], yy / (xx * yy - xy**2), xy / yy, 1 / yy, np.sqrt(reach * yy)
    return np.stack(columns, -1).astype(np.float32)


def reached(splat: np.ndarray, left: int, width: int, rows: int, spare: float = 0.0) -> np.ndarray:
    """(rows,) bool: whether a pixel of the row has its center inside the outline, made larger by a
    share `spare`."""
    mean_x, mean_y, precision_x, shear, precision_y, extent_y = splat.astype(np.float64)
    dy = np.arange(rows)[:, None] + 0.5 - mean_y
    dx = left + np.arange(width) + 0.5 - mean_x - shear * dy
    inside = precision_x * dx**2 + precision_y * dy**2 <= precision_y * extent_y**2 * (1 + spare)
    return np.asarray(inside.any(axis=1))


@pytest.mark.parametrize("kind", ["round", "needles", "tiny", "huge"])
@pytest.mark.parametrize(("left", "width"), [(0, 8), (8, 8), (0, 16), (3, 1)])
def test_no_pixel_is_lost_and_few_rows_are_idle(kind: str, left: int, width: int):
    """Catches rows left out of a splat that is cut by the edge of a tile, and rows computed for
    nothing."""
    found = idle = 0
    for splat in splats(kind):
        first, past = rows_within(
            outline(*splat), np.float32(left), np.float32(width), np.float32(16)
        )
        covered = (np.arange(16) >= first) & (np.arange(16) < past)
        rows = reached(splat, left, width, 16, spare=-1e-5)
        assert not (rows & ~covered).any(), (splat, first, past)
        found += int(rows.sum())
        # Between pixels no center is reached, so that a row or two may be idle where a needle
        # passes.
        idle += int((covered & ~reached(splat, left, width, 16, spare=0.02)).sum())
    assert found > 0
    assert idle <= (0.6 if kind == "needles" or width == 1 else 0.1) * found + 20, (idle, found)


def test_what_lies_beside_reaches_no_row():
    """Catches splats that are computed in tiles which only their bounding box touches."""
    # along x = y, where |x − y| ≤ 2.2 and |y| ≤ 50
    diagonal = np.float32([0, 0, 25 / 2.2**2, 1, 0.01, 50])
    first, past = rows_within(outline(*diagonal), np.float32(12), np.float32(4), np.float32(4))
    assert first >= past
    first, past = rows_within(outline(*diagonal), np.float32(0), np.float32(4), np.float32(16))
    assert (first, past) == (0, 6)  # centers of columns up to 3.5, of rows up to 5.5
