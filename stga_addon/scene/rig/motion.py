"""Motion of a FLAME head: applied from another recording, and sampled as it plays in the scene."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import bpy
import numpy as np

from ...errors import StgaError
from ...flame.forward import FlameFrame, flame_forward
from ...flame.model import JOINTS, FlameModel
from ...flame.quaternions import to_axis_angle
from ...flame.sequence import PARTS, FlameSequence
from ..arrays import evaluated_vertices, read_values
from ..compat import push_down_action
from ..objects import Warn, log_warning
from ..timeline import iterate_frames
from .flame_rig import rig_of
from .keyframes import animated_by, check_keyable, key_motion, key_tracked_offsets, key_zero_offsets, start_action
from .names import expression_key, is_expression_key, is_of_parts, offset_keys, parent_bone, slider_components

MESH_TOLERANCE = 1e-4
"""Metres that the mesh in the scene may differ from FLAME's forward pass of the sampled parameters."""


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
    """Animate the chosen parts of a FLAME head by `frames`, one per Blender frame from `start` on.

    The previous animation is kept. As an action, the new one is a copy of the old in which the parts are replaced, and
    the old action stays in the file. As a strip, both are in the NLA editor, and the new one has effect only where it
    lasts. tracked: the sequence that the head was imported from and the Blender frame of each of its timesteps, where
    its per-frame offsets are to play along; without, they stay zero. Raises StgaError where the head has no rig, or
    one that cannot take the motion; nothing is changed then.
    """
    rig = rig_of(head)
    _check_rig(head, rig, frames, parts)
    frames = [replace(frame, expr=_for_all_sliders(head, frame.expr)) for frame in frames]
    owners = animated_by(head, rig, parts)
    for owner in owners:
        start_action(owner, f"{owner.name} {name}", lambda path: is_of_parts(path, parts), as_strip)
    key_motion(head, rig, range(start, start + len(frames)), frames, parts, warn)
    if "expression" in parts and offset_keys(head):
        if tracked is None:
            key_zero_offsets(head, rig, start)
        else:
            sequence, numbers = tracked
            own_frames = [sequence.frame(timestep) for timestep in sequence.timesteps]
            key_tracked_offsets(head, rig, sequence, own_frames, numbers)
    for owner in owners:
        owner.animation_data.action.use_fake_user = True
        if as_strip:
            push_down_action(owner, extrapolation="NOTHING")


def _for_all_sliders(head: Any, expr: np.ndarray) -> np.ndarray:
    """(K,) coefficients of the head's K expression sliders; those that `expr` lacks are zero."""
    count = sum(is_expression_key(key.name) for key in head.data.shape_keys.key_blocks)
    return np.pad(expr[:count], (0, max(0, count - len(expr))))


def _check_rig(head: Any, rig: Any, frames: Sequence[FlameFrame], parts: Sequence[str]) -> None:
    check_keyable(rig, JOINTS)
    check_keyable(head.data.shape_keys)
    used = np.any([frame.expr != 0 for frame in frames], axis=0) if "expression" in parts else np.zeros(0, bool)
    for component in np.flatnonzero(used).tolist():
        if (key := expression_key(head, component)) not in head.data.shape_keys.key_blocks:
            raise StgaError(f"{head.name}: has no slider {key}; import the head again to get all")


def sample_motion(
    head: Any, sequence: FlameSequence, numbers: Iterable[int], warn: Warn = log_warning
) -> FlameSequence:
    """FLAME parameters of the head as animated in the scene, in each of the frames `numbers`: timesteps from 0.

    sequence: the one that the head was imported from, for model and identity; identity sliders are read in the first
    frame. `warn` reports where FLAME's parameters do not reproduce the mesh in the scene: another modifier, a sculpted
    key, a scaled bone. Raises StgaError where the head has no rig.
    """
    rig = rig_of(head)
    frames: list[FlameFrame] = []
    shape, largest_error = sequence.shape, 0.0
    for _ in iterate_frames(numbers):
        frame = _sample_frame(head, rig, sequence.model)
        shape = shape if frames else _identity(head, sequence)
        vertices = flame_forward(sequence.model, shape, frame, sequence.static_offset)
        largest_error = max(largest_error, float(np.abs(vertices - evaluated_vertices(head)).max()))
        frames.append(frame)
    if largest_error > MESH_TOLERANCE:
        warn(
            f"{head.name}: its mesh differs from FLAME's by up to {1000 * largest_error:.1f} mm, because something"
            " that is no FLAME parameter moves it; the exported parameters leave that out"
        )
    return FlameSequence(sequence.model, shape, sequence.static_offset, tuple(range(len(frames))), frames.__getitem__)


def sample_pose(head: Any, model: FlameModel) -> FlameFrame:
    """FLAME parameters of the head as it is posed in the scene now, keyed or not. Raises StgaError without a rig."""
    return _sample_frame(head, rig_of(head), model)


def _sample_frame(head: Any, rig: Any, model: FlameModel) -> FlameFrame:
    bones = rig.evaluated_get(bpy.context.evaluated_depsgraph_get()).pose.bones
    rotations = {name: bones[name].matrix.to_3x3().normalized() for name in JOINTS}
    vectors = {}
    for name, parent in zip(JOINTS, model.parents.tolist(), strict=True):
        local = rotations[name] if parent < 0 else rotations[JOINTS[parent]].transposed() @ rotations[name]
        vectors[name] = to_axis_angle(np.array(local.to_quaternion()))
    root, above = bones["root"], bones.get(parent_bone("root"))
    rest = root.bone.head_local if above is None else above.matrix.translation
    return FlameFrame(
        expr=np.array([_key_value(head, expression_key(head, k)) for k in range(model.n_expression)]),
        rotation=vectors["root"],
        neck_pose=vectors["neck"],
        jaw_pose=vectors["jaw"],
        translation=np.array(root.matrix.translation - rest),
        eyes_pose=np.concatenate([vectors["left_eye"], vectors["right_eye"]]),
        dynamic_offset=_dynamic_offset(head),
    )


def _identity(head: Any, sequence: FlameSequence) -> np.ndarray:
    shape = sequence.shape.copy()
    for name, component in slider_components(sequence.model).items():
        if component < sequence.model.n_identity:
            shape[component] += _key_value(head, name)
    return np.asarray(shape)


def _key_value(head: Any, name: str) -> float:
    key = head.data.shape_keys.key_blocks.get(name)
    return 0.0 if key is None or key.mute else float(key.value)


def _dynamic_offset(head: Any) -> np.ndarray | None:
    """(V, 3) sum of the tracked per-frame offsets at their current values; None where all are zero."""
    total = None
    for key in offset_keys(head):
        value = _key_value(head, key.name)
        if value:
            offset = value * (_key_points(key) - _key_points(key.relative_key))
            total = offset if total is None else total + offset
    return total


def _key_points(key: Any) -> np.ndarray:
    return read_values(key.points, "co", 3).astype(np.float64)
