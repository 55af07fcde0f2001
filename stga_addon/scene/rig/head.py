"""The tracked head as an animated Blender mesh: shape keys for any topology, a rig for FLAME."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...capture.model import Capture
from .. import tags
from ..animation import write_triangle_curves
from ..arrays import flat_floats, has_triangles, triangle_mesh
from ..objects import Warn, capture_root, log_warning, place, reset
from .flame_rig import add_rig, remove_rig


def import_head(capture: Capture, warn: Warn = log_warning, correctives: str = "all") -> Any:
    """The capture's head as a mesh object, animated so that Blender's frame number is the capture's timestep.

    A FLAME capture becomes a rig (see `flame_rig.add_rig`); any other gets one shape key per timestep, `t00012`, with
    value 1 at its own frame, so that the evaluated mesh of that frame is the timestep's mesh; frames between two
    timesteps blend them. Object coordinates are the capture's (meters, y-up). Regions become boolean face attributes
    `stga_region_<name>`. Importing the same folder or file again replaces the last import; vertex groups and materials
    are kept if the triangles are the same. `warn` receives one sentence per problem. correctives: see `add_rig`.
    Raises StgaError where a timestep cannot be read; the scene is then unchanged.
    """
    sequence = capture.flame
    if sequence is not None:
        frames = [sequence.frame(timestep) for timestep in sequence.timesteps]
        head = _place_head(capture)
        add_rig(head, sequence, frames, warn, correctives)
        return head
    meshes = np.empty((len(capture.timesteps), *capture.neutral.shape), np.float32)
    for row, timestep in enumerate(capture.timesteps):
        meshes[row] = capture.mesh(timestep)
    head = _place_head(capture)
    remove_rig(head)
    _add_timestep_keys(head, capture.timesteps, meshes)
    return head


def _place_head(capture: Capture) -> Any:
    root = capture_root(capture.root)
    head = next(iter(tags.find(tags.HEAD, capture.root)), None)
    if head is not None and has_triangles(head.data, capture.faces):
        _update_mesh(head, capture)
    else:
        title = f"{root.name} head"
        head = place(root, tags.HEAD, title, triangle_mesh(title, capture.neutral, capture.faces), head)
    for region, members in capture.regions.items():
        attribute = head.data.attributes.new(tags.REGION_PREFIX + region, "BOOLEAN", "FACE")
        attribute.data.foreach_set("value", np.ascontiguousarray(members, bool))
    head[tags.TIMESTEPS] = [int(timestep) for timestep in capture.timesteps]
    head.shape_key_add(name="Basis", from_mix=False)
    return head


def _update_mesh(head: Any, capture: Capture) -> None:
    """Import into a mesh with the same triangles, which keeps its materials, vertex groups and painted attributes."""
    reset(head)
    mesh = head.data
    mesh.vertices.foreach_set("co", flat_floats(capture.neutral))
    mesh.update()
    for name in [name for name in mesh.attributes.keys() if name.startswith(tags.REGION_PREFIX)]:  # noqa: SIM118
        mesh.attributes.remove(mesh.attributes[name])
    for group in reversed(list(head.vertex_groups)):  # last first: removing a group renumbers those after it
        timestep = tags.group_timestep(group.name)
        if timestep is not None and timestep not in capture.timesteps:
            head.vertex_groups.remove(group)


def _add_timestep_keys(head: Any, timesteps: Sequence[int], meshes: np.ndarray) -> None:
    """meshes (T, V, 3) float32 in object space."""
    names = [f"t{timestep:05d}" for timestep in timesteps]
    for key_name, mesh in zip(names, meshes, strict=True):
        head.shape_key_add(name=key_name, from_mix=False).points.foreach_set("co", mesh.ravel())
    write_triangle_curves(head.data.shape_keys, names, timesteps)
