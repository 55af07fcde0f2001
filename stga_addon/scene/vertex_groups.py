"""The per-frame selection as vertex groups, which an artist can see, paint and scrub through.

A vertex group holds vertices and a selection holds triangles: a triangle counts as selected when all three of its
vertices are in the group. Writing a selection and reading it back therefore keeps every selected triangle and adds
those that selected ones enclose on all three corners (`closure` says which).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..errors import StgaError
from . import tags
from .arrays import mesh_triangles
from .display.splat_attributes import FACE


def closure(selected: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) bool: the triangles (F, 3) whose three vertices all belong to a selected triangle (F,) bool."""
    touched = np.zeros(int(faces.max(initial=-1)) + 1, bool)
    touched[faces[selected]] = True
    return np.asarray(touched[faces].all(1))


def write_selection(head: Any, selection: Mapping[int, np.ndarray]) -> None:
    """Replace the head's selection groups: one vertex group `stga_<timestep>` a timestep, weight 1 on its vertices.

    selection: timestep -> (F,) bool. A timestep that selects nothing gets no group. Other vertex groups stay. Raises
    StgaError where the head is in edit mode or a selection does not have one entry a triangle.
    """
    if head.mode == "EDIT":
        raise StgaError(f"{head.name}: is in edit mode, leave it before the selection is written")
    faces = mesh_triangles(head.data)
    for timestep, selected in selection.items():
        if selected.shape != (len(faces),):
            raise StgaError(
                f"{head.name}: the selection of timestep {timestep} has shape {selected.shape},"
                f" expected ({len(faces)},), one entry a triangle"
            )
    for group in reversed(list(head.vertex_groups)):  # the last first: removal renumbers those behind
        if tags.group_timestep(group.name) is not None:
            head.vertex_groups.remove(group)
    for timestep in sorted(selection):
        vertices = np.unique(faces[selection[timestep]])
        if len(vertices):
            head.vertex_groups.new(name=tags.group_name(timestep)).add(vertices.tolist(), 1.0, "REPLACE")


def read_selection(head: Any) -> dict[int, np.ndarray]:
    """timestep -> (F,) bool of every timestep of the head, from its selection groups as they are painted now.

    A triangle is selected where each of its vertices has a weight of at least 0.5 in the timestep's group; a timestep
    without a group selects nothing.
    """
    head.update_from_editmode()
    mesh = head.data
    timesteps = {group.index: tags.group_timestep(group.name) for group in head.vertex_groups}
    columns = {index: timestep for index, timestep in timesteps.items() if timestep is not None}
    painted = _painted(mesh, len(head.vertex_groups), list(columns))
    faces = mesh_triangles(mesh)
    known = {int(timestep) for timestep in head.get(tags.TIMESTEPS, ())} | set(columns.values())
    selection = {timestep: np.zeros(len(faces), bool) for timestep in sorted(known)}
    for row, timestep in zip(painted, columns.values(), strict=True):
        selection[timestep] = row[faces].all(1)
    return selection


def training_selection(head: Any) -> dict[int, np.ndarray] | None:
    """`read_selection` for training; None where the head has no selection group, so that the trainer selects itself."""
    if any(tags.group_timestep(group.name) is not None for group in head.vertex_groups):
        return read_selection(head)
    return None


def read_regions(head: Any, names: Sequence[str]) -> dict[str, np.ndarray]:
    """name -> (F,) bool of vertex groups of the head: the triangles whose corners all have a weight of 0.5 or more."""
    head.update_from_editmode()
    painted = _painted(head.data, len(head.vertex_groups), [head.vertex_groups[name].index for name in names])
    faces = mesh_triangles(head.data)
    return {name: row[faces].all(1) for name, row in zip(names, painted, strict=True)}


def splats_per_face(shown: Any, head: Any) -> np.ndarray | None:
    """(F,) how many splats of the object `shown` each triangle of the head carries; None where it shows no avatar."""
    attribute = shown.data.attributes.get(FACE) if shown is not None else None
    if attribute is None:
        return None
    face = np.empty(len(attribute.data), np.int32)
    attribute.data.foreach_get("value", face)
    count = np.bincount(face, minlength=len(head.data.polygons))
    return count if len(count) == len(head.data.polygons) else None


def frame_selection(head: Any, timestep: int) -> np.ndarray | None:
    """(F,) bool of one timestep as it is painted; None where it has no group."""
    group = head.vertex_groups.get(tags.group_name(timestep))
    if group is None:
        return None
    (painted,) = _painted(head.data, len(head.vertex_groups), [group.index])
    return np.asarray(painted[mesh_triangles(head.data)].all(1))


def _painted(mesh: Any, groups: int, wanted: list[int]) -> np.ndarray:
    """(len(wanted), V) bool: which vertices have the weight of a selected one in the groups of these indices."""
    members = [vertex.groups for vertex in mesh.vertices]
    counts = np.array([len(each) for each in members], np.int64)
    indices, weights = np.empty(counts.sum(), np.int32), np.empty(counts.sum(), np.float32)
    ends = np.cumsum(counts)
    for each, begin, end in zip(members, (ends - counts).tolist(), ends.tolist(), strict=True):
        if begin < end:
            each.foreach_get("group", indices[begin:end])
            each.foreach_get("weight", weights[begin:end])
    row_of = np.full(groups, -1)
    row_of[wanted] = np.arange(len(wanted))
    rows, vertices = row_of[indices], np.repeat(np.arange(len(members)), counts)
    taken = (rows >= 0) & (weights >= tags.SELECTED_WEIGHT)
    painted = np.zeros((len(wanted), len(members)), bool)
    painted[rows[taken], vertices[taken]] = True
    return painted
