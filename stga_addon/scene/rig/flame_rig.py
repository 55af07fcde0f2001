"""FLAME as a Blender rig whose mesh is FLAME's own forward pass, on the tracked frames and for any pose set by hand.

Expression coefficients are shape keys, joint rotations are pose bones, pose correctives are shape keys driven by the
bones, and linear blend skinning is the armature modifier. The first identity components are shape keys too, counted
from the person who was tracked: with all of them at zero the head is that person's.

FLAME regresses its joints from the *shaped* vertices, so a slider moves the point a joint turns about by d = D·sliders,
which a bone's rest position cannot. A bone whose joint moves therefore hangs on a hidden bone `<name>_joint`, driven to
d, and carries a hidden bone `<name>_deform`, driven to -d, which the vertices follow. All drivers are arithmetic, which
Blender evaluates without Python.
"""

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...errors import StgaError
from ...flame.forward import FlameFrame, joint_positions, shaped_vertices
from ...flame.model import JOINTS, FlameModel
from ...flame.motion import PARTS
from ...flame.quaternions import continuous, from_axis_angle
from ...flame.sequence import MIN_JOINT_ANGLE_DEG, FlameSequence, joint_angles
from .. import compat, tags
from ..animation import add_driver, write_curve, write_triangle_curves
from ..objects import Warn, leave_edit_mode, log_warning, place, remove

IDENTITY_SLIDERS = 10
PART_JOINTS = {"jaw": ("jaw",), "eyes": ("left_eye", "right_eye"), "neck": ("neck",), "head": ("root",)}
SLIDER = 10.0  # the widest range a shape key's value can have
BONE_LENGTH = 0.03  # metres; only how long the bones are drawn
NEGLIGIBLE = 1e-6  # metres a joint may be off along an axis when all sliders are at their ends
# Starts of shape keys' names; the number behind is the column in a parameter file, or the timestep.
EXPRESSION_KEY, IDENTITY_KEY, OFFSET_KEY = "expr_", "identity_", "offset_t"
ROOT_LOCATION = 'pose.bones["root"].location'
QUATERNION = ("w", "x", "y", "z")
NORM = "(w*w+x*x+y*y+z*z)"  # keyed quaternions interpolate unnormalised
# (rotation - identity) / 2 as quadratic forms of the quaternion, row by row.
ROTATION_MINUS_IDENTITY = (
    ("-y*y-z*z", "x*y-w*z", "x*z+w*y"),
    ("x*y+w*z", "-x*x-z*z", "y*z-w*x"),
    ("x*z-w*y", "y*z+w*x", "-x*x-y*y"),
)
# Names of a driver's variables: one a term, few enough that the expression stays under Blender's 255 characters.
TERMS = "abcdfghijklmnopqrs"


def add_rig(
    head: Any,
    sequence: FlameSequence,
    frames: Sequence[FlameFrame],
    warn: Warn = log_warning,
    correctives: str = "all",
) -> Any:
    """Rig and animate `head`, the mesh object of the sequence's neutral mesh; returns the armature object.

    head has its "Basis" shape key; frames: the sequence's frames, one a timestep. The evaluated mesh equals
    `flame_forward` within 1e-5 m. Vertex offsets that change by frame have no rig: they become one shape key a
    timestep, which `warn` is told, as it is of coefficients beyond ±10. correctives: "all", or "moving" for the shape
    keys and drivers of those joints only that turn in the frames.
    """
    model = sequence.model
    basis = shaped_vertices(model, sequence.shape, np.zeros(model.n_expression), sequence.static_offset)
    sliders = slider_components(model)
    directions = _joint_directions(model, list(sliders.values()))
    has_offsets = any(frame.dynamic_offset is not None for frame in frames)
    moving = [has_offsets or any(terms for terms in _terms(direction)) for direction in directions]
    _remove_bone_groups(head, _rigs(head))
    rig = _place_armature(head, joint_positions(model, basis), model.parents, moving)
    _skin(head, rig, model.weights, moving)
    for name, component in sliders.items():
        _new_key(head, name, basis + model.shapedirs[:, :, component], SLIDER)
    _add_pose_keys(
        head,
        rig,
        model,
        basis,
        np.ones(len(JOINTS), bool) if correctives == "all" else joint_angles(frames) > MIN_JOINT_ANGLE_DEG,
    )
    key_motion(head, rig, sequence.timesteps, frames, warn=warn)
    if has_offsets:
        _add_offset_keys(head, rig, sequence, frames, basis, warn)
        key_tracked_offsets(head, rig, sequence, frames, sequence.timesteps)
    for joint in np.flatnonzero(moving).tolist():
        _drive_joint(head, rig, joint, list(sliders), directions[joint])
    return rig


