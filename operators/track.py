"""The Track step: tracking a head through footage in a worker process beside Blender, looking at
what it found, and solving it again around frames that were posed by hand."""

import json
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.table import Kind
from ..stga_addon.jobs.track import MATTES, Track
from ..stga_addon.jobs.track import SolveAgain as SolveAgainRequest
from ..stga_addon.scene import tags
from ..stga_addon.scene.objects import show_kind
from ..stga_addon.scene.rig.head import rig_of
from ..stga_addon.scene.rig.keyframes import key_current_pose
from ..stga_addon.scene.rig.motion import sample_pose
from . import options
from .common import (
    Action,
    Edit,
    file_path,
    given_values,
    head_of,
    is_head,
    needs_head,
    needs_rig,
    own_motion,
    polled,
)
from .options import ONCE
from .request import idle, start
from .training_python import training_python

XRAY_ALPHA = 0.4
TRACK_FIELDS = ("footage", "start", "step", "cameras", "model", "avatar", "landmarks", "stop")
"""Of the request, beside its focal length, that are properties of the operator as well."""


class TrackOptions:
    """What is tracked, and with what: of the operator, and of the panel that calls it."""

    footage: options.field(Track, "footage")
    cameras: options.field(Track, "cameras")
    model: options.field(Track, "model", "Head Model")
    avatar: options.field(Track, "avatar", subtype="DIR_PATH")
    directory: options.path("Capture", "Folder for the tracked capture", "DIR_PATH")
    focal: options.field(Track, "focal", "Focal Length")
    start: options.field(Track, "start")
    stop: options.field(Track, "stop")
    step: options.field(Track, "step")
    mattes: options.choice(
        "Mattes",
        "Masks that tell the person from the background",
        *((name, name.title(), text.capitalize()) for name, text in MATTES.items()),
        ("folder", "Folder", "Those of a folder, named as the images"),
    )
    matte_folder: options.path(
        "Matte Folder", "Folder of masks, named as the images of the footage", "DIR_PATH"
    )


class TrackFootage(Action, bpy.types.Operator, TrackOptions):
    """Track the head that the footage shows, in a process that continues when Blender is closed,
    and import it"""

    needs = (idle(Kind.TRACKING),)

    landmarks: options.field(Track, "landmarks", subtype="DIR_PATH", options=ONCE)
    python: options.python("tracks")

    def run(self, context: Any) -> None:
        given = {"model": None, **given_values(self, Track, *TRACK_FIELDS, "focal")}
        out, mattes = file_path(self.directory, "capture").resolve(), self.mattes
        if mattes == "folder":
            mattes = str(file_path(self.matte_folder, "mattes").resolve())
        request = Track(**given, out=out, mattes=mattes)
        if start(context.scene, request, training_python(context, self.python)):
            self.inform(f"Tracked {out}")


class ViewFootage(Edit, bpy.types.Operator):
    """Look through the capture's cameras, at their images behind the see-through head; again: back
    to the free view"""

    bl_label = "Look Through Camera"

    step: options.integer(
        "Step", "1: the next camera, -1: the one before, 0: enter and leave", options=ONCE
    )

    @classmethod
    def poll(cls, context: Any) -> bool:
        in_viewport = context.space_data is not None and context.space_data.type == "VIEW_3D"
        return polled(cls, in_viewport, "Needs a 3D viewport") and needs_head(cls, context)

    def run(self, context: Any) -> None:
        head, space, scene = head_of(context), context.space_data, context.scene
        cameras = capture_cameras(head)
        if not cameras:
            raise StgaError("The capture has no cameras in this scene; import it again")
        leave = self.step == 0 and space.region_3d.view_perspective == "CAMERA"
        # a hidden camera shows no images
        show_kind(head.parent, tags.CAMERA, context.view_layer, not leave)
        if leave:
            space.region_3d.view_perspective, space.shading.show_xray = "PERSP", False
            return
        row = cameras.index(scene.camera) if scene.camera in cameras else 0
        scene.camera = cameras[(row + self.step) % len(cameras)]
        scene.render.resolution_x, scene.render.resolution_y = scene.camera[tags.IMAGE_SIZE]
        space.region_3d.view_perspective = "CAMERA"
        space.shading.type, space.shading.show_xray = "SOLID", True
        space.shading.xray_alpha = XRAY_ALPHA


class MarkKey(Edit, bpy.types.Operator):
    """Keep the pose and expression of this frame, set by hand, as a key for Solve Again; on a key:
    no longer"""

    bl_label = "Mark as Key"

    @classmethod
    def poll(cls, context: Any) -> bool:
        if not needs_rig(cls, context):
            return False
        has_timestep = context.scene.frame_current in context.scene.stga.head[tags.TIMESTEPS]
        return polled(cls, has_timestep, "The capture has no timestep at this frame")

    def run(self, context: Any) -> None:
        head, frame = head_of(context), context.scene.frame_current
        keys = tracking_keys(head)
        if frame in keys:
            del keys[frame]
        else:
            keys[frame] = sample_pose(head, own_motion(head).model).parameters
            key_current_pose(head, rig_of(head), frame)
        stored = {str(timestep): keys[timestep].tolist() for timestep in sorted(keys)}
        head[tags.TRACKING_KEYS] = json.dumps(stored)


class SolveAgain(Action, bpy.types.Operator):
    """Solve the tracked capture again around the keys, in a process beside Blender, and import
    it"""

    @classmethod
    def poll(cls, context: Any) -> bool:
        if not needs_rig(cls, context) or not idle(Kind.TRACKING)(cls, context):
            return False
        is_tracked = bool(context.scene.stga.head.get(tags.TRACKED))
        return polled(cls, is_tracked, "This capture was not tracked here")

    def run(self, context: Any) -> None:
        head = head_of(context)
        capture, model = Path(head[tags.CAPTURE]), Path(head[tags.FLAME_MODEL])
        request = SolveAgainRequest(capture, model, tracking_keys(head))
        if start(context.scene, request, training_python(context)):
            self.inform(f"Tracked {capture}")


def tracking_keys(head: Any) -> dict[int, np.ndarray]:
    """Timestep -> parameters of the frames that are marked as keys."""
    stored = json.loads(head.get(tags.TRACKING_KEYS) or "{}") if is_head(head) else {}
    return {int(timestep): np.array(values, float) for timestep, values in stored.items()}


def capture_cameras(head: Any) -> list[Any]:
    """The head's cameras, by index."""
    cameras = tags.find(tags.CAMERA, Path(head[tags.CAPTURE]))
    return sorted(cameras, key=lambda camera: camera[tags.CAMERA_INDEX])
