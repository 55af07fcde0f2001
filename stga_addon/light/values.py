"""Lights and lighting as plain values, in Blender's units, in the space of the avatar's meshes
(meters of its capture, or of the head object in Blender); colors are linear, sRGB's primaries.

A sun's color is irradiance in W/m² on a surface that faces it; that of others is power in W, of
which a surface that faces a point at distance d gets power / (4 π d²), and one that faces the
middle of a small area light power / (π d²): Blender's strength times its color. The world's is
radiance in W/m²/sr: 1 from everywhere is irradiance π. A surface of albedo ρ under irradiance E has
radiance ρ E / π, which is the display's white (sRGB 1) where it is 1.
"""

from dataclasses import dataclass, field, replace

import numpy as np

KINDS = "sun", "point", "spot", "area"
"""Kinds of lights."""
SHAPES = "rectangle", "ellipse"
"""Shapes of area lights."""
SKIN_ROUGHNESS = 0.45
"""Roughness of the highlight on skin (GGX, Blender's Principled BSDF)."""
HAIR_ROUGHNESS = 1.0
"""Roughness of hair, which does not shine as skin does: a lamp behind would whiten it."""


def is_wet(roughness: np.ndarray) -> np.ndarray:
    """(N,) bool: where roughness (N,) of `AvatarLight` is that of eyes, not of skin (0) or hair."""
    return np.asarray((roughness > 0) & (roughness < HAIR_ROUGHNESS / 2))


@dataclass(frozen=True)
class Light:
    """One light of a scene.

    kind       one of KINDS
    color      (3,) linear red, green, blue: irradiance in W/m² of a sun, else power in W
    position   (3,) meters; of a sun it counts for nothing
    direction  (3,) in which it shines: a sun's rays, a spot's axis, an area light's normal
    radius     meters, of a point or spot: how soft its shadows are
    angle      radians, of a sun: the angle that it takes in the sky
    size       (width, height) meters of an area light
    tangent    (3,) along the width of an area light
    shape      one of SHAPES: an ellipse fills the rectangle of `size`
    cone       radians, of a spot: full angle, as Blender's `spot_size`
    blend      0…1, of a spot: fraction of the cone that fades out, as Blender's `spot_blend`
    casts_shadow  whether it is blocked by head and casters
    diffuse, specular  factors of what it adds to diffuse color and to highlights, as Blender's
    """

    kind: str
    color: np.ndarray
    position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    direction: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))
    radius: float = 0.0
    angle: float = 0.0
    size: tuple[float, float] = (0.0, 0.0)
    tangent: np.ndarray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    shape: str = "rectangle"
    cone: float = np.pi / 4
    blend: float = 0.15
    casts_shadow: bool = True
    diffuse: float = 1.0
    specular: float = 1.0

    def __post_init__(self) -> None:
        """Vectors become float64 arrays, directions unit vectors."""
        for name in ("color", "position"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), np.float64))
        for name in ("direction", "tangent"):
            array = np.asarray(getattr(self, name), np.float64)
            object.__setattr__(self, name, array / max(float(np.linalg.norm(array)), 1e-30))

    def transformed(self, matrix: np.ndarray) -> "Light":
        """The light in another space: matrix (4, 4) rigid, or with uniform scale, which scales
        lengths and leaves the color, as in a scene that is scaled."""
        scale = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
        return replace(
            self,
            position=matrix[:3, :3] @ self.position + matrix[:3, 3],
            direction=matrix[:3, :3] @ self.direction,
            tangent=matrix[:3, :3] @ self.tangent,
            radius=self.radius * scale,
            size=(self.size[0] * scale, self.size[1] * scale),
        )


@dataclass(frozen=True)
class Lighting:
    """The light of a scene, and how an avatar answers to it.

    world      (9, 3) harmonics (`harmonics.basis`) of the world's radiance by direction of sight
    lights     see `Light`; an environment's sun is one of them (`environment.split_environment`)
    mode       "recorded": colors as trained, to the bit; "scene": relit; "mix": between both
    mix        fraction of "scene" in "mix", 0…1, in linear light
    exposure   stops (powers of two) by which relit colors are made brighter
    white      (3,) linear color that the capture shows of what is white under its own light,
               relative to the estimate: relit colors are divided by it (the eyedropper)
    roughness  of highlights on skin; 0.05…1. Eyeballs and hair have their own (`AvatarLight`)
    specular   factor of highlights; 0: none
    shadows    whether lights are blocked by head and casters; the head always occludes the world
    """

    world: np.ndarray = field(default_factory=lambda: np.zeros((9, 3)))
    lights: tuple[Light, ...] = ()
    mode: str = "scene"
    mix: float = 1.0
    exposure: float = 0.0
    white: tuple[float, float, float] = (1.0, 1.0, 1.0)
    roughness: float = SKIN_ROUGHNESS
    specular: float = 1.0
    shadows: bool = True


@dataclass(frozen=True)
class Caster:
    """Something else that throws shadows onto the head: (V, 3) meters, triangles (F, 3)."""

    vertices: np.ndarray
    faces: np.ndarray
