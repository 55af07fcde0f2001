"""A mesh object with shape keys as a linear head model."""

from typing import Any

import numpy as np

from ..errors import StgaError
from .arrays import Z_UP_TO_Y_UP, read_values


def has_shape_keys(thing: Any) -> bool:
    """Whether an object (or None) is a mesh with shape keys besides the basis."""
    keys = thing.data.shape_keys if thing is not None and thing.type == "MESH" else None
    return keys is not None and len(keys.key_blocks) > 1


def shape_key_model(thing: Any) -> tuple[np.ndarray, np.ndarray, tuple[str, ...], np.ndarray]:
    """Basis (V, 3) in meters, y up, triangles (F, 3), and names and displacements (V, 3, K) of the other shape keys.

    In world space, turned from Blender's axes, in which a head looks along -y: z up becomes y up. Modifiers, values
    and drivers are left out. Raises StgaError for an object without shape keys.
    """
    if not has_shape_keys(thing):
        raise StgaError(f"{thing.name}: has no shape keys; a head model needs a basis and expressions")
    turn = Z_UP_TO_Y_UP @ np.array(thing.matrix_world)
    basis = thing.data.shape_keys.reference_key
    mean = _points(basis) @ turn[:3, :3].T + turn[:3, 3]
    others = [block for block in thing.data.shape_keys.key_blocks if block != basis]
    moved = np.stack([_points(block) - _points(block.relative_key) for block in others], axis=2)
    shapes = np.einsum("ab,vbk->vak", turn[:3, :3], moved)
    thing.data.calc_loop_triangles()
    faces = read_values(thing.data.loop_triangles, "vertices", 3, np.int32)
    return mean, faces, tuple(block.name for block in others), shapes


def _points(block: Any) -> np.ndarray:
    return read_values(block.data, "co", 3).astype(np.float64)
