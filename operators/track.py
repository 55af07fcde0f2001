"""Tracks a head through footage in a worker process beside Blender, and imports what it tracked."""

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.requests.monitor_state import Kind
from ..stga_addon.requests.values import SolveAgain, Track
from . import ids
from .common import file_path, path_property, reporting
from .request import needs_idle, start
from .training_python import training_python


class TrackOptions:
    """What is tracked, and with what: of the operator, and of the panel that calls it."""

    footage: path_property("Footage", "Folder with a folder of images or a video for each camera; or one video")
    cameras: path_property(
        "Cameras",
        "Calibration: COLMAP, Metashape, RealityCapture or transforms.json; empty: the one in the footage's folder",
    )
    model: path_property(
        "Head Model",
        "FLAME (.pkl, .npz), linear model (.npz) or morph targets (.glb); empty: the head of this add-on",
    )
    directory: path_property("Capture", "Folder for the tracked capture", "DIR_PATH")
    focal: bpy.props.FloatProperty(
        name="Focal Length",
        description="In pixels, of a single camera without calibration; 0: as its file says, or from the head's turns",
        min=0.0,
    )
    start: bpy.props.IntProperty(name="Start", description="First frame of the footage, counted from 0", min=0)
    stop: bpy.props.IntProperty(name="Stop", description="Frame to stop before; 0: all", min=0)
    step: bpy.props.IntProperty(name="Step", description="Use every nth frame", min=1, default=1)
    mattes: bpy.props.EnumProperty(
        name="Mattes",
        description="Masks that tell the person from the background",
        items=(
            ("auto", "Auto", "Made for frames without a mask"),
            ("none", "None", "Only those of the footage"),
            ("folder", "Folder", "Those of a folder, named as the images"),
        ),
    )
    matte_folder: path_property("Matte Folder", "Folder of masks, named as the images of the footage", "DIR_PATH")


class TrackFootage(bpy.types.Operator, TrackOptions):
    """Track the head that the footage shows, in a process that continues when Blender is closed, and import it"""

    bl_idname = ids.TRACK_FOOTAGE
    bl_label = "Track Footage"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    landmarks: path_property(
        "Landmarks", "Folder with landmark files of another detector", "DIR_PATH", options={"SKIP_SAVE"}
    )
    python: bpy.props.StringProperty(
        name="Python",
        description="Python interpreter that tracks; empty: that of the preferences, or Blender's own",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_idle(cls, context, Kind.TRACKING)

    @reporting
    def execute(self, context: Any) -> set[str]:
        python = training_python(context, self.python)
        out, footage = file_path(self.directory, "capture").resolve(), file_path(self.footage, "footage")

        def optional(value: str, what: str) -> Path | None:
            return file_path(value, what).resolve() if value else None

        request = Track(
            footage.resolve(),
            optional(self.model, "head model"),
            out,
            optional(self.cameras, "cameras"),
            optional(self.landmarks, "landmarks"),
            self.focal or None,
            self.start,
            self.stop or None,
            self.step,
            mattes=str(file_path(self.matte_folder, "mattes").resolve()) if self.mattes == "folder" else self.mattes,
        )
        return start_tracking(self, context, request, python)


def start_tracking(operator: Any, context: Any, request: Track | SolveAgain, python: str) -> set[str]:
    """Start a worker for the request, whose capture is imported when it is done; without a window, wait for that.

    Raises StgaError.
    """
    if start(context.scene, request, python):
        operator.report({"INFO"}, f"Tracked {request.out if isinstance(request, Track) else request.capture}")
    return {"FINISHED"}
