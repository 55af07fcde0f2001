"""Shows a tracked head over its cameras' images, and solves it again around frames that were posed
by hand."""

import json
from pathlib import Path
from typing import Any, ClassVar

import bpy
import numpy as np

from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.table import Kind
from ..stga_addon.jobs.track import SolveAgain as SolveAgainRequest
from ..stga_addon.scene import tags
from ..stga_addon.scene.objects import show_kind
from ..stga_addon.scene.rig.head import rig_of
from ..stga_addon.scene.rig.keyframes import key_current_pose
from ..stga_addon.scene.rig.motion import sample_pose
from . import ids
from .common import (
    capture_of,
    flame_of,
    head_of,
    is_head,
    needs_head,
    needs_rig,
    polled,
    reporting,
    scene_settings,
)
from .request import needs_idle
from .track import start_tracking
from .training_python import training_python

XRAY_ALPHA = 0.4


class ViewFootage(bpy.types.Operator):
    """Look through the capture's cameras, at their images behind the see-through head; again: back
    to the free view"""

    bl_idname = ids.VIEW_FOOTAGE
    bl_label = "Look Through Camera"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    step: bpy.props.IntProperty(
        name="Step", description="1: the next camera, -1: the one before, 0: enter and leave",
        options={"SKIP_SAVE"},
    )  # fmt: skip

    @classmethod
    def poll(cls, context: Any) -> bool:
        in_viewport = context.space_data is not None and context.space_data.type == "VIEW_3D"
        return polled(cls, in_viewport, "Needs a 3D viewport") and needs_head(cls, context)

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = head_of(context)
        cameras = capture_cameras(head)
        if not cameras:
            raise StgaError("The capture has no cameras in this scene; import it again")
        space, scene = context.space_data, context.scene
        leave = self.step == 0 and space.region_3d.view_perspective == "CAMERA"
        # a hidden camera shows no images
        show_kind(head.parent, tags.CAMERA, context.view_layer, not leave)
        if leave:
            space.region_3d.view_perspective, space.shading.show_xray = "PERSP", False
            return {"FINISHED"}
        row = cameras.index(scene.camera) if scene.camera in cameras else 0
        scene.camera = cameras[(row + self.step) % len(cameras)]
        scene.render.resolution_x, scene.render.resolution_y = scene.camera[tags.IMAGE_SIZE]
        space.region_3d.view_perspective = "CAMERA"
        space.shading.type, space.shading.show_xray, space.shading.xray_alpha = (
            "SOLID",
            True,
            XRAY_ALPHA,
        )
        return {"FINISHED"}


class MarkKey(bpy.types.Operator):
    """Keep the pose and expression of this frame, set by hand, as a key for Solve Again; on a key:
    no longer"""

    bl_idname = ids.MARK_KEY
    bl_label = "Mark as Key"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        if not needs_rig(cls, context):
            return False
        has_timestep = context.scene.frame_current in scene_settings(context).head[tags.TIMESTEPS]
        return polled(cls, has_timestep, "The capture has no timestep at this frame")

    @reporting
    def execute(self, context: Any) -> set[str]:
        head, frame = head_of(context), context.scene.frame_current
        keys = tracking_keys(head)
        if frame in keys:
            del keys[frame]
        else:
            keys[frame] = sample_pose(head, flame_of(capture_of(head), head.name).model).parameters
            key_current_pose(head, rig_of(head), frame)
        head[tags.TRACKING_KEYS] = json.dumps(
            {str(timestep): keys[timestep].tolist() for timestep in sorted(keys)}
        )
        return {"FINISHED"}


class SolveAgain(bpy.types.Operator):
    """Solve the tracked capture again around the keys, in a process beside Blender, and import
    it"""

    bl_idname = ids.SOLVE_AGAIN
    bl_label = "Solve Again"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        if not needs_rig(cls, context) or not needs_idle(cls, context, Kind.TRACKING):
            return False
        is_tracked = bool(scene_settings(context).head.get(tags.TRACKED))
        return polled(cls, is_tracked, "This capture was not tracked here")

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = head_of(context)
        capture = Path(head[tags.CAPTURE])
        request = SolveAgainRequest(capture, Path(head[tags.FLAME_MODEL]), tracking_keys(head))
        return start_tracking(self, context, request, training_python(context))


def tracking_keys(head: Any) -> dict[int, np.ndarray]:
    """Timestep -> parameters of the frames that are marked as keys."""
    stored = json.loads(head.get(tags.TRACKING_KEYS) or "{}") if is_head(head) else {}
    return {int(timestep): np.array(values, float) for timestep, values in stored.items()}


def capture_cameras(head: Any) -> list[Any]:
    """The head's cameras, by index."""
    cameras = tags.find(tags.CAMERA, Path(head[tags.CAPTURE]))
    return sorted(cameras, key=lambda camera: camera[tags.CAMERA_INDEX])
