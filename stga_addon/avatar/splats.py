"""The 3D Gaussians themselves, as plain arrays."""

import math
from dataclasses import dataclass, fields, replace

import numpy as np

MAX_SH_DEGREE = 3
SH_C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2·sqrt(π)): what a degree-0 coefficient adds to the color."""


@dataclass(frozen=True)
class Splats:
    """N Gaussians, raw (before activation), float32 unless said.

    xyz        (N, 3) position in the local frame of its face; world meters for a world-space set
    rotation   (N, 4) quaternion wxyz, not necessarily normalized
    log_scale  (N, 3) natural logarithm of the standard deviations
    opacity    (N,) logit
    sh         (N, K, 3) spherical harmonics, K = (degree + 1)²; color = 0.5 + Y·sh, clamped at 0
    face       (N,) int32 triangle that the splat is bound to; 0 for a world-space set
    unbound      (N,) bool: stands for something outside the mesh (hair, shoulders), so limits that tie a splat
               to its triangle do not apply
    strain_color  (N, S, 3) color per unit of its triangle's strain (`avatar.strain`), S = 3, or 0 where colors do
               not depend on deformation; nothing given means 0
    """

    xyz: np.ndarray
    rotation: np.ndarray
    log_scale: np.ndarray
    opacity: np.ndarray
    sh: np.ndarray
    face: np.ndarray
    unbound: np.ndarray
    strain_color: np.ndarray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.strain_color is None:
            object.__setattr__(self, "strain_color", no_strain_color(len(self.xyz)))

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def sh_degree(self) -> int:
        return math.isqrt(self.sh.shape[1]) - 1

    def rows(self, index: np.ndarray) -> "Splats":
        """The splats at `index` (a boolean mask or integer array)."""
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self)})


def no_strain_color(count: int) -> np.ndarray:
    """The `strain_color` of `count` splats whose colors do not depend on deformation."""
    return np.zeros((count, 0, 3), np.float32)
