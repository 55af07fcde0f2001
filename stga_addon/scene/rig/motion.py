"""Motion of a FLAME head: another person's put onto it, and its own as it plays in the scene."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import bpy
import numpy as np

from ...errors import StgaError
from ...flame.forward import FlameFrame, flame_forward
from ...flame.model import JOINTS, FlameModel
from ...flame.motion import PARTS
from ...flame.quaternions import to_axis_angle
from ...flame.sequence import FlameSequence
from .. import compat
from ..arrays import evaluated_vertices
from ..objects import Warn, log_warning
from ..timeline import iterate_frames
from .flame_rig import (
    EXPRESSION_KEY,
    animated_by,
    expression_key,
    is_of_parts,
    joint_bone,
    key_motion,
    key_tracked_offsets,
    key_zero_offsets,
    offset_keys,
    rig_of,
    slider_components,
)

SAME_MESH = 1e-4  # metres that the mesh in the scene may be off from what FLAME makes of its parameters


def apply_motion(
    head: Any,
    frames: Sequence[FlameFrame],
    start: int,
    name: str,
    parts: Sequence[str] = tuple(PARTS),
    as_strip: bool = False,
    warn: Warn = log_warning,
    tracked: tuple[FlameSequence, Sequence[float]] | None = None,
) -> None:
    """Animate the chosen parts of a FLAME head by `frames`, one a Blender frame from `start` on.

    What moved it before is not lost. As an action, the new one is a copy of the old in which the parts are exchanged,
    and the old action stays in the file. As a strip, both lie in the NLA editor, and the new one counts only where it
    lasts. tracked: the sequence that the head was imported from, and the Blender frame of each of its timesteps, where
    its per-frame offsets are to play along; they stay zero without. Raises StgaError where the head has no rig, or one
    that cannot take the motion; nothing is changed then.
    """
    rig = rig_of(head)
    _require_fitting(head, rig, frames, parts)
    frames = [replace(frame, expr=_for_all_sliders(head, frame.expr)) for frame in frames]
    owners = animated_by(head, rig, parts)
    for owner in owners:
        title = f"{owner.name} {name}"
        if as_strip:
            compat.push_down_action(owner)
            (owner.animation_data or owner.animation_data_create()).action = bpy.data.actions.new(title)
        else:
            curves = compat.copy_action(owner, title)
            for curve in [curve for curve in curves if is_of_parts(curve.data_path, parts)]:
                curves.remove(curve)
    key_motion(head, rig, range(start, start + len(frames)), frames, parts, warn)
    if "expression" in parts and offset_keys(head):
        if tracked is None:
            key_zero_offsets(head, rig, start)
        else:
            own, numbers = tracked
            key_tracked_offsets(head, rig, own, [own.frame(timestep) for timestep in own.timesteps], numbers)
    for owner in owners:
        owner.animation_data.action.use_fake_user = True
        if as_strip:
            compat.push_down_action(owner, extrapolation="NOTHING")


def _for_all_sliders(head: Any, expr: np.ndarray) -> np.ndarray:
    """(K,) coefficients of the head's K expression sliders: a model with fewer leaves the others at zero."""
    count = sum(key.name.startswith(EXPRESSION_KEY) for key in head.data.shape_keys.key_blocks)
    return np.pad(expr[:count], (0, max(0, count - len(expr))))


def _require_fitting(head: Any, rig: Any, frames: Sequence[FlameFrame], parts: Sequence[str]) -> None:
    for owner in (rig, head.data.shape_keys):
        if owner.animation_data is not None and owner.animation_data.use_tweak_mode:
            raise StgaError(f"{owner.name}: is being tweaked in the NLA editor; leave tweak mode first")
    for name in JOINTS:
        if rig.pose.bones[name].rotation_mode != "QUATERNION":
            raise StgaError(
                f"{rig.name}: the rotation mode of bone {name} is not Quaternion (WXYZ), which the rig needs"
            )
    used = np.any([frame.expr != 0 for frame in frames], axis=0) if "expression" in parts else np.zeros(0, bool)
    for component in np.flatnonzero(used).tolist():
        if expression_key(component) not in head.data.shape_keys.key_blocks:
            raise StgaError(f"{head.name}: has no slider {expression_key(component)}; import the head again to get all")


