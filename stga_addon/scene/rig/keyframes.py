"""Keyframes of a FLAME head, and the names and data paths of what they move."""

from collections.abc import Callable, Sequence
from typing import Any

import bpy
import numpy as np

from ...driving.performance import ARKIT_SHAPES
from ...errors import StgaError
from ...flame.forward import FlameFrame, joint_positions
from ...flame.model import JOINTS, FlameModel
from ...flame.quaternions import continuous, from_axis_angle
from ...flame.sequence import PARTS, FlameSequence
from ..arrays import write_curve, write_curves, write_triangle_curves
from ..compat import action_curves, copy_action, push_down_action
from ..objects import Warn, log_warning

IDENTITY_SLIDERS = 10
# Prefixes of shape keys; the number after one is the component, or the timestep.
EXPRESSION_KEY, IDENTITY_KEY, OFFSET_KEY = "expr_", "identity_", "offset_t"
EXPRESSION_NAMES = "stga_expressions"
"""Property of a head whose expressions have ARKit's names: these, separated by commas."""
# The joints that each part of a motion (`flame.motion.PARTS`) rotates.
EYES = ("left_eye", "right_eye")
PART_JOINTS = {"jaw": ("jaw",), "eyes": EYES, "neck": ("neck",), "head": ("root",)}
offset_key = f"{OFFSET_KEY}{{:05d}}".format
# The hidden bones of a joint whose position depends on the sliders: that moves its bone, and that
# its vertices follow.
parent_bone, deform_bone = "{}_joint".format, "{}_deform".format
# Properties of the rig: partial sums of the joint's displacement by the sliders, and that by
# tracked vertex offsets.
sum_property, offset_property = "stga_{}_sums".format, "stga_{}_offset".format
# Data paths of a property, of bones, and of a shape key.
property_path, key_value_path = '["{}"]'.format, 'key_blocks["{}"].value'.format
rotation_path = 'pose.bones["{}"].rotation_quaternion'.format
location_path = 'pose.bones["{}"].location'.format


def expression_key(head: Any, component: int) -> str:
    """The head's shape key of an expression component."""
    named = head.get(EXPRESSION_NAMES)
    return named.split(",")[component] if named else f"{EXPRESSION_KEY}{component:03d}"


def posing_bone(head: Any) -> str:
    """The bone to turn first: the jaw, or the neck where a shape moves the jaw."""
    return "neck" if EXPRESSION_NAMES in head else "jaw"


def expression_keys(head: Any) -> list[str]:
    """The shape keys that a head has of its expression components, in their order."""
    named = head.get(EXPRESSION_NAMES, "").split(",")
    names = [block.name for block in head.data.shape_keys.key_blocks]
    return [name for name in names if name.startswith(EXPRESSION_KEY) or name in named]


def slider_components(model: FlameModel) -> dict[str, int]:
    """Shape key -> component of `model.shapedirs`: expressions, and the first of identity."""
    numbered = [f"{EXPRESSION_KEY}{k:03d}" for k in range(model.n_expression)]
    names = enumerate(model.expression_names or numbered, model.n_identity)
    identity = range(min(IDENTITY_SLIDERS, model.n_identity))
    return {name: k for k, name in names} | {f"{IDENTITY_KEY}{k:03d}": k for k in identity}


def offset_keys(head: Any) -> list[Any]:
    """The shape keys that hold tracked per-frame vertex offsets."""
    return [key for key in head.data.shape_keys.key_blocks if key.name.startswith(OFFSET_KEY)]


def is_of_parts(data_path: str, parts: Sequence[str]) -> bool:
    """Whether an f-curve of rig or shape keys animates one of the parts (`flame.motion.PARTS`)."""
    prefixes = [f'pose.bones["{bone}"].rotation_' for bone in bones_of(parts)]
    prefixes += [location_path("root")] if "head" in parts else []
    # The tracked per-frame offsets belong to the tracked expressions.
    if "expression" in parts:
        prefixes += [f'key_blocks["{EXPRESSION_KEY}', f'key_blocks["{OFFSET_KEY}', '["stga_']
        prefixes += [f'key_blocks["{name}"]' for name in ARKIT_SHAPES]
    return data_path.startswith(tuple(prefixes))


def bones_of(parts: Sequence[str]) -> list[str]:
    return [bone for part in parts for bone in PART_JOINTS.get(part, ())]


UNCHANGED = 1e-6
"""Change of a slider's value below which it is not keyframed."""
MAX_SLIDER = 10.0
"""The widest range that Blender allows a shape key's value: -10 to 10."""