def slider_components(model: FlameModel) -> dict[str, int]:
    """Shape key -> component of `model.shapedirs`: every expression, and the first `IDENTITY_SLIDERS` of identity."""
    expressions = {expression_key(k): model.n_identity + k for k in range(model.n_expression)}
    return expressions | {identity_key(k): k for k in range(min(IDENTITY_SLIDERS, model.n_identity))}


def expression_key(component: int) -> str:
    return f"{EXPRESSION_KEY}{component:03d}"


def identity_key(component: int) -> str:
    return f"{IDENTITY_KEY}{component:03d}"


def joint_bone(name: str) -> str:
    """The hidden bone that carries a bone whose joint moves with the sliders."""
    return f"{name}_joint"


def key_motion(
    head: Any,
    rig: Any,
    numbers: Sequence[int],
    frames: Sequence[FlameFrame],
    parts: Sequence[str] = tuple(PARTS),
    warn: Warn = log_warning,
) -> None:
    """Add keyframes of the parts (`flame.motion.PARTS`) of `frames` to the active actions of rig and shape keys.

    numbers: the Blender frame of each, ascending. A slider that the motion never moves gets a single keyframe.
    """
    if "expression" in parts:
        _key_expressions(head, numbers, np.stack([frame.expr for frame in frames]), warn)
    bones = [bone for part in parts for bone in PART_JOINTS.get(part, ())]
    if not bones:
        return
    curves, at = compat.action_curves(rig), np.asarray(numbers)
    poses = np.stack([frame.pose for frame in frames])
    for bone in bones:
        quaternions = continuous(from_axis_angle(poses[:, JOINTS.index(bone)]))
        for element in range(4):
            write_curve(curves, _rotation_path(bone), element, at, quaternions[:, element])
    if "head" in parts:
        translations = np.stack([frame.translation for frame in frames])
        for axis in range(3):
            write_curve(curves, ROOT_LOCATION, axis, at, translations[:, axis])


def is_of_parts(data_path: str, parts: Sequence[str]) -> bool:
    """Whether an f-curve of the rig or the shape keys animates one of the parts (`flame.motion.PARTS`)."""
    starts = [f'pose.bones["{bone}"].rotation_' for part in parts for bone in PART_JOINTS.get(part, ())]
    starts += [ROOT_LOCATION] if "head" in parts else []
    # The offsets of the tracked frames belong to the expressions that were tracked.
    starts += [f'key_blocks["{EXPRESSION_KEY}', f'key_blocks["{OFFSET_KEY}', '["stga_'] if "expression" in parts else []
    return data_path.startswith(tuple(starts))


def animated_by(head: Any, rig: Any, parts: Sequence[str]) -> list[Any]:
    """The data-blocks in whose actions the parts are keyframed: the rig, the shape keys, or both."""
    bones = set(parts) & set(PART_JOINTS) or ("expression" in parts and offset_keys(head))
    return ([rig] if bones else []) + ([head.data.shape_keys] if "expression" in parts else [])