def sample_motion(head: Any, own: FlameSequence, numbers: Iterable[int], warn: Warn = log_warning) -> FlameSequence:
    """What a FLAME head does in the scene, by hand or not, in each of the frames `numbers`: timesteps from 0.

    own: the sequence that it was imported from, for model and identity; identity sliders count as they stand in the
    first frame. `warn` hears where FLAME's parameters do not make the mesh that the scene shows: another modifier, a
    sculpted key, a scaled bone. Raises StgaError where the head has no rig.
    """
    rig = rig_of(head)
    frames: list[FlameFrame] = []
    shape, worst = own.shape, 0.0
    for _ in iterate_frames(numbers):
        frame = _performed_frame(head, rig, own.model)
        shape = shape if frames else _identity(head, own)
        made = flame_forward(own.model, shape, frame, own.static_offset)
        worst = max(worst, float(np.abs(made - evaluated_vertices(head)).max()))
        frames.append(frame)
    if worst > SAME_MESH:
        warn(
            f"{head.name}: something that FLAME has no parameter for moves its mesh too, by up to {1000 * worst:.1f}"
            " mm; the parameters leave that out"
        )
    return FlameSequence(own.model, shape, own.static_offset, tuple(range(len(frames))), frames.__getitem__)


def _performed_frame(head: Any, rig: Any, model: FlameModel) -> FlameFrame:
    bones = rig.evaluated_get(bpy.context.evaluated_depsgraph_get()).pose.bones
    turns = {name: bones[name].matrix.to_3x3().normalized() for name in JOINTS}
    vectors = {}
    for joint, parent in enumerate(model.parents.tolist()):
        turn = turns[JOINTS[joint]] if parent < 0 else turns[JOINTS[parent]].transposed() @ turns[JOINTS[joint]]
        vectors[JOINTS[joint]] = to_axis_angle(np.array(turn.to_quaternion()))
    root = bones["root"]
    above = bones.get(joint_bone("root"))
    rest = root.bone.head_local if above is None else above.matrix.translation
    return FlameFrame(
        expr=np.array([_value(head, expression_key(k)) for k in range(model.n_expression)]),
        rotation=vectors["root"],
        neck_pose=vectors["neck"],
        jaw_pose=vectors["jaw"],
        translation=np.array(root.matrix.translation - rest),
        eyes_pose=np.concatenate([vectors["left_eye"], vectors["right_eye"]]),
        dynamic_offset=_offset(head),
    )


def _identity(head: Any, own: FlameSequence) -> np.ndarray:
    sliders = {name: k for name, k in slider_components(own.model).items() if k < own.model.n_identity}
    shape = own.shape.copy()
    for name, component in sliders.items():
        shape[component] += _value(head, name)
    return np.asarray(shape)


def _value(head: Any, name: str) -> float:
    key = head.data.shape_keys.key_blocks.get(name)
    return 0.0 if key is None or key.mute else float(key.value)


def _offset(head: Any) -> np.ndarray | None:
    """(V, 3) of the keys that hold the tracked per-frame offsets, as they stand; None without any."""
    total = None
    for key in offset_keys(head):
        if _value(head, key.name):
            moved = _value(head, key.name) * (_points(key) - _points(key.relative_key))
            total = moved if total is None else total + moved
    return total


def _points(key: Any) -> np.ndarray:
    points = np.empty(3 * len(key.points), np.float32)
    key.points.foreach_get("co", points)
    return points.reshape(-1, 3).astype(np.float64)
