"""Splats as Blender objects."""

from typing import Any

import bpy
import numpy as np

from ..avatar.embedding import face_areas
from ..avatar.file import Avatar
from ..avatar.splats import SH_C0, Splats
from ..errors import StgaError
from . import nodes, tags
from .compat import set_modifier_input
from .materials import OPACITY


def show_avatar(avatar: Avatar, head: Any, name: str | None = None) -> Any:
    """The splat object of an avatar: it follows the evaluated mesh of the object `head`, frame by frame.

    head: a mesh object with the avatar's triangles, in their order. Raises StgaError where it has others.
    """
    check_head(avatar, head)
    shown = _splat_object(name or f"{head.name} splats", avatar.splats, head.users_collection[0])
    area = face_areas(avatar.neutral, avatar.faces)[avatar.splats.face]
    _attribute(shown.data, nodes.FACE, "INT", "value", avatar.splats.face, np.int32)
    _attribute(shown.data, nodes.NEUTRAL_AREA, "FLOAT", "value", area)
    _add_modifier(shown, avatar.convention)
    set_input(shown, nodes.HEAD, head)
    # A sibling of the head: the two object spaces are the same, so are the numbers in them.
    shown.parent = head.parent
    shown.matrix_parent_inverse = head.matrix_parent_inverse
    shown.matrix_basis = head.matrix_basis
    return shown


def check_head(avatar: Avatar, head: Any) -> None:
    """Raise StgaError unless `head` is a mesh object with the avatar's triangles, in their order."""
    if head is None or head.type != "MESH":
        raise StgaError("head: a mesh object that carries the avatar is expected")
    faces = np.empty(len(head.data.loops), np.int32)
    head.data.loops.foreach_get("vertex_index", faces)
    if len(faces) != avatar.faces.size or not np.array_equal(faces, avatar.faces.ravel()):
        raise StgaError(
            f"head {head.name}: the avatar was trained on {len(avatar.faces)} triangles of another mesh, "
            f"this one has {len(head.data.polygons)} faces in its own order"
        )


def show_world_splats(splats: Splats, name: str) -> Any:
    """The splat object of a world-space set, say a standard 3DGS PLY."""
    shown = _splat_object(name, splats, bpy.context.scene.collection)
    _add_modifier(shown, None)
    return shown


def splat_modifier(shown: Any) -> Any:
    """The geometry nodes modifier of a splat object. Raises StgaError where `shown` is none."""
    for modifier in shown.modifiers if shown is not None else ():
        if modifier.type == "NODES" and modifier.node_group is not None and nodes.is_splat_tree(modifier.node_group):
            return modifier
    raise StgaError(f"{getattr(shown, 'name', None)}: is not an object that shows splats")


def set_input(shown: Any, name: str, value: Any) -> None:
    """Set an input of a splat object's modifier by its name, `nodes.ELLIPSOIDS` for one.

    Raises StgaError where the splats have no such input: those in world space follow no head.
    """
    modifier = splat_modifier(shown)
    identifier = input_identifier(modifier, name)
    if identifier is None:
        raise StgaError(f"{shown.name}: has no display setting {name!r}")
    set_modifier_input(modifier, identifier, value)


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
                _read(points, "position", "vector", 3),
                _read(points, nodes.WORLD_ROTATION, "value", 4),
                _read(points, nodes.WORLD_SCALE, "vector", 3),
            )
    raise StgaError(f"{shown.name}: shows ellipsoids or nothing, expected points")


def _splat_object(name: str, splats: Splats, collection: Any) -> Any:
    """Vertices-only mesh object with the splats' activated values."""
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(splats))
    mesh.vertices.foreach_set("co", np.ascontiguousarray(splats.xyz, np.float32).ravel())
    norm = np.linalg.norm(splats.rotation, axis=-1, keepdims=True)
    rotation = np.where(norm > 0, splats.rotation / np.where(norm > 0, norm, 1.0), [1.0, 0.0, 0.0, 0.0])
    _attribute(mesh, nodes.XYZ, "FLOAT_VECTOR", "vector", splats.xyz)
    _attribute(mesh, nodes.ROTATION, "QUATERNION", "value", rotation)
    _attribute(mesh, nodes.SCALE, "FLOAT_VECTOR", "vector", np.exp(splats.log_scale.astype(np.float64)))
    _attribute(mesh, OPACITY, "FLOAT", "value", 1 / (1 + np.exp(-splats.opacity.astype(np.float64))))
    _attribute(mesh, nodes.COLOR, "FLOAT_COLOR", "color", _base_color(splats.sh[:, 0]))
    for index in range(splats.sh.shape[1] - 1):
        _attribute(mesh, nodes.SH_REST.format(index), "FLOAT_VECTOR", "vector", splats.sh[:, index + 1])
    mesh.update()
    shown = bpy.data.objects.new(name, mesh)
    shown[tags.KIND] = tags.SPLATS
    collection.objects.link(shown)
    return shown


def _add_modifier(shown: Any, convention: str | None) -> None:
    shown.modifiers.new("STGA Splats", "NODES").node_group = nodes.splat_tree(convention)


def _base_color(dc: np.ndarray) -> np.ndarray:
    """(N, 4) scene-linear RGBA, as colour attributes are stored; the SH coefficients (N, 3) give sRGB."""
    srgb = np.clip(0.5 + SH_C0 * np.asarray(dc, np.float64), 0.0, 1.0)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.concatenate([linear, np.ones((len(dc), 1))], axis=-1)


def _attribute(mesh: Any, name: str, kind: str, field: str, values: np.ndarray, dtype: Any = np.float32) -> None:
    data = mesh.attributes.new(name, kind, "POINT").data
    data.foreach_set(field, np.ascontiguousarray(values, dtype).ravel())


def _read(points: Any, name: str, field: str, width: int) -> np.ndarray:
    data = points.attributes[name].data
    values = np.empty(len(data) * width, np.float32)
    data.foreach_get(field, values)
    return values.reshape(-1, width)