def key_motion(
    head: Any, rig: Any, numbers: Sequence[int], frames: Sequence[FlameFrame],
    parts: Sequence[str] = tuple(PARTS), warn: Warn = log_warning,
) -> None:  # fmt: skip
    """Add keyframes of the parts (`flame.motion.PARTS`) of `frames` to the active actions of rig
    and shape keys.

    numbers: the Blender frame of each, ascending. A slider that the motion never moves gets a
    single keyframe.
    """
    at = np.asarray(numbers)
    if "expression" in parts:
        values = np.stack([frame.expr for frame in frames])
        curves = action_curves(head.data.shape_keys)
        for component, column in enumerate(values.T):
            path = key_value_path(expression_key(head, component))
            keyed = slice(None) if column.any() else slice(1)
            write_curve(curves, path, 0, at[keyed], column[keyed])
        if np.abs(values).max(initial=0.0) > MAX_SLIDER:
            row, component = np.unravel_index(np.abs(values).argmax(), values.shape)
            warn(
                f"{head.name}: expression {component} is {values[row, component]:.1f} at frame "
                f"{at[row]}, but Blender limits shape keys to ±{MAX_SLIDER:g}; the mesh differs "
                "from the tracked one there"
            )
    for bone in bones_of(parts):
        turns = np.stack([frame.pose[JOINTS.index(bone)] for frame in frames])
        key_turns(rig, bone, numbers, turns)
    if "head" in parts:
        translations = np.stack([frame.translation for frame in frames])
        write_curves(action_curves(rig), location_path("root"), at, translations)


def key_turns(rig: Any, bone: str, numbers: Sequence[int], turns: np.ndarray) -> None:
    """Keyframe a bone's rotation, axis-angle (T, 3), at the frames `numbers`."""
    turned = continuous(from_axis_angle(turns))
    write_curves(action_curves(rig), rotation_path(bone), numbers, turned)


def check_keyable(owner: Any, bones: Sequence[str] = ()) -> None:
    """Raise StgaError where keyframes of `owner`, or of these bones, would have no effect."""
    if owner.animation_data is not None and owner.animation_data.use_tweak_mode:
        raise StgaError(f"{owner.name}: is in tweak mode in the NLA editor; leave tweak mode first")
    for name in bones:
        if owner.pose.bones[name].rotation_mode != "QUATERNION":
            raise StgaError(f"{owner.name}: the rotation mode of bone {name} must be Quaternion")


def start_action(owner: Any, name: str, replaces: Callable[[str], bool], as_strip: bool) -> None:
    """Give `owner` a new action: with the old one as a strip, or a copy less replaced curves."""
    if as_strip:
        push_down_action(owner)
        (owner.animation_data or owner.animation_data_create()).action = bpy.data.actions.new(name)
        return
    curves = copy_action(owner, name)
    for curve in [curve for curve in curves if replaces(curve.data_path)]:
        curves.remove(curve)


def key_tracked_offsets(
    head: Any, rig: Any, sequence: FlameSequence, frames: Sequence[FlameFrame],
    numbers: Sequence[float],
) -> None:  # fmt: skip
    """Keyframe the tracked per-frame offsets of mesh and joints.

    sequence: the one that the head was imported from, with its frames; numbers: the Blender frame
    of each, ascending.
    """
    paths = [key_value_path(offset_key(timestep)) for timestep in sequence.timesteps]
    write_triangle_curves(head.data.shape_keys, paths, numbers)
    displacement = np.zeros((len(frames), len(JOINTS), 3))
    for row, frame in enumerate(frames):
        if frame.dynamic_offset is not None:
            displacement[row] = joint_positions(sequence.model, frame.dynamic_offset)
    for joint, name in enumerate(JOINTS):
        path = property_path(offset_property(name))
        write_curves(action_curves(rig), path, numbers, displacement[:, joint])


def key_zero_offsets(head: Any, rig: Any, frame: int) -> None:
    """Keyframe tracked per-frame offsets of mesh and joints to zero from `frame` on."""
    for key in offset_keys(head):
        curves = action_curves(head.data.shape_keys)
        write_curve(curves, key_value_path(key.name), 0, [frame], np.zeros(1))
    for name in map(offset_property, JOINTS):
        if name in rig:
            write_curves(action_curves(rig), property_path(name), [frame], np.zeros((1, 3)))


def key_current_pose(head: Any, rig: Any, frame: int) -> None:
    """Keyframe pose and expression as they are now, set by hand or not, at `frame` alone."""
    for bone in JOINTS:
        rig.pose.bones[bone].keyframe_insert("rotation_quaternion", frame=frame)
    rig.pose.bones["root"].keyframe_insert("location", frame=frame)
    for curve in action_curves(head.data.shape_keys):
        name = curve.data_path.partition('"')[2].partition('"')[0]
        value, before = head.data.shape_keys.key_blocks[name].value, curve.evaluate(frame)
        is_expression = name.startswith(EXPRESSION_KEY) or name in ARKIT_SHAPES
        if not is_expression or abs(value - before) < UNCHANGED:
            continue
        if len(curve.keyframe_points) == 1:  # the motion never moves this slider
            for neighbor in (frame - 1, frame + 1):
                curve.keyframe_points.insert(neighbor, before)
        curve.keyframe_points.insert(frame, value)


def animated_by(head: Any, rig: Any, parts: Sequence[str]) -> list[Any]:
    """The data-blocks in whose actions the parts are keyframed: rig, shape keys, or both."""
    in_rig = set(parts) & set(PART_JOINTS) or ("expression" in parts and offset_keys(head))
    return ([rig] if in_rig else []) + ([head.data.shape_keys] if "expression" in parts else [])
