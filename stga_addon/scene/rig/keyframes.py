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
from ..animation import write_curve, write_triangle_curves
from ..compat import action_curves, copy_action, push_down_action
from ..objects import Warn, log_warning

IDENTITY_SLIDERS = 10
# Prefixes of shape keys; the number after one is the component, or the timestep.
EXPRESSION_KEY, IDENTITY_KEY, OFFSET_KEY = "expr_", "identity_", "offset_t"
EXPRESSION_NAMES = "stga_expressions"
"""Property of a head whose expressions have ARKit's names: these, separated by commas."""
# The joints that each part of a motion (`flame.motion.PARTS`) rotates.
PART_JOINTS = {
    "jaw": ("jaw",),
    "eyes": ("left_eye", "right_eye"),
    "neck": ("neck",),
    "head": ("root",),
}
ROOT_LOCATION = 'pose.bones["root"].location'
identity_key = f"{IDENTITY_KEY}{{:03d}}".format
offset_key = f"{OFFSET_KEY}{{:05d}}".format
# The hidden bones of a joint whose position depends on the sliders: that moves its bone, and that
# its vertices follow.
parent_bone, deform_bone = "{}_joint".format, "{}_deform".format
# Properties of the rig: partial sums of the joint's displacement by the sliders, and that by
# tracked vertex offsets.
sum_property, offset_property = "stga_{}_sums".format, "stga_{}_offset".format
# Data paths of a property, of bones, and of a shape key.
property_path, key_value_path = '["{}"]'.format, 'key_blocks["{}"].value'.format
rotation_path, location_path = (
    'pose.bones["{}"].rotation_quaternion'.format,
    'pose.bones["{}"].location'.format,
)


def expression_key(head: Any, component: int) -> str:
    """The head's shape key of an expression component."""
    named = head.get(EXPRESSION_NAMES)
    return named.split(",")[component] if named else f"{EXPRESSION_KEY}{component:03d}"


def posing_bone(head: Any) -> str:
    """The bone that is turned first: the jaw, or the neck of a head whose jaw is moved by a
    shape."""
    return "neck" if EXPRESSION_NAMES in head else "jaw"


def is_expression_key(name: str) -> bool:
    """Whether a head with a FLAME rig has the shape key for one of its expression components."""
    return name.startswith(EXPRESSION_KEY) or name in ARKIT_SHAPES


def slider_components(model: FlameModel) -> dict[str, int]:
    """Shape key -> component of `model.shapedirs`: every expression, and the first
    `IDENTITY_SLIDERS` of identity."""
    names = model.expression_names or [
        f"{EXPRESSION_KEY}{k:03d}" for k in range(model.n_expression)
    ]
    expressions = {name: model.n_identity + k for k, name in enumerate(names)}
    return expressions | {
        identity_key(k): k for k in range(min(IDENTITY_SLIDERS, model.n_identity))
    }


def offset_keys(head: Any) -> list[Any]:
    """The shape keys that hold tracked per-frame vertex offsets."""
    return [key for key in head.data.shape_keys.key_blocks if key.name.startswith(OFFSET_KEY)]


def is_of_parts(data_path: str, parts: Sequence[str]) -> bool:
    """Whether an f-curve of the rig or the shape keys animates one of the parts
    (`flame.motion.PARTS`)."""
    prefixes = [
        f'pose.bones["{bone}"].rotation_' for part in parts for bone in PART_JOINTS.get(part, ())
    ]
    prefixes += [ROOT_LOCATION] if "head" in parts else []
    # The tracked per-frame offsets belong to the tracked expressions.
    if "expression" in parts:
        prefixes += [f'key_blocks["{EXPRESSION_KEY}', f'key_blocks["{OFFSET_KEY}', '["stga_']
        prefixes += [f'key_blocks["{name}"]' for name in ARKIT_SHAPES]
    return data_path.startswith(tuple(prefixes))


UNCHANGED = 1e-6
"""Change of a slider's value below which it is not keyframed."""
MAX_SLIDER = 10.0
"""The widest range that Blender allows a shape key's value: -10 to 10."""


def key_motion(
    head: Any,
    rig: Any,
    numbers: Sequence[int],
    frames: Sequence[FlameFrame],
    parts: Sequence[str] = tuple(PARTS),
    warn: Warn = log_warning,
) -> None:
    """Add keyframes of the parts (`flame.motion.PARTS`) of `frames` to the active actions of rig
    and shape keys.

    numbers: the Blender frame of each, ascending. A slider that the motion never moves gets a
    single keyframe.
    """
    if "expression" in parts:
        _key_expressions(head, numbers, np.stack([frame.expr for frame in frames]), warn)
    bones = [bone for part in parts for bone in PART_JOINTS.get(part, ())]
    if not bones:
        return
    poses = np.stack([frame.pose for frame in frames])
    for bone in bones:
        key_turns(rig, bone, numbers, poses[:, JOINTS.index(bone)])
    if "head" in parts:
        curves, at = action_curves(rig), np.asarray(numbers)
        translations = np.stack([frame.translation for frame in frames])
        for axis in range(3):
            write_curve(curves, ROOT_LOCATION, axis, at, translations[:, axis])


