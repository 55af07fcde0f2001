"""Bulk reads and writes of meshes and f-curves as numpy arrays, and drivers."""

from collections.abc import Mapping, Sequence
from typing import Any

import bpy
import numpy as np

from ..errors import StgaError
from .compat import action_curves
from .evaluation import evaluated, kept_evaluated

Z_UP_TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Rotation from Blender's axes to those of captures: (x, y, z) is (x, z, -y)."""
MAX_SPREAD = 2.0
"""Largest ratio between the quartiles of the factors by which modifiers stretch a head's edges; of
a remeshed head, whose first vertices are anywhere, it is larger."""


def read_values(items: Any, field: str, width: int, dtype: Any = np.float32) -> np.ndarray:
    """(N, width) of one property of a collection of N items."""
    values = np.empty(len(items) * width, dtype)
    items.foreach_get(field, values)
    return values.reshape(-1, width)


def flat_floats(values: np.ndarray) -> np.ndarray:
    """The values as `foreach_set` takes them: one axis, float32."""
    return np.ascontiguousarray(values, np.float32).ravel()


def mesh_vertices(mesh: Any) -> np.ndarray:
    """(V, 3) float32 positions of a mesh's vertices."""
    return read_values(mesh.vertices, "co", 3)


def mesh_triangles(mesh: Any) -> np.ndarray:
    """(F, 3) int32 vertex indices of a mesh that has triangles only."""
    return read_values(mesh.loops, "vertex_index", 1, np.int32).reshape(-1, 3)


def has_triangles(mesh: Any, faces: np.ndarray) -> bool:
    """Whether the mesh's faces are these triangles (F, 3), in this order."""
    return len(mesh.loops) == faces.size and np.array_equal(mesh_triangles(mesh), faces)


def evaluated_vertices(obj: Any) -> np.ndarray:
    """(V, 3) float32 vertices of a mesh object at the current frame, in object space."""
    with kept_evaluated([obj]):
        evaluated_object = evaluated(obj, bpy.context.evaluated_depsgraph_get())
        mesh = evaluated_object.to_mesh()
        try:
            return mesh_vertices(mesh)
        finally:
            evaluated_object.to_mesh_clear()


def head_vertices(head: Any) -> np.ndarray:
    """(V, 3) float32 of a head's own vertices as `evaluated_vertices`, also where modifiers divide
    its triangles or add others. Raises StgaError where they replace them."""
    neutral = head.data
    found = evaluated_vertices(head)
    if len(found) == len(neutral.vertices):
        return found
    if len(found) > len(neutral.vertices):
        neutral.calc_loop_triangles()
        triangles = read_values(neutral.loop_triangles, "vertices", 3, np.int32)
        posed = found[: len(neutral.vertices)]
        stretch = _edges(posed[triangles]) / np.maximum(
            _edges(mesh_vertices(neutral)[triangles]), 1e-9
        )
        low, high = np.quantile(stretch, (0.25, 0.75))
        if high <= MAX_SPREAD * low:
            return posed
    problem = "its modifiers make other triangles"
    raise StgaError(f"{head.name}: {problem}; switch off those that do, such as Decimate or Remesh")


def _edges(corners: np.ndarray) -> np.ndarray:
    """(F, 3) lengths of the edges of triangles (F, 3, 3)."""
    return np.asarray(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2))


def triangle_mesh(name: str, vertices: np.ndarray, faces: np.ndarray) -> Any:
    """A smooth-shaded mesh of vertices (V, 3) and triangles (F, 3), in their order."""
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", flat_floats(vertices))
    mesh.loops.add(faces.size)
    mesh.loops.foreach_set("vertex_index", np.asarray(faces, np.int32).ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    mesh.update(calc_edges=True)
    return mesh


def key_points(key: Any) -> np.ndarray:
    """(V, 3) float64 positions of a shape key's points."""
    return read_values(key.points, "co", 3).astype(np.float64)


def write_curves(
    owner: Any, data_path: str, frames: Any, values: Any, interpolation: str = "LINEAR"
) -> None:
    """Add f-curves with all their keyframes to the action of `owner`. frames (K,): ascending;
    values: (K,) of a scalar, (K, C) of an array's elements."""
    curves = action_curves(owner)
    values = np.asarray(values)
    mode = bpy.types.Keyframe.bl_rna.properties["interpolation"].enum_items[interpolation].value
    for index, column in enumerate(values.reshape(len(values), -1).T):
        points = curves.new(data_path, index=index).keyframe_points
        points.add(len(frames))
        points.foreach_set("co", np.column_stack([frames, column]).astype(np.float32).ravel())
        points.foreach_set("interpolation", np.full(len(frames), mode, np.int32))


def write_triangle_curves(
    owner: Any, paths: Sequence[str], timesteps: Sequence[float], interpolation: str = "LINEAR"
) -> None:
    """Animate values (T) of `owner`: each is 1 at its timestep and 0 at others, ascending."""
    for row, path in enumerate(paths):
        near = np.arange(max(row - 1, 0), min(row + 2, len(paths)))
        write_curves(owner, path, np.asarray(timesteps)[near], near == row, interpolation)


def add_driver(
    owner: Any, path: str, index: int, expression: str, variables: Mapping[str, tuple[Any, str]]
) -> None:
    """Drive one value of the data-block `owner` by an expression of others' properties. index: of
    an array element, -1 for a scalar; variables: name -> (data-block, data path). Arithmetic of at
    most 255 characters is evaluated without Python, also where scripts are not trusted."""
    curve = owner.driver_add(path, index)
    # A new driver has keyframes at 0 and 1, to which Blender snaps results closer than 1e-4.
    curve.keyframe_points.clear()
    driver = curve.driver
    driver.type = "SCRIPTED"
    for name, (source, source_path) in variables.items():
        variable = driver.variables.new()
        variable.name = name
        target = variable.targets[0]
        if source.id_type != target.id_type:
            target.id_type = source.id_type
        target.id = source
        target.data_path = source_path
        target.use_fallback_value = True  # 0 for a shape key that was removed
    driver.expression = expression
