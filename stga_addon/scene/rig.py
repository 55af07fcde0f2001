"""FLAME as a Blender rig whose mesh is FLAME's own forward pass, on the tracked frames and for any pose set by hand.

Expression coefficients are shape keys, joint rotations are pose bones, pose correctives are shape keys driven by the
bones, and linear blend skinning is the armature modifier. FLAME regresses its joints from the *shaped* vertices, so an
expression moves the point a joint turns about by d = D·expr, which a bone's rest position cannot. A bone whose joint
moves therefore hangs on a hidden bone `<name>_joint`, driven to d, and carries a hidden bone `<name>_deform`, driven to
-d, which the vertices follow. All drivers are arithmetic, which Blender evaluates without Python.
"""

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ..flame.forward import FlameFrame, joint_positions, shaped_vertices
from ..flame.model import JOINTS, FlameModel
from ..flame.sequence import FlameSequence
from . import compat, tags
from .hierarchy import Warn, leave_edit_mode, log_warning, place, remove

SLIDER = 10.0  # the widest range a shape key's value can have
BONE_LENGTH = 0.03  # metres; only how long the bones are drawn
NEGLIGIBLE = 1e-6  # metres a joint may be off along an axis when all sliders are at their ends
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
    all_expressions: bool = False,
) -> Any:
    """Rig and animate `head`, the mesh object of the sequence's neutral mesh; returns the armature object.

    head has its "Basis" shape key; frames: the sequence's frames, one a timestep. Expression keys `expr_000`… are made
    for the components the sequence uses, or for all. The evaluated mesh equals `flame_forward` within 1e-5 m. Vertex
    offsets that change by frame have no rig: they become one shape key a timestep, which `warn` is told, as it is of
    coefficients beyond ±10.
    """
    model = sequence.model
    basis = shaped_vertices(model, sequence.shape, np.zeros(model.n_expression), sequence.static_offset)
    expressions = np.stack([frame.expr for frame in frames])
    components = np.arange(model.n_expression) if all_expressions else np.flatnonzero(expressions.any(axis=0))
    directions = _joint_directions(model, components)
    has_offsets = any(frame.dynamic_offset is not None for frame in frames)
    moving = [has_offsets or any(terms for terms in _terms(direction)) for direction in directions]
    rig = _place_armature(head, joint_positions(model, basis), model.parents, moving)
    _skin(head, rig, model.weights, moving)
    _add_expression_keys(head, sequence, components, basis, expressions[:, components], warn)
    _add_pose_keys(head, rig, model, basis)
    _animate_bones(rig, sequence.timesteps, frames)
    if has_offsets:
        _add_offset_keys(head, sequence, frames, basis, warn)
        _animate_offset_joints(rig, sequence, frames)
    for joint in np.flatnonzero(moving).tolist():
        _drive_joint(head, rig, joint, components, directions[joint])
    return rig


def remove_rig(head: Any) -> None:
    """Remove the rig of `head` and the modifiers that bind the head to it, where it has one."""
    rigs = _rigs(head)
    for modifier in [old for old in head.modifiers if old.type == "ARMATURE" and old.object in rigs]:
        head.modifiers.remove(modifier)
    remove(rigs)


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
        chain = [_joint_bone(bone), bone, _deform_bone(joint, moving)] if moving[joint] else [bone]
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


def _joint_bone(name: str) -> str:
    return f"{name}_joint"


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


def _expression_name(component: int) -> str:
    return f"expr_{component:03d}"


def _add_expression_keys(
    head: Any,
    sequence: FlameSequence,
    components: np.ndarray,
    basis: np.ndarray,
    values: np.ndarray,
    warn: Warn,
) -> None:
    """values (T, K) of the K components."""
    model = sequence.model
    for component in components.tolist():
        direction = model.shapedirs[:, :, model.n_identity + component]
        _new_key(head, _expression_name(component), basis + direction, SLIDER)
    curves = compat.action_curves(head.data.shape_keys)
    frames = np.asarray(sequence.timesteps)
    for component, column in zip(components.tolist(), values.T, strict=True):
        compat.write_curve(curves, _value_path(_expression_name(component)), 0, frames, column)
    row, column = np.unravel_index(np.abs(values).argmax(), values.shape) if values.size else (0, 0)
    if values.size and abs(values[row, column]) > SLIDER:
        warn(
            f"{head.name}: expr {components[column]} is {values[row, column]:.1f} at timestep {frames[row]}; Blender's"
            f" shape keys end at ±{SLIDER:g}, so the mesh differs from the tracked one there"
        )


