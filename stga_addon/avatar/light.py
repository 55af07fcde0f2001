"""What an avatar file keeps for relighting: light of the capture, and how the neutral mesh receives light."""

from dataclasses import dataclass

import numpy as np

SH_COUNT = 9
"""Spherical harmonics of degree 2: all that a diffuse surface shows of distant light, to about 1 %."""


@dataclass(frozen=True)
class AvatarLight:
    """Estimated once per run (`light.estimate`), by vertex of the neutral mesh.

    radiance    (9, 3) float32: light of the capture, spherical harmonics of linear radiance (`light.harmonics.basis`)
                in the axes of the neutral mesh
    transfer    (V, 9) float32: irradiance is transfer @ radiance; with the head's own shadow (`light.transfer`)
    occlusion   (V,) float32, 0…1: cosine-weighted share of the sky that the head does not cover
    irradiance  (V, 3) float32: of the capture, with light that the head reflects onto itself, mean over its timesteps;
                an albedo is π times linear color over this
    roughness   (V,) float32: of highlights; 0: skin, whose roughness the scene's lighting says
    residual    share of the observed irradiance that `radiance` does not explain (robust, 0…1)
    hardness    share of the light's energy that is in degree 2 or of one direction: high for a lamp, low for soft light
    source      "estimated", "gray_card" or "file": where the light's level or the light are from
    damping     0…1 by which albedo was pulled to its mean, because the light is too hard to take away
    """

    radiance: np.ndarray
    transfer: np.ndarray
    occlusion: np.ndarray
    irradiance: np.ndarray
    roughness: np.ndarray
    residual: float
    hardness: float
    source: str
    damping: float = 0.0