def key_tracked_offsets(
    head: Any, rig: Any, sequence: FlameSequence, frames: Sequence[FlameFrame], numbers: Sequence[float]
) -> None:
    """Keyframe the per-frame offsets of mesh and joints as they were tracked.

    sequence: the one that the head was imported from, with its frames; numbers: the Blender frame of each, ascending.
    """
    names = [f"{OFFSET_KEY}{timestep:05d}" for timestep in sequence.timesteps]
    write_triangle_curves(head.data.shape_keys, names, numbers)
    moved = np.zeros((len(frames), len(JOINTS), 3))
    for row, frame in enumerate(frames):
        if frame.dynamic_offset is not None:
            moved[row] = joint_positions(sequence.model, frame.dynamic_offset)
    curves, at = compat.action_curves(rig), np.asarray(numbers)
    for joint, name in enumerate(JOINTS):
        for axis in range(3):
            write_curve(curves, f'["{_offset_property(name)}"]', axis, at, moved[:, joint, axis])


def key_zero_offsets(head: Any, rig: Any, frame: int) -> None:
    """Keyframe the tracked per-frame offsets of mesh and joints, where there are any, to stay zero."""
    at, nothing = np.array([frame]), np.zeros(1)
    for key in offset_keys(head):
        write_curve(compat.action_curves(head.data.shape_keys), _value_path(key.name), 0, at, nothing)
    for bone in JOINTS:
        for axis in range(3) if _offset_property(bone) in rig else ():
            write_curve(compat.action_curves(rig), f'["{_offset_property(bone)}"]', axis, at, nothing)


def offset_keys(head: Any) -> list[Any]:
    """The shape keys that hold tracked per-frame offsets."""
    return [key for key in head.data.shape_keys.key_blocks if key.name.startswith(OFFSET_KEY)]


def rig_of(head: Any) -> Any:
    """The armature object that moves `head`. Raises StgaError where it has no FLAME rig."""
    for modifier in head.modifiers:
        if modifier.type == "ARMATURE" and modifier.object is not None and modifier.object.get(tags.KIND) == tags.RIG:
            return modifier.object
    raise StgaError(
        f"{head.name}: has no FLAME rig, because it was not imported from parameters of FLAME; its splats follow "
        "whatever moves its mesh (shape keys, modifiers, a mesh cache)"
    )


def remove_rig(head: Any) -> None:
    """Remove the rig of `head` and the modifiers that bind the head to it, where it has one."""
    rigs = _rigs(head)
    _remove_bone_groups(head, rigs)
    for modifier in [old for old in head.modifiers if old.type == "ARMATURE" and old.object in rigs]:
        head.modifiers.remove(modifier)
    remove(rigs)


def _remove_bone_groups(head: Any, rigs: Sequence[Any]) -> None:
    bones = {bone.name for rig in rigs for bone in rig.data.bones}
    for group in reversed([group for group in head.vertex_groups if group.name in bones]):
        head.vertex_groups.remove(group)


def _rigs(head: Any) -> list[Any]:
    return [thing for thing in head.parent.children if thing.get(tags.KIND) == tags.RIG]


def _place_armature(head: Any, joints: np.ndarray, parents: np.ndarray, moving: Sequence[bool]) -> Any:
    root = head.parent
    title = f"{root.name} rig"
    rig = place(root, tags.RIG, title, _armature(title, joints, parents, moving), next(iter(_rigs(head)), None))
    rig.show_in_front = True
    bpy.context.view_layer.update()  # makes the pose bones
    for name in JOINTS:  # an earlier import's
        rig.pop(_sum_property(name), None)
        rig.pop(_offset_property(name), None)
    for bone in rig.pose.bones:
        bone.matrix_basis = Matrix()
    for joint, name in enumerate(JOINTS):
        bone = rig.pose.bones[name]
        bone.rotation_mode = "QUATERNION"
        bone.lock_location = [joint > 0] * 3
    return rig


