"""What an avatar file keeps for relighting: light of the capture, and how the neutral mesh receives light."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import StgaError, shorten

SOURCES = "estimated", "gray_card", "file"
_ARRAYS = {"radiance": (9, 3), "transfer": (-1, 9), "occlusion": (-1,), "irradiance": (-1, 3), "roughness": (-1,)}
"""Field -> shape, -1: vertices."""
_PREFIX = "light_"


@dataclass(frozen=True)
class AvatarLight:
    """Estimated once per run (`light.estimate`), by vertex of the neutral mesh.

    radiance    (9, 3) float32: light of the capture, spherical harmonics of linear radiance (`light.harmonics.basis`)
                in the axes of the capture
    transfer    (V, 9) float32: irradiance is transfer @ radiance; with the head's own shadow (`light.surface`)
    occlusion   (V,) float32, 0…1: cosine-weighted share of the sky that the head leaves open
    irradiance  (V, 3) float32: of the capture, with light that the head reflects onto itself, mean over its timesteps;
                an albedo is π times linear color over this
    roughness   (V,) float32: of highlights; 0: skin, whose roughness the scene's lighting says
    residual    how far recorded colors are from what `radiance` explains, as a share of them (robust deviation)
    damping     0…1 by which albedo is pulled to its mean, because the light is too hard to take away
    source      one of SOURCES: where the light, or its level, is from
    """

    radiance: np.ndarray
    transfer: np.ndarray
    occlusion: np.ndarray
    irradiance: np.ndarray
    roughness: np.ndarray
    residual: float
    damping: float = 0.0
    source: str = SOURCES[0]


def light_arrays(light: AvatarLight) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays for an avatar file, by vertex in half precision (30 bytes a vertex), and the rest for its header."""
    arrays = {f"{_PREFIX}{name}": np.asarray(getattr(light, name), np.float16) for name in _ARRAYS}
    rest = {field.name: getattr(light, field.name) for field in fields(light) if field.name not in _ARRAYS}
    return arrays, rest


def light_from(path: Path, arrays: Mapping[str, np.ndarray], rest: object, vertices: int) -> AvatarLight:
    """The reverse of `light_arrays`. Raises StgaError naming the file and what is wrong."""
    found = {}
    for name, shape in _ARRAYS.items():
        array, expected = arrays.get(_PREFIX + name), tuple(vertices if n < 0 else n for n in shape)
        if array is None or array.dtype != np.float16 or array.shape != expected or not np.isfinite(array).all():
            raise StgaError(f"{path}: {_PREFIX}{name} is missing or damaged, expected float16 {expected}, finite")
        found[name] = array.astype(np.float32)
    if not isinstance(rest, dict) or rest.get("source") not in SOURCES:
        raise StgaError(f"{path}: header field 'light' is {shorten(rest)}, expected residual, damping and source")
    for name in ("residual", "damping"):
        value = rest.get(name)
        if not isinstance(value, (int, float)) or not 0 <= value <= 1e6:
            raise StgaError(f"{path}: header field 'light.{name}' is {shorten(value)}, expected a number from 0 on")
    values: dict[str, Any] = {**found, **{name: rest[name] for name in ("residual", "damping", "source")}}
    return AvatarLight(**values)
