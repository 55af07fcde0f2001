"""3D Gaussians as plain arrays: shapes, units and activations, which every file format of this
package shares."""

import ast
import inspect
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ..flame.quaternions import normalized, unit

MAX_SH_DEGREE = 3
"""Highest degree of spherical harmonics, as in 3D Gaussian Splatting (Kerbl et al. 2023)."""

SH_C0 = 0.28209479177387814
"""The constant spherical harmonic, 1 / (2·sqrt(π)): a color is 0.5 + SH_C0 times the degree-0
coefficient."""


MAX_LOGIT = 15.0
"""Logit of an opacity of 1 to 3e-7."""
MIN_LOG_SCALE = -20.0
"""Logarithm of a standard deviation of nothing."""


@dataclass(frozen=True)
class Splats:
    """N Gaussians before activation, float32 unless noted.

    xyz        (N, 3) position in the local frame of its triangle (`embedding`); meters in world
               space
    rotation   (N, 4) quaternion (w, x, y, z); activation: normalized
    log_scale  (N, 3) natural logarithm of the standard deviations, in the unit of xyz; activation:
               exp
    opacity    (N,) activation: sigmoid
    sh         (N, K, 3) spherical harmonics with directions in world axes, K = (degree + 1)²;
               activation: color = max(0, 0.5 + Y·sh), sRGB
    face       (N,) int32 index of the triangle that the splat is bound to; 0 in world space
    unbound    (N,) bool: splats of hair and shoulders; they follow their triangle without being
               limited to it
    """

    xyz: np.ndarray
    rotation: np.ndarray
    log_scale: np.ndarray
    opacity: np.ndarray
    sh: np.ndarray
    face: np.ndarray
    unbound: np.ndarray

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def sh_degree(self) -> int:
        return math.isqrt(self.sh.shape[1]) - 1

    def unit_rotations(self) -> np.ndarray:
        """(N, 4) float32 wxyz, normalized."""
        return np.asarray(normalized(self.rotation), np.float32)

    def scales(self) -> np.ndarray:
        """(N, 3) float32: standard deviations, linear."""
        return np.exp(self.log_scale)

    def opacities(self) -> np.ndarray:
        """(N,) float32 in 0 to 1."""
        with np.errstate(over="ignore"):  # of a logit of -1000, which is 0
            return np.asarray(1 / (1 + np.exp(-self.opacity.astype(np.float64))), np.float32)

    def rows(self, index: np.ndarray) -> "Splats":
        """The splats at `index` (a boolean mask or integer array)."""
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self)})


def logits(opacity: np.ndarray) -> np.ndarray:
    """`Splats.opacity`, float32, of opacities 0 to 1: of these two −∞ and ∞."""
    fraction = opacity.astype(np.float64)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(fraction / (1 - fraction)), np.float32)


@dataclass(frozen=True)
class SplatArray:
    """A row of ARRAYS: type of a field of `Splats`, and its shape after N; sizes: those allowed
    where that has −1."""

    dtype: str = "float32"
    shape: tuple[int, ...] = ()
    sizes: tuple[int, ...] = ()


def in_world(
    xyz: np.ndarray,
    rotation: np.ndarray,
    log_scale: np.ndarray,
    opacity: np.ndarray,
    sh: np.ndarray,
    is_free: bool = False,
) -> Splats:
    """World-space splats of values before activation. Infinite opacities and scales of
    minus infinity, as other programs write 0 and 1, get numbers that show no difference."""
    opacity = np.where(np.isinf(opacity), np.copysign(MAX_LOGIT, opacity), opacity)
    log_scale = np.where(np.isneginf(log_scale), MIN_LOG_SCALE, log_scale)
    return Splats(
        xyz=np.asarray(xyz, np.float32),
        rotation=np.asarray(rotation, np.float32),
        log_scale=np.asarray(log_scale, np.float32),
        opacity=np.asarray(opacity, np.float32),
        sh=np.asarray(sh, np.float32),
        face=np.zeros(len(xyz), np.int32),
        unbound=np.full(len(xyz), is_free),
    )


