"""Real spherical harmonics up to degree 3, and their gradient."""

import numpy as np

from . import inline_jit

TWO, THREE, FOUR, SIX, EIGHT = (np.float32(n) for n in (2, 3, 4, 6, 8))
# The normalization constants, in order of first use.
C0, C1, C2, C3, C4, C5, C6, C7, C8, C9 = (np.float32(c) for c in (
    0.28209479177387814, 0.4886025119029199, 1.0925484305920792, 0.31539156525252005,
    0.5462742152960396, 0.5900435899266435, 2.890611442640554, 0.4570457994644658,
    0.3731763325901154, 1.445305721320277,
))  # fmt: skip


@inline_jit
def basis(x, y, z):
    """The 16 harmonics of the unit direction (x, y, z)."""
    xx, yy, zz = x * x, y * y, z * z
    return (
        C0, -C1 * y, C1 * z, -C1 * x,
        C2 * x * y, -C2 * y * z, C3 * (TWO * zz - xx - yy), -C2 * x * z, C4 * (xx - yy),
        -C5 * y * (THREE * xx - yy), C6 * x * y * z, -C7 * y * (FOUR * zz - xx - yy),
        C8 * z * (TWO * zz - THREE * xx - THREE * yy), -C7 * x * (FOUR * zz - xx - yy),
        C9 * z * (xx - yy), -C5 * x * (xx - THREE * yy),
    )  # fmt: skip


@inline_jit
def basis_gradient(x, y, z, w1, w2, w3, w4, w5, w6, w7, w8, w9, w10, w11, w12, w13, w14, w15):
    """Gradient with respect to (x, y, z) of the sum of the harmonics 1 to 15 with these weights."""
    xx, yy, zz = x * x, y * y, z * z
    gx = -C1 * w3 + C2 * (y * w4 - z * w7) - TWO * C3 * x * w6 + TWO * C4 * x * w8
    gx += -C5 * SIX * x * y * w9 + C6 * y * z * w10 + C7 * TWO * x * y * w11
    gx += -C8 * SIX * x * z * w12 - C7 * (FOUR * zz - THREE * xx - yy) * w13
    gx += C9 * TWO * x * z * w14 - C5 * THREE * (xx - yy) * w15
    gy = -C1 * w1 + C2 * (x * w4 - z * w5) - TWO * C3 * y * w6 - TWO * C4 * y * w8
    gy += -C5 * THREE * (xx - yy) * w9 + C6 * x * z * w10
    gy += -C7 * (FOUR * zz - xx - THREE * yy) * w11 - C8 * SIX * y * z * w12
    gy += C7 * TWO * x * y * w13 - C9 * TWO * y * z * w14 + C5 * SIX * x * y * w15
    gz = C1 * w2 - C2 * (y * w5 + x * w7) + FOUR * C3 * z * w6 + C6 * x * y * w10
    gz += -C7 * EIGHT * y * z * w11 + C8 * (SIX * zz - THREE * xx - THREE * yy) * w12
    gz += -C7 * EIGHT * x * z * w13 + C9 * (xx - yy) * w14
    return gx, gy, gz
