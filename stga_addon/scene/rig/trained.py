"""The range that a head's avatar was trained on, kept with the head, and how far outside it is posed now."""

from typing import Any

import numpy as np

from ...driving.transfer import PART_FIELDS, TrainedRange, outside
from ...flame.forward import FlameFrame
from ...flame.quaternions import to_axis_angle
from .names import expression_key

TRAINED = "stga_trained"
"""Property of the head: the arrays of a `TrainedRange`, by field and part."""
FIELDS = ("middle", "width", "quiet", "first")


def store_range(head: Any, trained: TrainedRange) -> None:
    """Keep the range with the head, in its file."""
    head[TRAINED] = {
        f"{field} {part}": getattr(trained, field)[part].astype(float).tolist()
        for field in FIELDS
        for part in PART_FIELDS
    }


def stored_range(head: Any) -> TrainedRange | None:
    """The range that was kept with the head; None where there is none."""
    kept = head.get(TRAINED)
    if kept is None:
        return None
    values = {name: np.array(kept[name], np.float64) for name in kept.keys()}  # noqa: SIM118, an IDPropertyGroup
    if set(values) != {f"{field} {part}" for field in FIELDS for part in PART_FIELDS}:
        return None
    return TrainedRange(*({part: values[f"{field} {part}"] for part in PART_FIELDS} for field in FIELDS))


def outside_now(head: Any, rig: Any, trained: TrainedRange) -> dict[str, float]:
    """Part -> how far outside the range the head is as it is posed now (`transfer.outside`)."""
    keys, bones = head.data.shape_keys.key_blocks, rig.pose.bones
    names = [expression_key(head, k) for k in range(len(trained.middle["face"]))]
    expr = np.array([keys[name].value if name in keys else 0.0 for name in names])
    jaw, left, right = (
        to_axis_angle(np.array(bones[bone].rotation_quaternion)) for bone in ("jaw", "left_eye", "right_eye")
    )
    zero = np.zeros(3)
    frame = FlameFrame(expr, zero, zero, jaw, zero, np.concatenate([left, right]))
    return {part: float(values[0]) for part, values in outside([frame], trained).items()}