ARRAYS = {
    "xyz": SplatArray(shape=(3,)),
    "rotation": SplatArray(shape=(4,)),
    "log_scale": SplatArray(shape=(3,)),
    "opacity": SplatArray(),
    "sh": SplatArray(shape=(-1, 3), sizes=tuple(n**2 for n in range(1, MAX_SH_DEGREE + 2))),
    "face": SplatArray("int32"),
    "unbound": SplatArray("bool"),
}
"""The fields of `Splats`, by which files and checkpoints are read."""


def at_degree(splats: Splats, degree: int) -> Splats:
    """The splats with harmonics of this degree: higher ones are left out, missing ones 0."""
    sh = np.zeros((len(splats), (degree + 1) ** 2, 3), np.float32)
    kept = min(sh.shape[1], splats.sh.shape[1])
    sh[:, :kept] = splats.sh[:, :kept]
    return replace(splats, sh=sh)


def joined(parts: Sequence[Splats]) -> Splats:
    """All splats of sets with coefficients of the same kinds, in order."""
    names = [field.name for field in fields(Splats)]
    return Splats(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def harmonics(x: Any, y: Any, z: Any) -> tuple[Any, ...]:
    """The 16 real spherical harmonics up to degree 3 of unit directions, in order and with the
    signs of `Splats.sh`.

    Shaders have the same lines, from `harmonics_text`.
    """
    xx = x * x
    yy = y * y
    zz = z * z
    return (
        0.28209479177387814,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2.0 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3.0 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4.0 * zz - xx - yy),
        0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.4570457994644658 * x * (4.0 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3.0 * yy),
    )


def harmonics_text() -> list[str]:
    """What `harmonics` returns as expressions of x, y, z, xx, yy and zz, in GLSL and JavaScript as
    well as Python."""
    nodes = ast.walk(ast.parse(inspect.getsource(harmonics)))
    returned = next(node for node in nodes if isinstance(node, ast.Return))
    assert isinstance(returned.value, ast.Tuple)
    return [ast.unparse(term) for term in returned.value.elts]


def turned_harmonics(sh: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """(N, K, 3) of the same colors where turn (3, 3), a rotation that may mirror, has turned all
    directions."""
    directions = unit(np.random.default_rng(0).normal(size=(64, 3)))
    new, old = (_basis(each, sh.shape[1]) for each in (directions, directions @ turn))
    matrix = np.linalg.lstsq(new, old, rcond=None)[0]
    return np.asarray(np.einsum("kj,njc->nkc", matrix, sh), np.float32)


def _basis(directions: np.ndarray, count: int) -> np.ndarray:
    terms = harmonics(*directions.T)[:count]
    return np.stack([np.broadcast_to(term, len(directions)) for term in terms], 1)


def sh_color(sh: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(N, 3) sRGB, not clipped, of splats' coefficients (N, K, 3) seen in unit directions (N, 3)
    from the eye."""
    terms = enumerate(harmonics(*direction.T)[1 : sh.shape[1]], 1)
    rest = sum(term[:, None] * sh[:, k] for k, term in terms)
    return 0.5 + SH_C0 * sh[:, 0] + rest


def colored_off_axis(
    splats: Splats,
    direction: np.ndarray,
    fraction: np.ndarray,
    color: np.ndarray,
    steepness: np.ndarray | float = 1.0,
) -> Splats:
    """Splats of degree 0 that look as they do along a unit direction (N, 3) from the eye, and the
    more it turns from there, as a color (N, 3), sRGB: by a fraction (N,) of the way times (1 - c)
    (1 + steepness c), where c is the cosine of the angle and steepness (N,); the squared sine where
    that is 1. Of degree 2, which holds just that."""
    directions = unit(np.random.default_rng(0).normal(size=(64, 3)))
    cosine = directions @ direction.T
    way = (1 - cosine) * (1 + steepness * cosine)
    terms = np.linalg.pinv(_basis(directions, 9)) @ way
    change = fraction[:, None] * (color - sh_color(splats.sh, direction))
    sh = at_degree(splats, 2).sh + terms.T[:, :, None] * change[:, None]
    return replace(splats, sh=sh.astype(np.float32))
