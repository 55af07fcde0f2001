"""Splats as Blender objects."""

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np

from ...avatar.embedding import face_areas
from ...avatar.file import Avatar
from ...avatar.splats import SH_C0, Splats
from ...avatar.strain import strain_basis
from ...errors import StgaError
from .. import tags
from ..arrays import mesh_triangles, read_values, triangle_mesh
from ..compat import modifier_input, set_modifier_input
from . import splat_nodes
from .color_nodes import FACE, SH, STRAIN_COLOR, strain_attributes
from .colors import srgb_to_linear
from .display_modes import POINTS, WORLD_ROTATION, WORLD_SCALE
from .materials import OPACITY
from .node_builder import is_splat_tree

Attributes = dict[str, tuple[str, str, np.ndarray]]
"""Name -> (data type, the field to set, flat values) of attributes of a mesh."""


@dataclass(frozen=True)
class SplatAttributes:
    """What `show_avatar` writes into the vertices of the splat object, and into the triangles of the neutral mesh."""

    splats: Attributes
    neutral: Attributes


def avatar_attributes(avatar: Avatar) -> SplatAttributes:
    """The part of showing an avatar that works without Blender, so that a thread can do it."""
    area = face_areas(avatar.neutral, avatar.faces)[avatar.splats.face]
    splats = {
        **_attributes(avatar.splats),
        FACE: ("INT", "value", np.ascontiguousarray(avatar.splats.face, np.int32)),
        splat_nodes.NEUTRAL_AREA: ("FLOAT", "value", np.ascontiguousarray(area, np.float32)),
    }
    if not avatar.splats.strain_color.shape[1]:
        return SplatAttributes(splats, {})
    vectors = strain_attributes(strain_basis(avatar.neutral, avatar.faces))
    flat = {name: np.ascontiguousarray(vector, np.float32).ravel() for name, vector in vectors.items()}
    return SplatAttributes(splats, {name: ("FLOAT_VECTOR", "vector", values) for name, values in flat.items()})


def show_avatar(avatar: Avatar, head: Any, name: str | None = None, prepared: SplatAttributes | None = None) -> Any:
    """The splat object of an avatar: it follows the evaluated mesh of the object `head`, frame by frame.

    head: a mesh object with the avatar's triangles, in their order. prepared: `avatar_attributes` of the avatar,
    computed here by default. Raises StgaError where the head has other triangles.
    """
    check_head(avatar, head)
    prepared = prepared or avatar_attributes(avatar)
    own = (collection for collection in head.users_collection if collection.library is None)  # or all are linked
    collection = next(own, bpy.context.scene.collection)
    shown = _splat_object(name or f"{head.name} splats", prepared.splats, collection)
    shown[tags.CONVENTION], shown[tags.ANTIALIASED] = avatar.convention, avatar.antialiased
    _add_modifier(shown, avatar.convention, avatar.splats)
    set_input(shown, splat_nodes.HEAD, head)
    # In no collection: it is never seen, and lives as long as the splats that point to it.
    set_input(shown, splat_nodes.NEUTRAL, _neutral_object(f"{shown.name} neutral", avatar, prepared.neutral))
    # A sibling of the head: the two object spaces are the same, so are the numbers in them.
    shown.parent = head.parent
    shown.matrix_parent_inverse = head.matrix_parent_inverse
    shown.matrix_basis = head.matrix_basis
    return shown


def hide_object(head: Any, scene: Any) -> None:
    """Hide the head, which would cover its splats; it still moves them. A linked one stays visible in renders."""
    if head.library is None:
        head.hide_render = True
    for layer in scene.view_layers:
        if layer.objects.get(head.name) is head:
            head.hide_set(True, view_layer=layer)


