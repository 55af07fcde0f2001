"""The tracked head as an animated mesh, and meshes with shape keys as head models."""

from typing import Any

import numpy as np

from ...capture.model import Capture
from ...errors import StgaError
from .. import tags
from ..arrays import (
    Z_UP_TO_Y_UP,
    flat_floats,
    has_triangles,
    key_points,
    read_values,
    triangle_mesh,
    write_triangle_curves,
)  # fmt: skip
from ..objects import Warn, capture_root, log_warning, place, reset
from .flame_rig import add_rig, remove_rig
from .keyframes import key_value_path


def import_head(capture: Capture, warn: Warn = log_warning, correctives: str = "all") -> Any:
    """The capture's head as a mesh object, animated so that Blender's frame number is the capture's
    timestep.

    A FLAME capture becomes a rig (see `flame_rig.add_rig`); any other gets one shape key per
    timestep, `t00012`, with value 1 at its own frame, so that the evaluated mesh of that frame is
    the timestep's mesh; frames between two timesteps blend them. Object coordinates are the
    capture's (meters, y-up). Regions become boolean face attributes `stga_region_<name>`. Importing
    the same folder or file again replaces the last import; vertex groups and materials are kept if
    the triangles are the same. `warn` receives one sentence per problem. correctives: see
    `add_rig`. Raises StgaError where a timestep cannot be read; the scene is then unchanged.
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
    names = [f"t{timestep:05d}" for timestep in capture.timesteps]
    for name, mesh in zip(names, meshes, strict=True):
        head.shape_key_add(name=name, from_mix=False).points.foreach_set("co", mesh.ravel())
    keys = head.data.shape_keys
    write_triangle_curves(keys, [key_value_path(name) for name in names], capture.timesteps)
    return head


def _place_head(capture: Capture) -> Any:
    root = capture_root(capture.root)
    head = next(iter(tags.find(tags.HEAD, capture.root)), None)
    if head is not None and has_triangles(head.data, capture.faces):
        # Into the same mesh, which keeps materials, vertex groups and painted attributes.
        reset(head)
        mesh = head.data
        mesh.vertices.foreach_set("co", flat_floats(capture.neutral))
        mesh.update()
        for name in mesh.attributes.keys():  # noqa: SIM118
            if name.startswith(tags.REGION_PREFIX):
                mesh.attributes.remove(mesh.attributes[name])
        # last first: removing a group renumbers those after it
        for group in reversed(list(head.vertex_groups)):
            timestep = tags.group_timestep(group.name)
            if timestep is not None and timestep not in capture.timesteps:
                head.vertex_groups.remove(group)
    else:
        title = f"{root.name} head"
        mesh = triangle_mesh(title, capture.neutral, capture.faces)
        head = place(root, tags.HEAD, title, mesh, head)
    for region, members in capture.regions.items():
        attribute = head.data.attributes.new(tags.REGION_PREFIX + region, "BOOLEAN", "FACE")
        attribute.data.foreach_set("value", np.ascontiguousarray(members, bool))
    head[tags.TIMESTEPS] = [int(timestep) for timestep in capture.timesteps]
    head.shape_key_add(name="Basis", from_mix=False)
    return head


def has_shape_keys(thing: Any) -> bool:
    """Whether an object (or None) is a mesh with shape keys besides the basis."""
    keys = thing.data.shape_keys if thing is not None and thing.type == "MESH" else None
    return keys is not None and len(keys.key_blocks) > 1


def shape_key_model(thing: Any) -> tuple[np.ndarray, np.ndarray, tuple[str, ...], np.ndarray]:
    """Basis (V, 3) in meters, y up, triangles (F, 3), and names and displacements (V, 3, K) of the
    other shape keys.

    In world space, turned from Blender's axes, in which a head looks along -y: z up becomes y up.
    Modifiers, values and drivers are left out. Raises StgaError for an object without shape keys.
    """
    if not has_shape_keys(thing):
        raise StgaError(f"{thing.name}: has no shape keys; a head model needs some")
    turn = Z_UP_TO_Y_UP @ np.array(thing.matrix_world)
    basis = thing.data.shape_keys.reference_key
    mean = key_points(basis) @ turn[:3, :3].T + turn[:3, 3]
    others = [block for block in thing.data.shape_keys.key_blocks if block != basis]
    moved = np.stack([key_points(each) - key_points(each.relative_key) for each in others], axis=2)
    shapes = np.einsum("ab,vbk->vak", turn[:3, :3], moved)
    thing.data.calc_loop_triangles()
    faces = read_values(thing.data.loop_triangles, "vertices", 3, np.int32)
    return mean, faces, tuple(block.name for block in others), shapes
