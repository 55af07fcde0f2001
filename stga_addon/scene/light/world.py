"""The light of Blender's worlds as spherical harmonics."""

from typing import Any, NamedTuple

import numpy as np
from mathutils import Euler

from ...capture.color import srgb_to_linear
from ...light.harmonics import even_directions, project, uniform
from ..compat import world_nodes

DIRECTIONS = 4096
"""In which an environment texture is looked up."""
MAX_ROWS = 64
"""Height that an environment texture is averaged down to."""


class WorldLight(NamedTuple):
    """What a world's light depends on; equal where its light is.

    color: scene-linear, with strength; of a texture, what its pixels are multiplied with. image: the texture's image.
    rotation (9,): row by row, from directions of the world to those of the texture.
    """

    color: tuple[float, ...]
    image: Any = None
    rotation: tuple[float, ...] = ()


def world_light(world: Any) -> WorldLight | None:
    """The light of a world: one color, or an environment texture on its Background node; None for any other nodes."""
    if world is None:
        return WorldLight((0.0, 0.0, 0.0))
    tree = world_nodes(world)
    if tree is None:
        return WorldLight(tuple(world.color))
    output = tree.get_output_node("ALL")
    links = output.inputs["Surface"].links if output else ()
    if not links:
        return WorldLight((0.0, 0.0, 0.0))
    background = links[0].from_node
    if background.type != "BACKGROUND" or background.inputs["Strength"].is_linked:
        return None
    strength, color = background.inputs["Strength"].default_value, background.inputs["Color"]
    if not color.is_linked:
        return WorldLight(tuple(channel * strength for channel in color.default_value[:3]))
    texture = color.links[0].from_node
    if texture.type != "TEX_ENVIRONMENT" or texture.projection != "EQUIRECTANGULAR" or texture.image is None:
        return None
    rotation = _rotation(texture.inputs["Vector"])
    return None if rotation is None else WorldLight((strength,) * 3, texture.image, tuple(rotation.ravel().tolist()))


def harmonics_of(light: WorldLight) -> np.ndarray:
    """(9, 3) of `WorldLight`; reads the image's pixels."""
    if light.image is None:
        return uniform(light.color)
    directions = even_directions(DIRECTIONS)
    radiance = radiance_in(small_image(light.image), directions @ np.reshape(light.rotation, (3, 3)).T)
    return project(radiance * light.color, directions)


def small_image(image: Any) -> np.ndarray:
    """(H, W, 3) linear pixels of an image, averaged to MAX_ROWS, bottom row first. Missing images are pink in Blender,
    and black here."""
    width, height = image.size
    if not width or not height or not image.channels:
        return np.zeros((1, 1, 3))
    pixels = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    pixels = pixels.reshape(height, width, image.channels)[..., : min(3, image.channels)]
    if not image.is_float and image.colorspace_settings.name == "sRGB":
        pixels = srgb_to_linear(pixels)
    step = max(1, height // MAX_ROWS)
    rows, columns = height // step, max(1, width // step)
    pixels = pixels[: rows * step, : columns * step] if width >= step else pixels[: rows * step]
    blocks = pixels.reshape(rows, step, columns, -1, pixels.shape[-1])
    return np.broadcast_to(blocks.mean((1, 3), dtype=np.float64), (rows, columns, 3))


def radiance_in(image: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(N, 3) of an equirectangular image (H, W, 3), bottom row first, in unit directions (N, 3), as Cycles reads it."""
    height, width = image.shape[:2]
    x, y, z = directions.T
    column = (0.5 - np.arctan2(y, x) / (2 * np.pi)) * width
    row = (1 - np.arccos(np.clip(z, -1, 1)) / np.pi) * height
    return np.asarray(image[np.clip(row.astype(int), 0, height - 1), column.astype(int) % width])


def _rotation(vector: Any) -> np.ndarray | None:
    """(3, 3) that a Mapping node turns the texture's directions by; None for nodes that do more."""
    if not vector.is_linked:
        return np.eye(3)
    node = vector.links[0].from_node
    if node.type == "TEX_COORD":
        return np.eye(3)
    source = node.inputs["Vector"].links if node.type == "MAPPING" else ()
    if not source or source[0].from_node.type != "TEX_COORD" or node.inputs["Rotation"].is_linked:
        return None
    turn = np.array(Euler(node.inputs["Rotation"].default_value).to_matrix())
    return turn.T if node.vector_type == "TEXTURE" else turn
