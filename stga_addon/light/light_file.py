"""Light from a file: an environment (.hdr), or lights as text (.toml)."""

from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import StgaError
from ..files import read_toml
from ..schema import from_json, setting
from .environment import read_hdr, split_environment
from .harmonics import rotated, uniform
from .values import KINDS, SHAPES, SKIN_ROUGHNESS, Light, Lighting

MAX_LIGHTS = 64
MAX_NUMBER = 1e6


@dataclass(frozen=True)
class LightEntry:
    """A table [[lights]]: see `values.Light`; `strength` is Blender's, in W/m² of a sun and in W of others."""

    kind: str = setting(choices=KINDS)
    strength: float = setting(minimum=0, maximum=MAX_NUMBER)
    color: tuple[float, float, float] = setting((1.0, 1.0, 1.0), 0, MAX_NUMBER)
    position: tuple[float, float, float] = setting((0.0, 0.0, 0.0), -MAX_NUMBER, MAX_NUMBER)
    direction: tuple[float, float, float] = setting((0.0, 0.0, -1.0), -MAX_NUMBER, MAX_NUMBER)
    radius: float = setting(0.0, 0, MAX_NUMBER)
    angle: float = setting(0.00918, 0, 3.2)
    size: tuple[float, float] = setting((0.5, 0.5), 0, MAX_NUMBER)
    tangent: tuple[float, float, float] = setting((1.0, 0.0, 0.0), -MAX_NUMBER, MAX_NUMBER)
    shape: str = setting("rectangle", choices=SHAPES)
    cone: float = setting(0.785, 0, 3.15)
    blend: float = setting(0.15, 0, 1)
    casts_shadow: bool = True
    diffuse: float = setting(1.0, 0, MAX_NUMBER)
    specular: float = setting(1.0, 0, MAX_NUMBER)


@dataclass(frozen=True)
class LightFile:
    """A file of lights, in meters and axes of the capture. world: radiance from everywhere. See `values.Lighting`."""

    world: tuple[float, float, float] = setting((0.0, 0.0, 0.0), 0, MAX_NUMBER)
    lights: tuple[LightEntry, ...] = ()
    exposure: float = setting(0.0, -30, 30)
    white: tuple[float, float, float] = setting((1.0, 1.0, 1.0), above=0)
    roughness: float = setting(SKIN_ROUGHNESS, 0.05, 1)
    specular: float = setting(1.0, 0, 100)
    shadows: bool = True

    def check(self) -> None:
        """Raise StgaError for more lights than are drawn."""
        if len(self.lights) > MAX_LIGHTS:
            raise StgaError(f"lights: expected up to {MAX_LIGHTS}, got {len(self.lights)}")


def read_lighting(path: Path) -> Lighting:
    """The lighting of an .hdr environment, which stands as Blender shows it around the upright head, or of a .toml
    file (`LightFile`). Raises StgaError naming the file."""
    suffix = path.suffix.lower()
    if suffix == ".hdr":
        world, suns = split_environment(read_hdr(path))
        return Lighting(world, suns)
    if suffix != ".toml":
        raise StgaError(f"{path}: expected light as an environment (.hdr) or a list of lights (.toml)")
    values = read_toml(path)
    try:
        entries = values.get("lights", [])
        if isinstance(entries, list):
            values["lights"] = [_completed(LightEntry, entry) for entry in entries]
        found: LightFile = from_json(LightFile, _completed(LightFile, values))
    except StgaError as error:
        raise StgaError(f"{path}: {error}") from error
    return _lighting(found)


def _completed(kind: type, values: Any) -> Any:
    """The values of a table with the defaults of those that it leaves out."""
    if not isinstance(values, dict):
        return values
    defaults = {spec.name: spec.default for spec in fields(kind) if spec.default is not MISSING}
    return {**{name: list(v) if isinstance(v, tuple) else v for name, v in defaults.items()}, **values}


def _lighting(found: LightFile) -> Lighting:
    lights = []
    for entry in found.lights:
        values = {name: getattr(entry, name) for name in vars(entry) if name not in ("strength", "color")}
        lights.append(Light(color=entry.strength * np.array(entry.color), **values))
    rest = {name: getattr(found, name) for name in ("exposure", "white", "roughness", "specular", "shadows")}
    return Lighting(uniform(found.world), tuple(lights), **rest)


def turned(lighting: Lighting, center: np.ndarray, degrees: float) -> Lighting:
    """The lighting turned about the upward axis (+y) through center (3,)."""
    angle = np.radians(degrees)
    matrix = np.eye(4)
    matrix[0, [0, 2]], matrix[2, [0, 2]] = (np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))
    matrix[:3, 3] = center - matrix[:3, :3] @ center
    lights = tuple(light.transformed(matrix) for light in lighting.lights)
    return replace(lighting, world=rotated(lighting.world, matrix[:3, :3]), lights=lights)