def key_turns(rig: Any, bone: str, numbers: Sequence[int], turns: np.ndarray) -> None:
    """Add keyframes of a bone's rotation, axis-angle (T, 3), at the frames `numbers` to the rig's
    active action."""
    curves, at = action_curves(rig), np.asarray(numbers)
    for element, values in enumerate(continuous(from_axis_angle(turns)).T):
        write_curve(curves, rotation_path(bone), element, at, values)


def check_keyable(owner: Any, bones: Sequence[str] = ()) -> None:
    """Raise StgaError where keyframes of a data-block, or of rotations of a rig's bones, would have
    no effect."""
    if owner.animation_data is not None and owner.animation_data.use_tweak_mode:
        raise StgaError(f"{owner.name}: is in tweak mode in the NLA editor; leave tweak mode first")
    for name in bones:
        if owner.pose.bones[name].rotation_mode != "QUATERNION":
            raise StgaError(
                f"{owner.name}: the rotation mode of bone {name} must be Quaternion (WXYZ)"
            )


def start_action(owner: Any, name: str, replaces: Callable[[str], bool], as_strip: bool) -> None:
    """Give `owner` a new active action: empty with the old one as a strip, or the old one's copy
    without the curves whose data path is to be replaced."""
    if as_strip:
        push_down_action(owner)
        (owner.animation_data or owner.animation_data_create()).action = bpy.data.actions.new(name)
        return
    curves = copy_action(owner, name)
    for curve in [curve for curve in curves if replaces(curve.data_path)]:
        curves.remove(curve)


def key_tracked_offsets(
    head: Any,
    rig: Any,
    sequence: FlameSequence,
    frames: Sequence[FlameFrame],
    numbers: Sequence[float],
) -> None:
    """Keyframe the tracked per-frame offsets of mesh and joints.

    sequence: the one that the head was imported from, with its frames; numbers: the Blender frame
    of each, ascending.
    """
    write_triangle_curves(
        head.data.shape_keys, [offset_key(timestep) for timestep in sequence.timesteps], numbers
    )
    displacement = np.zeros((len(frames), len(JOINTS), 3))
    for row, frame in enumerate(frames):
        if frame.dynamic_offset is not None:
            displacement[row] = joint_positions(sequence.model, frame.dynamic_offset)
    curves, at = action_curves(rig), np.asarray(numbers)
    for joint, name in enumerate(JOINTS):
        for axis in range(3):
            write_curve(
                curves, property_path(offset_property(name)), axis, at, displacement[:, joint, axis]
            )


def key_zero_offsets(head: Any, rig: Any, frame: int) -> None:
    """Keyframe the tracked per-frame offsets of mesh and joints, where there are any, to zero from
    `frame` on."""
    at, zero = np.array([frame]), np.zeros(1)
    for key in offset_keys(head):
        write_curve(action_curves(head.data.shape_keys), key_value_path(key.name), 0, at, zero)
    for joint in JOINTS:
        if offset_property(joint) in rig:
            for axis in range(3):
                write_curve(
                    action_curves(rig), property_path(offset_property(joint)), axis, at, zero
                )


def key_current_pose(head: Any, rig: Any, frame: int) -> None:
    """Keyframe the pose and expression that the head has now, set by hand or not, at `frame`
    alone."""
    for bone in JOINTS:
        rig.pose.bones[bone].keyframe_insert("rotation_quaternion", frame=frame)
    rig.pose.bones["root"].keyframe_insert("location", frame=frame)
    for curve in action_curves(head.data.shape_keys):
        name = curve.data_path.partition('"')[2].partition('"')[0]
        value, before = head.data.shape_keys.key_blocks[name].value, curve.evaluate(frame)
        if not is_expression_key(name) or abs(value - before) < UNCHANGED:
            continue
        if len(curve.keyframe_points) == 1:  # the motion never moves this slider
            for neighbor in (frame - 1, frame + 1):
                curve.keyframe_points.insert(neighbor, before)
        curve.keyframe_points.insert(frame, value)


def animated_by(head: Any, rig: Any, parts: Sequence[str]) -> list[Any]:
    """The data-blocks in whose actions the parts are keyframed: the rig, the shape keys, or
    both."""
    in_rig = set(parts) & set(PART_JOINTS) or ("expression" in parts and offset_keys(head))
    return ([rig] if in_rig else []) + ([head.data.shape_keys] if "expression" in parts else [])


def _key_expressions(head: Any, numbers: Sequence[int], values: np.ndarray, warn: Warn) -> None:
    """values (T, E), one row per frame in `numbers`."""
    curves, at = action_curves(head.data.shape_keys), np.asarray(numbers)
    for component, column in enumerate(values.T):
        keyed = slice(None) if column.any() else slice(1)
        write_curve(
            curves, key_value_path(expression_key(head, component)), 0, at[keyed], column[keyed]
        )
    row, component = (
        np.unravel_index(np.abs(values).argmax(), values.shape) if values.size else (0, 0)
    )
    if values.size and abs(values[row, component]) > MAX_SLIDER:
        warn(
            f"{head.name}: expression {component} is {values[row, component]:.1f} at frame {at[row]}, but Blender"
            f" limits shape keys to ±{MAX_SLIDER:g}; the mesh differs from the tracked one there"
        )
