"""Blender's lights and worlds as values."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from mathutils import Euler

from ...capture.color import srgb_to_linear
from ...light.environment import split_environment
from ...light.harmonics import uniform
from ...light.values import Light
from ..compat import is_normalized, light_nodes, light_strength, world_nodes

KINDS = {"SUN": "sun", "POINT": "point", "SPOT": "spot", "AREA": "area"}
ELLIPSES = ("DISK", "ELLIPSE")


def light_of(light: Any, matrix: Any) -> Light | None:
    """A light (evaluated data of an object) at a world matrix; None for one without light.

    Its node tree counts as far as it is one Emission node of constant color and strength.
    """
    color = light_strength(light) * _node_factor(light)
    if not color.any() or not np.isfinite(color).all():
        return None
    to_world = np.array(matrix, np.float64)
    scale = np.linalg.norm(to_world[:3, :3], axis=0)
    axes = to_world[:3, :3] / np.maximum(scale, 1e-12)
    found = Light(
        KINDS[light.type],
        color,
        position=to_world[:3, 3],
        direction=-axes[:, 2],
        casts_shadow=bool(light.use_shadow),
        diffuse=light.diffuse_factor,
        specular=light.specular_factor,
    )
    if light.type == "SUN":
        found = replace(found, angle=light.angle)
    elif light.type == "AREA":
        height = light.size_y if light.shape in ("RECTANGLE", "ELLIPSE") else light.size
        shape = "ellipse" if light.shape in ELLIPSES else "rectangle"
        size = float(light.size * scale[0]), float(height * scale[1])
        found = replace(found, size=size, tangent=axes[:, 0], shape=shape)
    else:
        found = replace(found, radius=light.shadow_soft_size)
        if light.type == "SPOT":
            found = replace(found, cone=light.spot_size, blend=light.spot_blend)
    if is_normalized(light):
        return found
    # Energy is per square meter, as Cycles counts them.
    if found.kind == "area":
        area = found.size[0] * found.size[1] * (np.pi / 4 if found.shape == "ellipse" else 1.0)
    else:
        area = float(
            np.pi * (np.tan(found.angle / 2) if found.kind == "sun" else found.radius) ** 2
        )
    return replace(found, color=color * area)


def in_avatar_space(light: Light, to_world: np.ndarray) -> Light:
    """The light in the space that `to_world` (4, 4) takes to the world; what arrives at a surface
    stays the same."""
    to_avatar = np.linalg.inv(to_world)
    found = light.transformed(to_avatar)
    if light.kind == "sun":
        return found
    return replace(
        found, color=found.color * float(np.cbrt(abs(np.linalg.det(to_avatar[:3, :3])))) ** 2
    )


def is_linked(light_object: Any, receivers: tuple[Any, ...]) -> bool:
    """Whether a light's light linking lets it shine on any of these objects (originals)."""
    linking = getattr(light_object, "light_linking", None)
    collection = linking.receiver_collection if linking else None
    if collection is None:
        return True
    members = {child.light_linking.link_state for child in collection.collection_objects}
    members |= {child.light_linking.link_state for child in collection.collection_children}
    named = [_link_state(collection, receiver) for receiver in receivers]
    if "EXCLUDE" in named:
        return False
    return "INCLUDE" in named or "INCLUDE" not in members


def _link_state(collection: Any, receiver: Any) -> str:
    """INCLUDE or EXCLUDE where an object is in the collection of a light linking, else ""."""
    for entry, member in zip(collection.collection_objects, collection.objects, strict=False):
        if member == receiver:
            return str(entry.light_linking.link_state)
    for entry, child in zip(collection.collection_children, collection.children, strict=False):
        if receiver.name in child.all_objects:
            return str(entry.light_linking.link_state)
    return ""


def _node_factor(light: Any) -> np.ndarray:
    tree = light_nodes(light)
    output = tree.get_output_node("ALL") if tree else None
    links = output.inputs["Surface"].links if output else ()
    if not links or links[0].from_node.type != "EMISSION":
        return np.ones(3)
    color, strength = (links[0].from_node.inputs[name] for name in ("Color", "Strength"))
    return np.array(color.default_value[:3]) * strength.default_value


class WorldLight(NamedTuple):
    """What a world's light depends on; equal where its light is.

    color: scene-linear, with strength; of a texture, what its pixels are multiplied with. image:
    the texture's image.
    rotation (9,): row by row, from directions of the world to those of the texture.
    """

    color: tuple[float, ...]
    image: Any = None
    rotation: tuple[float, ...] = ()


def world_light(world: Any) -> WorldLight | None:
    """The light of a world: one color, or an environment texture on its Background node; None for
    any other nodes."""
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
    if (
        texture.type != "TEX_ENVIRONMENT"
        or texture.projection != "EQUIRECTANGULAR"
        or texture.image is None
    ):
        return None
    rotation = _rotation(texture.inputs["Vector"])
    return (
        None
        if rotation is None
        else WorldLight((strength,) * 3, texture.image, tuple(rotation.ravel().tolist()))
    )


def split_world(light: WorldLight) -> tuple[np.ndarray, tuple[Light, ...]]:
    """Harmonics (9, 3) of `WorldLight`, and its suns, both in the world's axes; reads the image's
    pixels."""
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
    return (
        pixels
        if image.is_float or image.colorspace_settings.name != "sRGB"
        else srgb_to_linear(pixels)
    )


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
