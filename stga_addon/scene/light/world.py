"""The light of Blender's worlds as spherical harmonics."""

from typing import Any, NamedTuple

import numpy as np
from mathutils import Euler

from ...capture.color import srgb_to_linear
from ...light.environment import split_environment
from ...light.harmonics import uniform
from ...light.values import Light
from ..compat import world_nodes


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


def split_world(light: WorldLight) -> tuple[np.ndarray, tuple[Light, ...]]:
    """Harmonics (9, 3) of `WorldLight`, and its suns, both in the world's axes; reads the image's pixels."""
    if light.image is None:
        return uniform(light.color), ()
    radiance = image_pixels(light.image)[::-1] * np.array(light.color)
    return split_environment(radiance, np.reshape(light.rotation, (3, 3)).T)


def image_pixels(image: Any) -> np.ndarray:
    """(H, W, 3) linear pixels of an image, bottom row first; black where its file is missing."""
    width, height = image.size
    if not width or not height or image.channels < 3:
        return np.zeros((2, 4, 3))
    pixels = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    pixels = pixels.reshape(height, width, image.channels)[..., :3]
    return pixels if image.is_float or image.colorspace_settings.name != "sRGB" else srgb_to_linear(pixels)


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
