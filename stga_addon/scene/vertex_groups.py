"""Per-frame selections as vertex groups, to view, paint and scrub through; fractions of selection,
or errors, by triangle as colors. A triangle counts as selected when its three vertices are in the
group: what is written and read back gains triangles whose corners all belong to selected ones."""

from collections.abc import Mapping, Sequence
from typing import Any

import bmesh
import bpy
import numpy as np

from ..capture.meshes import SELECTED_WEIGHT
from ..errors import StgaError
from . import tags
from .arrays import flat_floats, mesh_triangles
from .display.node_builder import Nodes, new_material, new_socket
from .display.splat_attributes import FACE, read_attribute, with_alpha, write_attributes


def write_selection(head: Any, selection: Mapping[int, np.ndarray]) -> None:
    """Replace the head's selection groups by a vertex group `stga_<timestep>` per timestep, weight
    1 on its vertices; none where nothing is selected. selection: timestep -> (F,) bool. Raises
    StgaError in edit mode, or where a selection does not have one entry per triangle."""
    if head.mode == "EDIT":
        raise StgaError(f"{head.name}: is in edit mode; leave it before the selection is written")
    faces = mesh_triangles(head.data)
    for timestep, selected in selection.items():
        if selected.shape != (len(faces),):
            raise StgaError(
                f"{head.name}: the selection of timestep {timestep} has shape {selected.shape},"
                f" expected ({len(faces)},), one entry per triangle"
            )
    # last first: removing a group renumbers those after it
    for group in reversed(list(head.vertex_groups)):
        if tags.group_timestep(group.name) is not None:
            head.vertex_groups.remove(group)
    # For each vertex, `VertexGroup.add` would look for the group among all: seconds for 1,000.
    whole = bmesh.new()
    try:
        whole.from_mesh(head.data, face_normals=False, vertex_normals=False)
        layer = whole.verts.layers.deform.verify()
        weights = [vertex[layer] for vertex in whole.verts]
        for timestep in sorted(selection):
            vertices = np.unique(faces[selection[timestep]]).tolist()
            if vertices:
                index = head.vertex_groups.new(name=tags.group_name(timestep)).index
            for vertex in vertices:
                weights[vertex][index] = 1.0
        whole.to_mesh(head.data)
    finally:
        whole.free()


def read_selection(head: Any) -> dict[int, np.ndarray]:
    """timestep -> (F,) bool of every timestep of the head: triangles whose vertices have weights of
    0.5 or more in the timestep's group; none without a group."""
    head.update_from_editmode()
    groups = {
        timestep: group.index
        for group in head.vertex_groups
        if (timestep := tags.group_timestep(group.name)) is not None
    }
    timesteps = {int(timestep) for timestep in head.get(tags.TIMESTEPS, ())} | set(groups)
    selected = dict(zip(groups, _read_faces(head, list(groups.values())), strict=True))
    faces = len(head.data.polygons)
    return {each: selected.get(each, np.zeros(faces, bool)) for each in sorted(timesteps)}


def training_selection(head: Any) -> dict[int, np.ndarray] | None:
    """`read_selection`, or None without a selection group: the trainer selects itself."""
    if any(tags.group_timestep(group.name) is not None for group in head.vertex_groups):
        return read_selection(head)
    return None


def read_regions(head: Any, names: Sequence[str]) -> dict[str, np.ndarray]:
    """name -> (F,) bool of vertex groups: triangles whose corners have a weight of 0.5 or more."""
    head.update_from_editmode()
    groups = [head.vertex_groups[name].index for name in names]
    return dict(zip(names, _read_faces(head, groups), strict=True))


def read_triangle_weights(head: Any, name: str) -> np.ndarray:
    """(F,) float32 weight of each triangle in a vertex group: the least of its corners'."""
    head.update_from_editmode()
    index = head.vertex_groups[name].index
    members = ({each.group: each.weight for each in v.groups} for v in head.data.vertices)
    weights = np.array([groups.get(index, 0.0) for groups in members], np.float32)
    return weights[mesh_triangles(head.data)].min(1)


def selected_triangles(head: Any) -> np.ndarray:
    """(F,) bool: the triangles that are selected in Edit Mode."""
    head.update_from_editmode()
    selected = np.zeros(len(head.data.polygons), bool)
    head.data.polygons.foreach_get("select", selected)
    return selected


def frame_selection(head: Any, timestep: int) -> np.ndarray | None:
    """(F,) bool of one timestep's selection group; None where it has none."""
    group = frame_group(head, timestep)
    return None if group is None else _read_faces(head, [group.index])[0]


def frame_group(head: Any, timestep: int) -> Any:
    """The vertex group with a timestep's selection; None where it has none."""
    return head.vertex_groups.get(tags.group_name(timestep))


