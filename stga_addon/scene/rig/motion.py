"""Motion of a FLAME head: applied, sampled, set live, and compared with its training."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...driving.head_map import features
from ...driving.open_motion import PART_FIELDS, TrainedRange, outside
from ...driving.performance import ARKIT_SHAPES, COLUMN
from ...flame.forward import FlameFrame, flame_forward
from ...flame.model import JOINTS, FlameModel
from ...flame.quaternions import from_axis_angle, multiply, to_axis_angle
from ...flame.sequence import FlameSequence
from ..arrays import head_vertices, key_points, read_values, write_curves
from ..evaluation import evaluated, kept_evaluated
from ..objects import Identity, Warn, iterate_frames, log_warning
from . import keyframes
from .head import rig_of, usable_rig
from .keyframes import Placement

MESH_TOLERANCE = 1e-4  # metres that the mesh may differ from FLAME's of the sampled parameters


def apply_motion(
    head: Any,
    frames: Sequence[FlameFrame],
    placement: Placement,
    tracked: tuple[FlameSequence, Sequence[float]] | None = None,
    weights: np.ndarray | None = None,
    warn: Warn = log_warning,
) -> None:
    """Animate parts of a FLAME head by `frames`, one per Blender frame. The previous animation is
    kept. tracked: the sequence that the head was imported from and the Blender frame of each
    timestep, where its per-frame offsets are to play along. weights: (T, 52) of ARKit's shapes, on
    a head that was given them. Without, both stay zero. Raises StgaError, and changes nothing,
    where the head has no rig, or one that cannot take the motion."""
    parts = placement.parts
    rig = usable_rig(head)
    keyframes.check_keyable(rig)
    keyframes.check_keyable(head.data.shape_keys)
    expr = np.stack([frame.expr for frame in frames])
    if "expression" in parts:
        keyframes.check_sliders(head, expr)
    # Coefficients of the sliders that the motion lacks are zero.
    count = max(expr.shape[1], 1 + max(keyframes.expression_keys(head), default=-1))
    expr = np.pad(expr, ((0, 0), (0, count - expr.shape[1])))
    frames = [replace(each, expr=row) for each, row in zip(frames, expr, strict=True)]
    keys = head.data.shape_keys

    has_expression = "expression" in parts
    if has_expression and head.data.override_library is not None:
        keyframes.check_ranges(head, expr)
    offsets = keyframes.offset_keys(head) if has_expression else []
    owners = [rig] if offsets or set(parts) & set(keyframes.PART_JOINTS) else []
    owners += [keys] if has_expression else []
    at = placement.start + np.arange(len(frames))
    bones = keyframes.bones_of(parts)
    below = _turns_below(rig, bones, at[[0, -1]]) if placement.as_strip and bones else {}
    with keyframes.new_actions(owners, placement, lambda p: keyframes.is_of_parts(p, parts)):
        keyframes.key_motion(head, rig, at, frames, parts, warn)
        keyframes.choose_signs(rig, below)
        if has_expression and keyframes.has_shapes(head):
            shapes = np.zeros((1, len(ARKIT_SHAPES))) if weights is None else weights
            paths = {column: keyframes.key_value_path(key) for key, column in COLUMN.items()}
            keyframes.key_values(keys, paths, placement.start + np.arange(len(shapes)), shapes)
        if offsets and tracked is not None:
            keyframes.key_tracked_offsets(head, rig, *tracked)
        elif offsets:
            for key in offsets:
                path = keyframes.key_value_path(key.name)
                write_curves(keys, path, [placement.start], np.zeros(1))
            for offset in map(keyframes.offset_property, JOINTS):
                if offset in rig:
                    path = keyframes.property_path(offset)
                    write_curves(rig, path, [placement.start], np.zeros((1, 3)))


def _turns_below(rig: Any, bones: Sequence[str], ends: Iterable[int]) -> dict[str, np.ndarray]:
    """Quaternions (2, 4) of bones, as they are animated at the two ends of a strip to come."""
    found: list[list[tuple[float, ...]]] = []
    for _ in iterate_frames(ends, [rig]):
        posed = evaluated(rig, bpy.context.evaluated_depsgraph_get()).pose.bones
        found.append([tuple(posed[bone].rotation_quaternion) for bone in bones])
    return dict(zip(bones, np.swapaxes(np.array(found), 0, 1), strict=True))


def sample_motion(
    head: Any, sequence: FlameSequence, numbers: Iterable[int], warn: Warn = log_warning
) -> FlameSequence:
    """FLAME parameters of the head as animated in the scene, in each of the frames `numbers`.
    sequence: the one that the head was imported from; identity sliders are read in the first frame.
    `warn` reports where FLAME's parameters do not reproduce the mesh in the scene. Raises StgaError
    where the head has no rig."""
    frames: list[FlameFrame] = []
    shape = sequence.shape.copy()
    largest_error = 0.0
    for _ in iterate_frames(numbers, [head, rig_of(head)]):
        frame = sample_pose(head, sequence.model)
        if not frames:
            for name, component in keyframes.slider_components(sequence.model).items():
                if component < sequence.model.n_identity:
                    shape[component] += _key_value(head, name)
        vertices = flame_forward(sequence.model, shape, frame, sequence.static_offset)
        largest_error = max(largest_error, float(np.abs(vertices - head_vertices(head)).max()))
        frames.append(frame)
    if largest_error > MESH_TOLERANCE:
        warn(
            f"{head.name}: its mesh differs from FLAME's by up to {1000 * largest_error:.1f} mm, "
            "because something that is no FLAME parameter moves it; the exported parameters "
            "leave that out"
        )
    timesteps = tuple(range(len(frames)))
    return replace(sequence, shape=shape, timesteps=timesteps, frame=frames.__getitem__)


def sample_pose(head: Any, model: FlameModel) -> FlameFrame:
    """FLAME parameters of the head as posed now, keyed or not. Raises StgaError without a rig."""
    rig = rig_of(head)
    with kept_evaluated([rig]):
        bones = evaluated(rig, bpy.context.evaluated_depsgraph_get()).pose.bones
        return _sampled(head, bones, model)


def _sampled(head: Any, bones: Any, model: FlameModel) -> FlameFrame:
    rotations = {name: bones[name].matrix.to_3x3().normalized() for name in JOINTS}
    vectors = {}
    for name, parent in zip(JOINTS, model.parents.tolist(), strict=True):
        above = rotations[JOINTS[parent]].transposed() if parent >= 0 else Matrix.Identity(3)
        vectors[name] = to_axis_angle(np.array((above @ rotations[name]).to_quaternion()))
    root = bones["root"]
    above = bones.get(keyframes.parent_bone("root"))
    rest = root.bone.head_local if above is None else above.matrix.translation
    offsets = [
        value * (key_points(key) - key_points(key.relative_key))
        for key in keyframes.offset_keys(head)
        if (value := _key_value(head, key.name))
    ]
    return FlameFrame(
        expr=_expression(head, model.n_expression, vectors),
        rotation=vectors["root"],
        neck_pose=vectors["neck"],
        jaw_pose=vectors["jaw"],
        translation=np.array(root.matrix.translation - rest),
        eyes_pose=np.concatenate([vectors["left_eye"], vectors["right_eye"]]),
        dynamic_offset=np.sum(offsets, axis=0) if offsets else None,
    )


def _expression(head: Any, count: int, turns: dict[str, np.ndarray]) -> np.ndarray:
    """(count,) of the head's sliders, with what ARKit's (`keyframes.add_shapes`) add; turns of jaw
    and eyes are exchanged for those with them."""
    names = [keyframes.expression_key(head, component) for component in range(count)]
    expr = np.array([_key_value(head, name) for name in names])
    if not keyframes.has_shapes(head):
        return expr
    keys = head.data.shape_keys.key_blocks
    weights = np.array([[keys[name].value if name in keys else 0.0 for name in ARKIT_SHAPES]])
    added = features(weights)[0]
    added = added @ np.reshape(head[keyframes.ARKIT_MAP], (len(added), -1))
    for joint, row in zip(("jaw", "left_eye", "right_eye"), (-9, -6, -3), strict=True):
        slider, bone = from_axis_angle(np.array([added[row : row + 3 or None], turns[joint]]))
        turns[joint] = to_axis_angle(multiply(bone, slider))
    return expr + added[:count]


def _key_value(head: Any, name: str) -> float:
    key = head.data.shape_keys.key_blocks.get(name)
    return 0.0 if key is None or key.mute else float(key.value)


LIVE_JOINTS = ("neck", "jaw", "left_eye", "right_eye")
WEIGHT_RANGE = (-1.0, 2.0)


class LivePose:
    """What a head's sliders, bones and controls held before, and how live values are set on them.
    Sliders are known by name: meanwhile they may be moved, removed or added."""

    def __init__(self, head: Any, rig: Any) -> None:
        """rig: the head's FLAME rig; None for a head that has shape keys with ARKit's names."""
        self.head = Identity(head)
        self._rig: Any = None if rig is None else Identity(rig)
        self.takes_frames = rig is not None
        keys = head.data.shape_keys.key_blocks
        # Component, or column of the 52 -> slider
        self._names = keyframes.shape_key_names(head)
        still: list[str] = []
        if rig is not None:
            self._names = keyframes.expression_keys(head)
            bones = rig.pose.bones
            self._turns = {joint: tuple(bones[joint].rotation_quaternion) for joint in LIVE_JOINTS}
            offsets = [name for name in map(keyframes.offset_property, JOINTS) if name in rig]
            self._offsets: dict[str, Any] = {name: tuple(rig[name]) for name in offsets}
            shapes = ARKIT_SHAPES if keyframes.has_shapes(head) else ()
            still = [name for name in shapes if name in keys]
            still += [key.name for key in keyframes.offset_keys(head)]
        self._sliders = {name: keys[name].value for name in (*self._names.values(), *still)}

    @property
    def is_there(self) -> bool:
        """Whether the head, and its rig, are still in the file."""
        head = self.head.find()
        has_rig = self._rig is None or self._rig.find() is not None
        return head is not None and has_rig and getattr(head.data, "shape_keys", None) is not None

    def set_frame(self, frame: FlameFrame) -> None:
        """Pose a FLAME head but for its place; tracked per-frame offsets are switched off."""
        values = dict.fromkeys(self._sliders, 0.0)
        names = self._names.items()
        values |= {name: frame.expr[k] for k, name in names if k < len(frame.expr)}
        self._set_sliders(values)
        turns = [frame.neck_pose, frame.jaw_pose, frame.eyes_pose[:3], frame.eyes_pose[3:]]
        turned = dict(zip(LIVE_JOINTS, from_axis_angle(np.stack(turns)), strict=True))
        self._set_bones(turned, dict.fromkeys(self._offsets, (0.0, 0.0, 0.0)))

    def set_weights(self, weights: Sequence[float] | np.ndarray) -> None:
        """Set the 52 weights on the shape keys of a head without a rig."""
        limited = np.clip(weights, *WEIGHT_RANGE)
        self._set_sliders({name: limited[column] for column, name in self._names.items()})

    def restore(self) -> None:
        """Give back what was there before the first live pose."""
        self._set_sliders(self._sliders)
        if self._rig is not None:
            self._set_bones(self._turns, self._offsets)

    def _set_sliders(self, values: Mapping[str, float]) -> None:
        mesh = self.head.get().data
        blocks = mesh.shape_keys.key_blocks
        held = read_values(blocks, "value", 1)[:, 0]
        lowest = read_values(blocks, "slider_min", 1)[:, 0]
        highest = read_values(blocks, "slider_max", 1)[:, 0]
        for row, name in enumerate(blocks.keys()):
            if name in values:
                held[row] = values[name]
                if not lowest[row] <= held[row] <= highest[row]:
                    keyframes.widen(blocks[row], held[row], held[row])
        blocks.foreach_set("value", held)
        mesh.shape_keys.update_tag()
        mesh.update_tag()

    def _set_bones(self, turns: dict[str, Any], offsets: dict[str, Any]) -> None:
        rig = self._rig.get()
        for joint, quaternion in turns.items():
            rig.pose.bones[joint].rotation_quaternion = quaternion
        for name, value in offsets.items():
            rig[name] = value
        rig.update_tag()


MIRROR = {"left_eye": "right_eye", "right_eye": "left_eye"}
"""Joint -> its counterpart, of those that have one."""


def mirror_pose(head: Any, rig: Any) -> bool:
    """Swap left and right of a head's pose, in its model's axes, x to the left; whether it has
    sliders of both sides."""
    turns = {joint: tuple(rig.pose.bones[joint].rotation_quaternion) for joint in JOINTS}
    for joint in JOINTS:
        w, x, y, z = turns[MIRROR.get(joint, joint)]
        rig.pose.bones[joint].rotation_quaternion = w, x, -y, -z
    rig.pose.bones[JOINTS[0]].location.x *= -1
    blocks = head.data.shape_keys.key_blocks
    names = [name for name in blocks.keys() if "Left" in name]  # noqa: SIM118
    pairs = [(blocks[name], blocks.get(name.replace("Left", "Right"))) for name in names]
    pairs = [pair for pair in pairs if pair[1] is not None]
    for left, right in pairs:
        value = left.value
        left.value = right.value
        right.value = value
    rig.update_tag()
    return bool(pairs)


TRAINED = "stga_trained"  # property of the head: the arrays of a `TrainedRange`, by field and part
FIELDS = ("middle", "width", "quiet", "first")


def store_range(head: Any, trained: TrainedRange) -> None:
    """Keep the range with the head, in its file."""
    head[TRAINED] = {
        f"{field} {part}": getattr(trained, field)[part].astype(float).tolist()
        for field, part in product(FIELDS, PART_FIELDS)
    }


def stored_range(head: Any) -> TrainedRange | None:
    """The range that was kept with the head; None where there is none."""
    kept = head.get(TRAINED)
    names = {f"{field} {part}" for field, part in product(FIELDS, PART_FIELDS)}
    if kept is None or set(kept.keys()) != names:
        return None
    values = {name: np.array(kept[name], np.float64) for name in names}
    return TrainedRange(*({p: values[f"{field} {p}"] for p in PART_FIELDS} for field in FIELDS))


def outside_now(head: Any, rig: Any, trained: TrainedRange) -> dict[str, float]:
    """Part -> how far outside the range the head is as it is posed now (`open_motion.outside`)."""
    turns = {
        bone: to_axis_angle(np.array(rig.pose.bones[bone].rotation_quaternion))
        for bone in ("jaw", "left_eye", "right_eye")
    }
    expr = _expression(head, len(trained.middle["face"]), turns)
    zero = np.zeros(3)
    eyes = np.concatenate([turns["left_eye"], turns["right_eye"]])
    frame = FlameFrame(expr, zero, zero, turns["jaw"], zero, eyes)
    return {part: float(values[0]) for part, values in outside([frame], trained).items()}
