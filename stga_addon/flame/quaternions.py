"""Vectors of length 1, and rotations as unit quaternions (w, x, y, z): conversions and products."""

import numpy as np


def unit(vectors: np.ndarray, least: float = 1e-9) -> np.ndarray:
    """(..., N) of length 1; shorter ones than `least` stay near 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.maximum(length, least)


def from_axis_angle(vectors: np.ndarray) -> np.ndarray:
    """(..., 4) of axis-angle vectors (..., 3) in radians."""
    half = np.linalg.norm(vectors, axis=-1, keepdims=True) / 2
    return np.concatenate([np.cos(half), vectors * np.sinc(half / np.pi) / 2], axis=-1)


def to_matrices(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) of any length; zero: the identity."""
    length = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(quaternions / np.maximum(length, 1e-12), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def to_axis_angle(quaternions: np.ndarray) -> np.ndarray:
    """(..., 3) radians of unit quaternions (..., 4); angles up to pi."""
    quaternions = np.where(quaternions[..., :1] < 0, -quaternions, quaternions)
    length = np.linalg.norm(quaternions[..., 1:], axis=-1, keepdims=True)
    half = np.arctan2(length, quaternions[..., :1])
    # length / half, finite at zero
    return 2 * quaternions[..., 1:] / np.sinc(half / np.pi)


def continuous(quaternions: np.ndarray) -> np.ndarray:
    """(T, 4) with signs changed so that consecutive ones are close; q and -q are one rotation."""
    flips = np.sign((quaternions[1:] * quaternions[:-1]).sum(1))
    signs = np.cumprod(np.where(flips < 0, -1.0, 1.0))
    return np.concatenate([quaternions[:1], quaternions[1:] * signs[:, None]])


def normalized(q: np.ndarray) -> np.ndarray:
    """(..., 4) normalized in float64; a zero quaternion counts as the identity."""
    q = np.asarray(q, np.float64)
    largest = np.max(np.abs(q), axis=-1, keepdims=True)
    scaled = q / np.where(largest > 0, largest, 1.0)
    q = np.where(largest > 0, scaled, np.array([1.0, 0.0, 0.0, 0.0]))
    return unit(q)


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product of wxyz quaternions (..., 4): rotate by b, then by a."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    product = (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
    return np.stack(product, axis=-1)


def from_matrices(matrices: np.ndarray) -> np.ndarray:
    """Unit quaternion wxyz (..., 4), w ≥ 0, of proper rotation matrices (..., 3, 3). Builds the
    outer product 4·qqᵀ from the matrix and takes its best-conditioned row, so rotations by 180°
    (trace −1) lose no precision."""
    m = np.asarray(matrices, np.float64)
    xx = m[..., 0, 0]
    yy = m[..., 1, 1]
    zz = m[..., 2, 2]
    outer = np.empty((*m.shape[:-2], 4, 4))
    for axis, (x, y, z) in enumerate(((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))):
        outer[..., axis, axis] = 1 + x * xx + y * yy + z * zz
    outer[..., 0, 1] = outer[..., 1, 0] = m[..., 2, 1] - m[..., 1, 2]
    outer[..., 0, 2] = outer[..., 2, 0] = m[..., 0, 2] - m[..., 2, 0]
    outer[..., 0, 3] = outer[..., 3, 0] = m[..., 1, 0] - m[..., 0, 1]
    outer[..., 1, 2] = outer[..., 2, 1] = m[..., 0, 1] + m[..., 1, 0]
    outer[..., 1, 3] = outer[..., 3, 1] = m[..., 0, 2] + m[..., 2, 0]
    outer[..., 2, 3] = outer[..., 3, 2] = m[..., 1, 2] + m[..., 2, 1]
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    row = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    row = np.where(row[..., :1] < 0, -row, row)
    return unit(row)