def _armature(name: str, joints: np.ndarray, parents: np.ndarray, moving: Sequence[bool]) -> Any:
    armature = bpy.data.armatures.new(name)
    editing = bpy.data.objects.new(name, armature)  # edit mode needs an object that is surely visible
    layer = bpy.context.view_layer
    active = layer.objects.active
    leave_edit_mode()
    bpy.context.scene.collection.objects.link(editing)
    layer.objects.active = editing
    bpy.ops.object.mode_set(mode="EDIT")
    for joint, (bone, parent) in enumerate(zip(JOINTS, parents.tolist(), strict=True)):
        above = _deform_bone(parent, moving) if parent >= 0 else None
        chain = [joint_bone(bone), bone, _deform_bone(joint, moving)] if moving[joint] else [bone]
        for link in chain:
            _edit_bone(armature, link, above, joints[joint].tolist())
            above = link
    bpy.ops.object.mode_set(mode="OBJECT")
    layer.objects.active = active
    bpy.data.objects.remove(editing)
    _hide_helpers(armature)
    return armature


def _edit_bone(armature: Any, name: str, parent: str | None, head: Sequence[float]) -> None:
    """A bone along +Y without roll has the identity as rest orientation: its rotation is FLAME's own."""
    bone = armature.edit_bones.new(name)
    bone.head, bone.tail, bone.roll = head, (head[0], head[1] + BONE_LENGTH, head[2]), 0.0
    bone.parent = armature.edit_bones[parent] if parent else None


def _hide_helpers(armature: Any) -> None:
    shown, hidden = armature.collections.new("Joints"), armature.collections.new("Helpers")
    hidden.is_visible = False
    for bone in armature.bones:
        (shown if bone.name in JOINTS else hidden).assign(bone)


def _deform_bone(joint: int, moving: Sequence[bool]) -> str:
    return f"{JOINTS[joint]}_deform" if moving[joint] else JOINTS[joint]


def _skin(head: Any, rig: Any, weights: np.ndarray, moving: Sequence[bool]) -> None:
    for joint, column in enumerate(weights.T):
        group = head.vertex_groups.new(name=_deform_bone(joint, moving))
        for vertex in np.flatnonzero(column).tolist():
            group.add([vertex], column[vertex], "REPLACE")
    modifier = next((old for old in head.modifiers if old.type == "ARMATURE" and old.object == rig), None)
    modifier = modifier or head.modifiers.new(rig.name, "ARMATURE")
    modifier.object = rig
    modifier.use_vertex_groups, modifier.use_bone_envelopes = True, False
    modifier.use_deform_preserve_volume = False


def _new_key(head: Any, name: str, vertices: np.ndarray, limit: float) -> None:
    key = head.shape_key_add(name=name, from_mix=False)
    key.points.foreach_set("co", vertices.astype(np.float32).ravel())
    key.slider_min, key.slider_max = -limit, limit
    key.value = 0.0  # a key made from a script starts at 1


def _key_expressions(head: Any, numbers: Sequence[int], values: np.ndarray, warn: Warn) -> None:
    """values (T, E), one a frame in `numbers`."""
    curves, at = compat.action_curves(head.data.shape_keys), np.asarray(numbers)
    for component, column in enumerate(values.T):
        keyed = slice(None) if column.any() else slice(1)
        write_curve(curves, _value_path(expression_key(component)), 0, at[keyed], column[keyed])
    row, component = np.unravel_index(np.abs(values).argmax(), values.shape) if values.size else (0, 0)
    if values.size and abs(values[row, component]) > SLIDER:
        warn(
            f"{head.name}: expr {component} is {values[row, component]:.1f} at frame {at[row]}; Blender's"
            f" shape keys end at ±{SLIDER:g}, so the mesh differs from the tracked one there"
        )


def _add_pose_keys(head: Any, rig: Any, model: FlameModel, basis: np.ndarray, wanted: np.ndarray) -> None:
    """FLAME's pose correctives, nine a joint: each is driven by one entry of the joint's rotation minus identity.

    wanted (5,) bool: joints that get theirs.
    """
    for feature in range(model.posedirs.shape[2]):
        joint, entry = divmod(feature, 9)
        if not wanted[1 + joint]:
            continue
        bone, row, column = JOINTS[1 + joint], *divmod(entry, 3)
        name = f"pose_{bone}_{row}{column}"
        _new_key(head, name, basis + model.posedirs[:, :, feature], 2.0)
        expression = f"2*({ROTATION_MINUS_IDENTITY[row][column]})/{NORM}"
        add_driver(head.data.shape_keys, _value_path(name), -1, expression, _rotation_of(rig, bone))