def _add_pose_keys(head: Any, rig: Any, model: FlameModel, basis: np.ndarray) -> None:
    """FLAME's 36 pose correctives: each is driven by one entry of one joint's rotation minus identity."""
    for feature in range(model.posedirs.shape[2]):
        joint, entry = divmod(feature, 9)
        bone, row, column = JOINTS[1 + joint], *divmod(entry, 3)
        name = f"pose_{bone}_{row}{column}"
        _new_key(head, name, basis + model.posedirs[:, :, feature], 2.0)
        expression = f"2*({ROTATION_MINUS_IDENTITY[row][column]})/{NORM}"
        compat.add_driver(head.data.shape_keys, _value_path(name), -1, expression, _rotation_of(rig, bone))


def _add_offset_keys(
    head: Any, sequence: FlameSequence, frames: Sequence[FlameFrame], basis: np.ndarray, warn: Warn
) -> None:
    warn(
        f"{head.name}: the capture has a dynamic_offset per frame, which no rig describes; it became one shape key per"
        f" timestep ({len(frames)})"
    )
    names = [f"offset_t{timestep:05d}" for timestep in sequence.timesteps]
    for name, frame in zip(names, frames, strict=True):
        _new_key(head, name, basis if frame.dynamic_offset is None else basis + frame.dynamic_offset, 1.0)
    compat.write_hat_curves(head.data.shape_keys, names, sequence.timesteps)


def _animate_bones(rig: Any, timesteps: Sequence[int], frames: Sequence[FlameFrame]) -> None:
    curves = compat.action_curves(rig)
    numbers = np.asarray(timesteps)
    translations = np.stack([frame.translation for frame in frames])
    for axis in range(3):
        compat.write_curve(curves, 'pose.bones["root"].location', axis, numbers, translations[:, axis])
    poses = np.stack([frame.pose for frame in frames])
    for joint, name in enumerate(JOINTS):
        quaternions = _continuous_quaternions(poses[:, joint])
        for element in range(4):
            compat.write_curve(curves, _rotation_path(name), element, numbers, quaternions[:, element])


def _continuous_quaternions(axis_angles: np.ndarray) -> np.ndarray:
    """(T, 4) wxyz of axis-angle (T, 3), with signs such that each step takes the short way."""
    half = np.linalg.norm(axis_angles, axis=1, keepdims=True) / 2
    quaternions = np.hstack([np.cos(half), axis_angles * np.sinc(half / np.pi) / 2])
    flips = np.sign((quaternions[1:] * quaternions[:-1]).sum(1))
    quaternions[1:] *= np.cumprod(np.where(flips < 0, -1.0, 1.0))[:, None]
    return np.asarray(quaternions)


def _joint_directions(model: FlameModel, components: np.ndarray) -> np.ndarray:
    """(5, 3, K): how far each expression component moves each joint."""
    return np.einsum("jv,vck->jck", model.j_regressor, model.shapedirs[:, :, model.n_identity + components])


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


def _animate_offset_joints(rig: Any, sequence: FlameSequence, frames: Sequence[FlameFrame]) -> None:
    """Keyframe how far the per-frame offsets move the joints: three numbers a joint in a property of the rig."""
    offsets = np.zeros((len(frames), len(JOINTS), 3))
    for row, frame in enumerate(frames):
        if frame.dynamic_offset is not None:
            offsets[row] = joint_positions(sequence.model, frame.dynamic_offset)
    curves = compat.action_curves(rig)
    for joint, name in enumerate(JOINTS):
        rig[_offset_property(name)] = [0.0] * 3
        for axis in range(3):
            path, column = f'["{_offset_property(name)}"]', offsets[:, joint, axis]
            compat.write_curve(curves, path, axis, np.asarray(sequence.timesteps), column)


def _drive_joint(head: Any, rig: Any, joint: int, components: np.ndarray, directions: np.ndarray) -> None:
    """Drive a joint's helper bones by directions (3, K) · expression, plus the per-frame offset where there is one.

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
        sources = [(head.data.shape_keys, _value_path(_expression_name(int(components[k])))) for k in terms]
        weighted = zip(directions[axis, terms], TERMS, strict=False)
        expression = "".join(f"{weight:+.4e}*{letter}" for weight, letter in weighted)
        variables = dict(zip(TERMS, sources, strict=False))
        compat.add_driver(rig, f'["{_sum_property(name)}"]', slot, expression, variables)
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
    compat.add_driver(rig, f'pose.bones["{_joint_bone(name)}"].location', axis, total, variables)
    compat.add_driver(rig, f'pose.bones["{name}_deform"].location', axis, f"-({total})", variables)


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