def splats_per_face(splat_object: Any, head: Any) -> np.ndarray | None:
    """(F,) splats of the object on each triangle of the head; None without an avatar."""
    if splat_object is None or FACE not in splat_object.data.attributes:
        return None
    face = read_attribute(splat_object.data, FACE)
    count = np.bincount(face, minlength=len(head.data.polygons))
    return count if len(count) == len(head.data.polygons) else None


def _read_faces(head: Any, groups: list[int]) -> list[np.ndarray]:
    """(F,) bool per group index: triangles with three selected vertices."""
    if not groups:
        return []
    members = [vertex.groups for vertex in head.data.vertices]
    counts = np.array([len(each) for each in members], np.int64)
    indices = np.empty(counts.sum(), np.int32)
    weights = np.empty(counts.sum(), np.float32)
    ends = np.cumsum(counts)
    for each, begin, end in zip(members, (ends - counts).tolist(), ends.tolist(), strict=True):
        if begin < end:
            each.foreach_get("group", indices[begin:end])
            each.foreach_get("weight", weights[begin:end])
    row_of = np.full(len(head.vertex_groups), -1)
    row_of[groups] = np.arange(len(groups))
    rows = row_of[indices]
    vertices = np.repeat(np.arange(len(members)), counts)
    selected = (rows >= 0) & (weights >= SELECTED_WEIGHT)
    in_group = np.zeros((len(groups), len(members)), bool)
    in_group[rows[selected], vertices[selected]] = True
    return list(in_group[:, mesh_triangles(head.data)].all(2))


FRACTION = "stga_selected_share"  # on faces: fraction of the frames that select them
RESIDUAL = "stga_residual"  # on faces: mean absolute error (0…1) of what their splats show
HEAT = "stga_heat"  # on face corners: one of these as a color, relative to the largest
MODIFIER = "STGA Heat Map"
# Linear RGB from never to most often selected.
STOPS = (0.0, 1e-9, 0.25, 0.5, 0.75, 1.0)
RED = (0.1, 0.02, 0.05, 0.15, 0.95, 0.9)
GREEN = (0.1, 0.03, 0.35, 0.6, 0.6, 0.05)
BLUE = (0.1, 0.3, 0.6, 0.1, 0.02, 0.01)


def show_heat_map(
    head: Any, values: np.ndarray, attribute: str = FRACTION, largest: float | None = None
) -> None:
    """Color the head's triangles by values (F,) from 0 to `largest` (None: the largest value),
    stored as `attribute` (FRACTION or RESIDUAL): as the active color attribute, for solid shading,
    and by a modifier with a material, for EEVEE and Cycles; its own materials stay."""
    hide_heat_map(head)
    whole = values.max(initial=0.0) if largest is None else largest
    scaled = np.minimum(values / max(whole, 1e-9), 1.0)
    channels = [np.interp(scaled, STOPS, channel) for channel in (RED, GREEN, BLUE)]
    colors = flat_floats(np.repeat(with_alpha(np.column_stack(channels)), 3, axis=0))
    write_attributes(head.data, {attribute: ("FLOAT", "value", flat_floats(values))}, "FACE")
    write_attributes(head.data, {HEAT: ("FLOAT_COLOR", "color", colors)}, "CORNER")
    head.data.attributes.active_color_name = HEAT
    tree = bpy.data.node_groups.get(MODIFIER)
    if tree is None:  # it assigns the heat map's material
        tree = bpy.data.node_groups.new(MODIFIER, "GeometryNodeTree")
        tree.is_modifier = True
        for side in ("INPUT", "OUTPUT"):
            new_socket(tree, "Geometry", side, "Geometry")
        nodes = Nodes(tree)
        inputs = {"Geometry": nodes.out("NodeGroupInput")}
        inputs["Material"] = new_material(MODIFIER, _unlit)
        colored = nodes.out("GeometryNodeSetMaterial", inputs)
        nodes.finish("NodeGroupOutput", {"Geometry": colored})
    head.modifiers.new(MODIFIER, "NODES").node_group = tree


def hide_heat_map(head: Any) -> None:
    """Show the head as it was before `show_heat_map`."""
    for modifier in [old for old in head.modifiers if old.name.startswith(MODIFIER)]:
        head.modifiers.remove(modifier)
    for name in (FRACTION, RESIDUAL, HEAT):
        if name in head.data.attributes:
            head.data.attributes.remove(head.data.attributes[name])


def has_heat_map(head: Any) -> bool:
    return MODIFIER in head.modifiers


def shows_residuals(head: Any) -> bool:
    return has_heat_map(head) and RESIDUAL in head.data.attributes


def _unlit(nodes: Nodes) -> Any:
    color = nodes.add("ShaderNodeAttribute", attribute_name=HEAT).outputs["Color"]
    return nodes.out("ShaderNodeEmission", {"Color": color})
