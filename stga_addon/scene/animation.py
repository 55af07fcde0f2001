"""F-curves and drivers."""

from collections.abc import Mapping, Sequence
from typing import Any

import bpy
import numpy as np

from .compat import action_curves


def write_curve(
    curves: Any,
    data_path: str,
    index: int,
    frames: np.ndarray,
    values: np.ndarray,
    interpolation: str = "LINEAR",
) -> None:
    """Add one f-curve with all its keyframes at once.

    curves: from `action_curves`; index: of the array element, 0 for a scalar; frames, values (K,),
    frames ascending.
    """
    points = curves.new(data_path, index=index).keyframe_points
    points.add(len(frames))
    points.foreach_set("co", np.column_stack([frames, values]).astype(np.float32).ravel())
    mode = bpy.types.Keyframe.bl_rna.properties["interpolation"].enum_items[interpolation].value
    points.foreach_set("interpolation", np.full(len(frames), mode, np.int32))


def write_triangle_curves(keys: Any, names: Sequence[str], timesteps: Sequence[float]) -> None:
    """Animate shape keys by triangle waves: each is 1 at its own timestep and 0 at all others,
    linear between.

    keys: the Key data-block; names and timesteps (T), ascending.
    """
    curves = action_curves(keys)
    frames = np.asarray(timesteps, np.float64)
    for row, name in enumerate(names):
        near = np.arange(max(row - 1, 0), min(row + 2, len(frames)))
        write_curve(
            curves, f'key_blocks["{name}"].value', 0, frames[near], (near == row).astype(np.float64)
        )


def add_driver(
    owner: Any,
    data_path: str,
    index: int,
    expression: str,
    variables: Mapping[str, tuple[Any, str]],
) -> Any:
    """Drive one value of the data-block `owner` by an expression of other data-blocks' properties.

    index: of the array element, -1 for a scalar; variables: name -> (data-block, data path).
    Expressions of at most 255 characters with arithmetic only are evaluated without Python, so they
    work where scripts are not trusted.
    """
    curve = owner.driver_add(data_path, index)
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
    driver.expression = expression
    return curve
