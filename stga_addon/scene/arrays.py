"""Bulk reads and writes of Blender's meshes as numpy arrays."""

from typing import Any

import bpy
import numpy as np

Z_UP_TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From Blender's axes to those of captures: (x, y, z) is (x, z, -y)."""


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
    """(V, 3) float32 vertex positions of a mesh object at the current frame, in object space.

    Shape keys, drivers and modifiers are applied.
    """
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = evaluated.to_mesh()
    try:
        return mesh_vertices(mesh)
    finally:
        evaluated.to_mesh_clear()


def triangle_mesh(name: str, vertices: np.ndarray, faces: np.ndarray) -> Any:
    """A smooth-shaded mesh of vertices (V, 3) and triangles (F, 3); order and vertex order of the
    faces are kept."""
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", flat_floats(vertices))
    mesh.loops.add(faces.size)
    mesh.loops.foreach_set("vertex_index", np.asarray(faces, np.int32).ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    mesh.update(calc_edges=True)
    return mesh
