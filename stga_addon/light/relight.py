"""Colors of an avatar's splats under the light of a scene."""

from collections.abc import Sequence

import numpy as np

from ..avatar.file import Avatar
from .values import Caster, Lighting


class Relighter:
    """An avatar whose file holds its light (`Avatar.light`), ready to be lit by a scene; made once, used every frame.

    What a GPU needs to do the same, all in float32, by splat unless said:

    albedo       (N, 3) linear, of the neutral mesh (without color by strain)
    transfer     (N, 9) as `AvatarLight.transfer`
    occlusion    (N,)
    roughness    (N,) 0: that of the lighting
    normal       (N, 3) the mesh's smooth normal at the splat, in its triangle's frame (`FaceFrames.rotation`)
    """

    def __init__(self, avatar: Avatar) -> None: ...

    def colors(
        self, mesh: np.ndarray, eye: np.ndarray, lighting: Lighting, casters: Sequence[Caster] = ()
    ) -> np.ndarray:
        """(N, 3) float32 sRGB of the splats, not clipped above 1: the `sh` of degree 0 is (color − 0.5) / SH_C0.

        mesh: (V, 3) posed. eye: (3,) position of the camera. All in meters of the avatar's space.
        """
        ...

    def radiance(
        self, mesh: np.ndarray, eye: np.ndarray, lighting: Lighting, casters: Sequence[Caster] = ()
    ) -> np.ndarray:
        """(N, 3) float32: the same before sRGB's curve, for a scene's own color management."""
        ...

    def world_in_head(self, mesh: np.ndarray, world: np.ndarray) -> np.ndarray:
        """(9, 3): the world's harmonics in the axes of the neutral mesh, for a head posed as `mesh` (V, 3): what
        `transfer` is multiplied with."""
        ...
