"""Rotations as unit quaternions (w, x, y, z), and their interpolation."""

import numpy as np


def from_axis_angle(vectors: np.ndarray) -> np.ndarray:
    """(..., 4) of axis-angle vectors (..., 3) in radians."""
    half = np.linalg.norm(vectors, axis=-1, keepdims=True) / 2
    return np.concatenate([np.cos(half), vectors * np.sinc(half / np.pi) / 2], axis=-1)


def to_matrices(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) of any length; of zero ones, the identity."""
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
    return np.asarray(2 * quaternions[..., 1:] / np.sinc(half / np.pi))  # length / half, finite at zero


def continuous(quaternions: np.ndarray) -> np.ndarray:
    """(T, 4) with signs changed so that consecutive quaternions are close; q and -q are the same rotation."""
    flips = np.sign((quaternions[1:] * quaternions[:-1]).sum(1))
    signs = np.cumprod(np.where(flips < 0, -1.0, 1.0))
    return np.concatenate([quaternions[:1], quaternions[1:] * signs[:, None]])


def slerp(first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(..., 4) on the shortest arc from `first` (share 0) to `second` (share 1), and beyond; share (...,).

    Spherical linear interpolation (Shoemake 1985).
    """
    cosine = (first * second).sum(-1, keepdims=True)
    second, cosine = np.where(cosine < 0, -second, second), np.abs(cosine)
    angle = np.arctan2(np.linalg.norm(second - cosine * first, axis=-1, keepdims=True), cosine)
    share = np.asarray(share)[..., None]
    # Ratios of sines as sinc, which is finite where the rotations are equal.
    whole = np.sinc(angle / np.pi)
    near, far = ((s * np.sinc(s * angle / np.pi)) / whole for s in (1 - share, share))
    return np.asarray(near * first + far * second)
