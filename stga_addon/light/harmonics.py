"""Spherical harmonics of degree 2, in which distant light is kept."""

import numpy as np

from ..avatar.splats import SH_C0, harmonics

COUNT = 9
"""Number of harmonics up to degree 2."""

DARK = 1e-5
"""Radiance up to which there is no light."""
LAMBERT = np.array([np.pi] + [2 * np.pi / 3] * 3 + [np.pi / 4] * 5)
"""Irradiance of an unoccluded surface: Σ LAMBERT · basis(normal) · radiance (Ramamoorthi 2001)."""
GLOSSY = np.array([1.0] + [0.85] * 3 + [0.62] * 5)
"""The same for the mean radiance in a lobe of SKIN_ROUGHNESS around a direction."""


def basis(directions: np.ndarray) -> np.ndarray:
    """(N, 9) of unit vectors (N, 3): 1, y, z, x, xy, yz, 3z² − 1, xz, x² − y², orthonormal."""
    x, y, z = np.asarray(directions).T
    constant, *rest = harmonics(-x, -y, z)[:COUNT]
    return np.stack([np.full_like(x, constant), *rest], axis=-1)


def even_directions(count: int) -> np.ndarray:
    """(count, 3) unit vectors spread evenly over the sphere (a Fibonacci lattice)."""
    place = np.arange(count) + 0.5
    height = 1 - 2 * place / count
    turn = place * np.pi * (1 + 5**0.5)
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(turn), height, ring * np.sin(turn)], axis=-1)


_SAMPLES = even_directions(64)


def rotated(coefficients: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """(9, C) of the same light in other axes: rotation (3, 3) takes old coordinates to new ones."""
    values = basis(_SAMPLES @ rotation) @ coefficients  # at new direction d the old one is Rᵀ d
    return np.linalg.lstsq(basis(_SAMPLES), values, rcond=None)[0]


def uniform(radiance: object) -> np.ndarray:
    """(9, 3) of the same radiance (3,) from everywhere."""
    found = np.zeros((COUNT, 3))
    found[0] = np.asarray(radiance, np.float64) / SH_C0
    return found


def least_squares(rows: np.ndarray, values: np.ndarray, ridge: float) -> np.ndarray:
    """(9,) light with which rows (M, 9) come nearest to values (M,), drawn to 0 by `ridge`, a
    fraction of the mean of the normal equations' diagonal: some harmonics may give no light."""
    matrix = rows.T @ rows
    matrix[np.diag_indices(COUNT)] += ridge * np.trace(matrix) / COUNT + DARK**2
    return np.linalg.solve(matrix, rows.T @ values)