def can_update(shown: Any, avatar: Avatar) -> bool:
    """Whether `update_splats` can show the avatar in this object: same convention, color model and antialiasing."""
    try:
        tree = splat_modifier(shown).node_group
    except StgaError:
        return False
    same = (shown.get(tags.CONVENTION), shown.get(tags.ANTIALIASED)) == (avatar.convention, avatar.antialiased)
    return same and tree == splat_nodes.find_splat_tree(*_kind(avatar.convention, avatar.splats))


def update_splats(shown: Any, prepared: SplatAttributes) -> None:
    """Show other splats in the same object: display settings, name and users stay.

    prepared: from `avatar_attributes` of an avatar for which `can_update` says yes.
    """
    _write(shown.data, prepared.splats)


def build_next_node_group(avatar: Avatar) -> bool:
    """Do a moment's work on the node tree that `show_avatar` will want; whether there was some left to do."""
    return splat_nodes.build_next_node_group(*_kind(avatar.convention, avatar.splats))


def check_head(avatar: Avatar, head: Any) -> None:
    """Raise StgaError unless `head` is a mesh object with the avatar's triangles, in their order."""
    if head is None or head.type != "MESH":
        raise StgaError("head: a mesh object that carries the avatar is expected")
    if len(head.data.loops) != avatar.faces.size or not np.array_equal(mesh_triangles(head.data), avatar.faces):
        raise StgaError(
            f"head {head.name}: the avatar was trained on {len(avatar.faces)} triangles of another mesh, "
            f"this one has {len(head.data.polygons)} faces in its own order"
        )


def show_world_splats(splats: Splats, name: str) -> Any:
    """The splat object of a world-space set, say a standard 3DGS PLY."""
    shown = _splat_object(name, _attributes(splats), bpy.context.scene.collection)
    _add_modifier(shown, None, splats)
    return shown


def splat_modifier(shown: Any) -> Any:
    """The geometry nodes modifier of a splat object. Raises StgaError where `shown` is none."""
    for modifier in shown.modifiers if shown is not None else ():
        if modifier.type == "NODES" and modifier.node_group is not None and is_splat_tree(modifier.node_group):
            return modifier
    raise StgaError(f"{getattr(shown, 'name', None)}: is not an object that shows splats")


def set_input(shown: Any, name: str, value: Any) -> None:
    """Set an input of a splat object's modifier by its name, `splat_nodes.SIZE` for one.

    Raises StgaError where the splats have no such input: those in world space follow no head.
    """
    modifier = splat_modifier(shown)
    identifier = input_identifier(modifier, name)
    if identifier is None:
        raise StgaError(f"{shown.name}: has no display setting {name!r}")
    set_modifier_input(modifier, identifier, value)


def get_input(shown: Any, name: str) -> Any:
    """An input of a splat object's modifier by its name; None where it has no such input."""
    modifier = splat_modifier(shown)
    identifier = input_identifier(modifier, name)
    return None if identifier is None else modifier_input(modifier, identifier)


def input_identifier(modifier: Any, name: str) -> str | None:
    """Identifier ("Socket_2") of the modifier's input that a person sees as `name`; None where it has no such input."""
    items = modifier.node_group.interface.items_tree
    return next((item.identifier for item in items if item.in_out == "INPUT" and item.name == name), None)