def _add_offset_keys(
    head: Any, rig: Any, sequence: FlameSequence, frames: Sequence[FlameFrame], basis: np.ndarray, warn: Warn
) -> None:
    warn(
        f"{head.name}: the capture has a dynamic_offset per frame, which no rig describes; it became one shape key per"
        f" timestep ({len(frames)})"
    )
    for timestep, frame in zip(sequence.timesteps, frames, strict=True):
        moved = basis if frame.dynamic_offset is None else basis + frame.dynamic_offset
        _new_key(head, f"{OFFSET_KEY}{timestep:05d}", moved, 1.0)
    for name in JOINTS:
        rig[_offset_property(name)] = [0.0] * 3


def _joint_directions(model: FlameModel, components: Sequence[int]) -> np.ndarray:
    """(5, 3, K): how far each component of the shape moves each joint."""
    return np.einsum("jv,vck->jck", model.j_regressor, model.shapedirs[:, :, components])


def _terms(directions: np.ndarray) -> list[list[int]]:
    """Per axis, the columns of directions (3, K) that matter.

    The smallest are left out, as long as all of them together stay negligible with the sliders at their ends.
    """
    kept = []
    for coefficients in np.abs(directions):
        order = np.argsort(coefficients)
        reach = np.cumsum(coefficients[order]) * SLIDER
        kept.append(sorted(order[reach > NEGLIGIBLE].tolist()))
    return kept


def _drive_joint(head: Any, rig: Any, joint: int, sliders: Sequence[str], directions: np.ndarray) -> None:
    """Drive a joint's helper bones by directions (3, K) · sliders, plus the per-frame offset where there is one.

    Blender's expressions are short, so the sum is taken in two stages; the first stands in a property of the rig.
    """
    name = JOINTS[joint]
    parts = [
        (axis, terms[start : start + len(TERMS)])
        for axis, terms in enumerate(_terms(directions))
        for start in range(0, len(terms), len(TERMS))
    ]
    if parts:
        rig[_sum_property(name)] = [0.0] * len(parts)
    for slot, (axis, terms) in enumerate(parts):
        sources = [(head.data.shape_keys, _value_path(sliders[k])) for k in terms]
        weighted = zip(directions[axis, terms], TERMS, strict=False)
        expression = "".join(f"{weight:+.5e}*{letter}" for weight, letter in weighted)
        variables = dict(zip(TERMS, sources, strict=False))
        add_driver(rig, f'["{_sum_property(name)}"]', slot, expression, variables)
    for axis in range(3):
        paths = [f'["{_sum_property(name)}"][{slot}]' for slot, (of_axis, _) in enumerate(parts) if of_axis == axis]
        if _offset_property(name) in rig:
            paths.append(f'["{_offset_property(name)}"][{axis}]')
        if paths:
            _drive_helpers(rig, joint, axis, paths)


def _drive_helpers(rig: Any, joint: int, axis: int, paths: Sequence[str]) -> None:
    variables = {letter: (rig, path) for letter, path in zip(TERMS, paths, strict=False)}
    total = "+".join(variables)
    name = JOINTS[joint]
    add_driver(rig, f'pose.bones["{joint_bone(name)}"].location', axis, total, variables)
    add_driver(rig, f'pose.bones["{name}_deform"].location', axis, f"-({total})", variables)


def _sum_property(bone: str) -> str:
    return f"stga_{bone}_sums"


def _offset_property(bone: str) -> str:
    return f"stga_{bone}_offset"


def _rotation_path(bone: str) -> str:
    return f'pose.bones["{bone}"].rotation_quaternion'


def _rotation_of(rig: Any, bone: str) -> dict[str, tuple[Any, str]]:
    return {letter: (rig, f"{_rotation_path(bone)}[{element}]") for element, letter in enumerate(QUATERNION)}


def _value_path(key: str) -> str:
    return f'key_blocks["{key}"].value'
