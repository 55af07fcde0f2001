"""Retargeting of a FLAME motion: other person, speed and strength."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .forward import FlameFrame
from .quaternions import from_axis_angle, slerp, to_axis_angle
from .sequence import FlameSequence

# Part of a motion that can be transferred -> fields of a frame.
PARTS = {
    "expression": ("expr",),
    "jaw": ("jaw_pose",),
    "eyes": ("eyes_pose",),
    "neck": ("neck_pose",),
    "head": ("rotation", "translation"),
}
LINEAR = ("expr", "translation")
ROTATIONS = ("rotation", "neck_pose", "jaw_pose", "eyes_pose")
TIME_TOLERANCE = 1e-6  # of a timestep; rounding must not drop the last frame


def retimed(sequence: FlameSequence, step: float = 1.0) -> list[FlameFrame]:
    """The frames at the first timestep and every `step` timesteps after it, up to the last.

    Coefficients and translation are interpolated linearly, rotations on the shortest arc (slerp). Dynamic offsets,
    which belong to the tracked person, are left out.
    """
    times = np.asarray(sequence.timesteps, np.float64)
    wanted = np.arange(times[0], times[-1] + TIME_TOLERANCE, step)
    row = np.clip(np.searchsorted(times, wanted + TIME_TOLERANCE, side="right") - 1, 0, max(len(times) - 2, 0))
    after = np.minimum(row + 1, len(times) - 1)
    share = (wanted - times[row]) / np.maximum(times[after] - times[row], 1.0)
    tracked = {name: _stacked(sequence, name) for name in (*LINEAR, *ROTATIONS)}
    values = {}
    for name in LINEAR:
        start, end = tracked[name][row], tracked[name][after]
        values[name] = start + share[:, None] * (end - start)
    for name in ROTATIONS:
        values[name] = _turned(tracked[name][row], tracked[name][after], share)
    return [FlameFrame(**{name: column[index] for name, column in values.items()}) for index in range(len(wanted))]


def strengthened(frames: Sequence[FlameFrame], strength: float) -> list[FlameFrame]:
    """The frames with their motion scaled by `strength`: expression, jaw, eyes and neck about the neutral face.

    Rotation and translation of the head are scaled about the first frame's.
    """
    first = frames[0]
    here = np.array([strength])
    changed = []
    for frame in frames:
        turns = {name: _turned(np.zeros_like(value)[None], value[None], here)[0] for name, value in _inner(frame)}
        changed.append(
            replace(
                frame,
                **turns,
                expr=strength * frame.expr,
                rotation=_turned(first.rotation[None], frame.rotation[None], here)[0],
                translation=first.translation + strength * (frame.translation - first.translation),
            )
        )
    return changed


def transferred_motion(motion: FlameSequence, neutral: np.ndarray) -> FlameSequence:
    """The motion on the person whose neutral mesh is `neutral` (V, 3), of the same model.

    FLAME adds shape and static offset to the template before posing, so the difference between neutral mesh and
    template replaces both. Dynamic offsets, which belong to the tracked person, are left out.
    """
    return replace(
        motion,
        shape=np.zeros_like(motion.shape),
        static_offset=neutral - motion.model.v_template,
        frame=lambda timestep: replace(motion.frame(timestep), dynamic_offset=None),
    )


def _inner(frame: FlameFrame) -> list[tuple[str, np.ndarray]]:
    return [(name, getattr(frame, name)) for name in ROTATIONS if name != "rotation"]


def _stacked(sequence: FlameSequence, name: str) -> np.ndarray:
    return np.stack([getattr(sequence.frame(timestep), name) for timestep in sequence.timesteps])


def _turned(start: np.ndarray, end: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(T, 3n) axis-angle vectors between (T, 3n) and (T, 3n), n joints side by side; share (T,)."""
    joints = (len(start), -1, 3)
    first, second = (from_axis_angle(vectors.reshape(joints)) for vectors in (start, end))
    return to_axis_angle(slerp(first, second, share[:, None])).reshape(start.shape)