def evaluated_splats(shown: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a splat object displays as points at the current frame, in its object space.

    Returns position (N, 3), rotation (N, 4) wxyz and linear standard deviations (N, 3), float32.
    Raises StgaError where it displays ellipsoids, which are instances and not one geometry.
    """
    depsgraph = bpy.context.evaluated_depsgraph_get()
    for instance in depsgraph.object_instances:
        made_by = instance.parent if instance.is_instance else instance.object
        if made_by is not None and made_by.original == shown and instance.object.type == "POINTCLOUD":
            points = instance.object.data
            return (
                read_values(points.attributes["position"].data, "vector", 3),
                read_values(points.attributes[WORLD_ROTATION].data, "value", 4),
                read_values(points.attributes[WORLD_SCALE].data, "vector", 3),
            )
    raise StgaError(f"{shown.name}: shows ellipsoids or nothing, expected points")


def _splat_object(name: str, attributes: Attributes, collection: Any) -> Any:
    """Vertices-only mesh object with the splats' activated values."""
    mesh = bpy.data.meshes.new(name)
    _write(mesh, attributes)
    shown = bpy.data.objects.new(name, mesh)
    shown[tags.KIND] = tags.SPLATS
    collection.objects.link(shown)
    return shown


def _neutral_object(name: str, avatar: Avatar, attributes: Attributes) -> Any:
    mesh = triangle_mesh(name, avatar.neutral, avatar.faces)
    _write_attributes(mesh, attributes, "FACE")
    return bpy.data.objects.new(name, mesh)


def _attributes(splats: Splats) -> Attributes:
    norm = np.linalg.norm(splats.rotation, axis=-1, keepdims=True)
    rotation = np.where(norm > 0, splats.rotation / np.where(norm > 0, norm, 1.0), [1.0, 0.0, 0.0, 0.0])
    values = {
        splat_nodes.XYZ: ("FLOAT_VECTOR", "vector", splats.xyz),
        splat_nodes.ROTATION: ("QUATERNION", "value", rotation),
        splat_nodes.SCALE: ("FLOAT_VECTOR", "vector", np.exp(splats.log_scale.astype(np.float64))),
        OPACITY: ("FLOAT", "value", 1 / (1 + np.exp(-splats.opacity.astype(np.float64)))),
        splat_nodes.COLOR: ("FLOAT_COLOR", "color", _base_color(splats.sh[:, 0])),
    }
    for name, coefficients in ((SH, splats.sh), (STRAIN_COLOR, splats.strain_color)):
        for index in range(coefficients.shape[1]):
            values[name.format(index)] = ("FLOAT_VECTOR", "vector", coefficients[:, index])
    return {
        name: (kind, field, np.ascontiguousarray(array, np.float32).ravel())
        for name, (kind, field, array) in values.items()
    }


def _base_color(dc: np.ndarray) -> np.ndarray:
    """(N, 4) scene-linear RGBA, as colour attributes are stored; the SH coefficients (N, 3) give sRGB."""
    linear = srgb_to_linear(np.clip(0.5 + SH_C0 * np.asarray(dc, np.float64), 0.0, 1.0))
    return np.concatenate([linear, np.ones((len(dc), 1))], axis=-1)


def _write(mesh: Any, attributes: Attributes) -> None:
    """Make the mesh's vertices and attributes these; what there is already is overwritten in place."""
    positions = attributes[splat_nodes.XYZ][2]
    if len(mesh.vertices) != len(positions) // 3:
        mesh.clear_geometry()
        mesh.vertices.add(len(positions) // 3)
    # The attribute, which takes the numbers at once; the vertices' own property takes them one by one.
    _write_attributes(mesh, {"position": ("FLOAT_VECTOR", "vector", positions), **attributes}, "POINT")
    mesh.update()


def _write_attributes(mesh: Any, attributes: Attributes, domain: str) -> None:
    for name, (kind, field, values) in attributes.items():
        attribute = mesh.attributes.get(name) or mesh.attributes.new(name, kind, domain)
        attribute.data.foreach_set(field, values)


def _kind(convention: str | None, splats: Splats) -> tuple[str | None, int, bool]:
    """What decides the node tree, as `splat_nodes.splat_tree` takes it."""
    return convention, splats.sh_degree, splats.strain_color.shape[1] > 0


def _add_modifier(shown: Any, convention: str | None, splats: Splats) -> None:
    modifier = shown.modifiers.new("STGA Splats", "NODES")
    modifier.node_group = splat_nodes.splat_tree(*_kind(convention, splats))
    set_input(shown, splat_nodes.DISPLAY, POINTS)  # the default of a menu does not reach the modifier in every version
