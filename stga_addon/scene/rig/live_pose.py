"""Poses of a head that are set directly, without keyframes, while it is driven live."""

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np

from ...driving.names import ARKIT_SHAPES
from ...flame.forward import FlameFrame
from ...flame.model import JOINTS
from ...flame.quaternions import from_axis_angle
from .arkit import has_controls, shape_key_names
from .names import OFFSET_KEY, is_expression_key, offset_property

LIVE_JOINTS = ("neck", "jaw", "left_eye", "right_eye")
WEIGHT_RANGE = (-1.0, 2.0)


class LivePose:
    """What a head's sliders, bones and controls held before, and how live values are set on them.

    Objects are looked up by name each time: references to them do not survive undo.
    """

    def __init__(self, head: Any, rig: Any) -> None:
        """rig: the head's FLAME rig; None for a head that has shape keys with ARKit's names."""
        self._head, self._rig = head.name, None if rig is None else rig.name
        self.takes_frames = rig is not None and not has_controls(rig)
        keys = head.data.shape_keys.key_blocks
        self._sliders = np.empty(len(keys), np.float32)
        keys.foreach_get("value", self._sliders)
        self._values = self._sliders.copy()
        names = [key.name for key in keys]
        self._turns: dict[str, tuple[float, ...]] = {}
        self._properties: dict[str, Any] = {}
        self._offsets: list[str] = []
        if rig is None:
            self._rows = {column: names.index(name) for column, name in shape_key_names(head).items()}
            return
        self._values[[is_expression_key(name) or name.startswith(OFFSET_KEY) for name in names]] = 0.0
        self._rows = dict(enumerate(row for row, name in enumerate(names) if is_expression_key(name)))
        self._turns = {joint: tuple(rig.pose.bones[joint].rotation_quaternion) for joint in LIVE_JOINTS}
        self._offsets = [name for joint in JOINTS if (name := offset_property(joint)) in rig]
        controls = [] if self.takes_frames else list(ARKIT_SHAPES)
        self._properties = {name: tuple(rig[name]) for name in self._offsets} | {name: rig[name] for name in controls}

    @property
    def is_there(self) -> bool:
        """Whether the head, and its rig, are still in the file, with as many sliders."""
        head = bpy.data.objects.get(self._head)
        keys = head.data.shape_keys if head is not None and head.type == "MESH" else None
        has_rig = self._rig is None or self._rig in bpy.data.objects
        return keys is not None and has_rig and len(keys.key_blocks) == len(self._sliders)

    def set_frame(self, frame: FlameFrame) -> None:
        """Pose a FLAME head: expressions, jaw, eyes and neck; tracked per-frame offsets are switched off."""
        for component, row in self._rows.items():
            self._values[row] = frame.expr[component] if component < len(frame.expr) else 0.0
        self._set_sliders(self._values)
        turns = [frame.neck_pose, frame.jaw_pose, frame.eyes_pose[:3], frame.eyes_pose[3:]]
        self._set_turns(dict(zip(LIVE_JOINTS, from_axis_angle(np.stack(turns)), strict=True)))

    def set_weights(self, weights: Sequence[float] | np.ndarray, neck: np.ndarray) -> None:
        """Set the 52 weights on controls or shape keys, and turn the neck of a FLAME head by an axis-angle (3,)."""
        limited = np.clip(weights, *WEIGHT_RANGE)
        if self._rig is None:
            for column, row in self._rows.items():
                self._values[row] = limited[column]
            self._set_sliders(self._values)
            return
        rig = bpy.data.objects[self._rig]
        for name, value in zip(ARKIT_SHAPES, limited.tolist(), strict=True):
            rig[name] = value
        self._set_turns({"neck": from_axis_angle(neck[None])[0]})

    def restore(self) -> None:
        """Give back what was there before the first live pose."""
        self._set_sliders(self._sliders)
        if self._rig is not None:
            rig = bpy.data.objects[self._rig]
            for name, value in self._properties.items():
                rig[name] = value
            self._set_turns(self._turns, clear_offsets=False)

    def _set_sliders(self, values: np.ndarray) -> None:
        mesh = bpy.data.objects[self._head].data
        mesh.shape_keys.key_blocks.foreach_set("value", values)
        mesh.shape_keys.update_tag()
        mesh.update_tag()

    def _set_turns(self, turns: dict[str, Any], clear_offsets: bool = True) -> None:
        rig = bpy.data.objects[self._rig]
        for joint, quaternion in turns.items():
            rig.pose.bones[joint].rotation_quaternion = quaternion
        for name in self._offsets if clear_offsets else ():
            rig[name] = (0.0, 0.0, 0.0)
        rig.update_tag()
