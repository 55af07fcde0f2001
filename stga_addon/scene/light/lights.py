"""Blender's lights as values, in the space of an avatar."""

from dataclasses import replace
from typing import Any

import numpy as np

from ...light.values import Light
from ..compat import is_normalized, light_nodes, light_strength

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
    return found if is_normalized(light) else replace(found, color=color * _area(found))


def in_avatar_space(light: Light, to_world: np.ndarray) -> Light:
    """The light in the space that `to_world` (4, 4) takes to the world; what arrives at a surface stays the same."""
    to_avatar = np.linalg.inv(to_world)
    found = light.transformed(to_avatar)
    if light.kind == "sun":
        return found
    return replace(found, color=found.color * float(np.cbrt(abs(np.linalg.det(to_avatar[:3, :3])))) ** 2)


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


def _area(light: Light) -> float:
    """What a light's energy per square meter is multiplied with, as by Cycles."""
    if light.kind == "area":
        return light.size[0] * light.size[1] * (np.pi / 4 if light.shape == "ellipse" else 1.0)
    return float(np.pi * (np.tan(light.angle / 2) if light.kind == "sun" else light.radius) ** 2)


def _node_factor(light: Any) -> np.ndarray:
    tree = light_nodes(light)
    output = tree.get_output_node("ALL") if tree else None
    links = output.inputs["Surface"].links if output else ()
    if not links or links[0].from_node.type != "EMISSION":
        return np.ones(3)
    color, strength = (links[0].from_node.inputs[name] for name in ("Color", "Strength"))
    return np.array(color.default_value[:3]) * strength.default_value
