"""What differs between Blender 4.2 and 5.2, and the bulk reads and writes that every scene module shares."""

from collections.abc import Mapping, Sequence
from typing import Any

import bpy
import numpy as np

SLOTTED_ACTIONS = bpy.app.version >= (4, 4, 0)
MODIFIER_INPUT_PROPERTIES = bpy.app.version >= (5, 2, 0)
# Options of a path property that may start with "//"; newer versions want to be told, older ones refuse the word.
PATH_OPTIONS = (
    {"PATH_SUPPORTS_BLEND_RELATIVE"}
    if "is_path_supports_blend_relative" in bpy.types.Property.bl_rna.properties
    else set()
)


def action_curves(owner: Any) -> Any:
    """The f-curve collection that animates the data-block `owner`; makes its action (and slot) where it has none.

    Call `.new(data_path, index=…)` on it, or `write_curve`.
    """
    animation = owner.animation_data or owner.animation_data_create()
    if animation.action is None:
        animation.action = bpy.data.actions.new(f"{owner.name} action")
    action = animation.action
    if not SLOTTED_ACTIONS:
        return action.fcurves
    if animation.action_slot is None:
        animation.action_slot = action.slots.new(id_type=owner.id_type, name=owner.name)
    layer = action.layers[0] if action.layers else action.layers.new("Layer")
    strip = layer.strips[0] if layer.strips else layer.strips.new(type="KEYFRAME")
    return strip.channelbag(animation.action_slot, ensure=True).fcurves


def write_curve(
    curves: Any, data_path: str, index: int, frames: np.ndarray, values: np.ndarray, interpolation: str = "LINEAR"
) -> None:
    """Add one f-curve with all its keyframes at once.

    curves from `action_curves`; index of the array element (0 for a scalar); frames, values (K,), frames ascending.
    """
    points = curves.new(data_path, index=index).keyframe_points
    points.add(len(frames))
    points.foreach_set("co", np.column_stack([frames, values]).astype(np.float32).ravel())
    mode = bpy.types.Keyframe.bl_rna.properties["interpolation"].enum_items[interpolation].value
    points.foreach_set("interpolation", np.full(len(frames), mode, np.int32))


def write_hat_curves(keys: Any, names: Sequence[str], timesteps: Sequence[int]) -> None:
    """Animate shape keys that take turns: each is 1 at its own timestep and 0 from its neighbours' on, linear between.

    keys: the Key data-block; names and timesteps (T), ascending.
    """
    curves = action_curves(keys)
    frames = np.asarray(timesteps, np.float64)
    for row, name in enumerate(names):
        near = np.arange(max(row - 1, 0), min(row + 2, len(frames)))
        write_curve(curves, f'key_blocks["{name}"].value', 0, frames[near], (near == row).astype(np.float64))


def add_driver(
    owner: Any, data_path: str, index: int, expression: str, variables: Mapping[str, tuple[Any, str]]
) -> Any:
    """Drive one value of the data-block `owner` by an expression of other data-blocks' properties.

    index of the array element, -1 for a scalar; variables: name -> (data-block, data path). Expressions of at most
    255 characters with arithmetic only are evaluated without Python, so they run where scripts are not trusted.
    """
    curve = owner.driver_add(data_path, index)
    # A new driver comes with keyframes at 0 and 1, to which results closer than 1e-4 would snap.
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


def evaluated_vertices(thing: Any) -> np.ndarray:
    """(V, 3) float32 vertex positions of a mesh object at the current frame, in object space.

    Shape keys, drivers and modifiers are applied.
    """
    evaluated = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = evaluated.to_mesh()
    try:
        vertices = np.empty(len(mesh.vertices) * 3, np.float32)
        mesh.vertices.foreach_get("co", vertices)
    finally:
        evaluated.to_mesh_clear()
    return vertices.reshape(-1, 3)


def set_modifier_input(modifier: Any, identifier: str, value: Any) -> None:
    """Set a geometry nodes modifier's input by its socket identifier ("Socket_2")."""
    if MODIFIER_INPUT_PROPERTIES:
        getattr(modifier.properties.inputs, identifier).value = value
    else:
        modifier[identifier] = value
    modifier.id_data.update_tag()


def modifier_input(modifier: Any, identifier: str) -> Any:
    """The value of a geometry nodes modifier's input by its socket identifier."""
    if MODIFIER_INPUT_PROPERTIES:
        return getattr(modifier.properties.inputs, identifier).value
    return modifier[identifier]


def modifier_input_owner(modifier: Any, identifier: str) -> tuple[Any, str]:
    """What `UILayout.prop` needs to draw a geometry nodes modifier's input: the owner and the property's name."""
    if MODIFIER_INPUT_PROPERTIES:
        return getattr(modifier.properties.inputs, identifier), "value"
    return modifier, f'["{identifier}"]'
