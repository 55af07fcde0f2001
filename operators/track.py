"""Tracks a head through footage in a worker process beside Blender, and imports what it tracked."""

from typing import Any, ClassVar

import bpy

from ..stga_addon.jobs.table import Kind
from ..stga_addon.jobs.track import MATTES, SolveAgain, Track
from . import ids
from .common import file_path, path_property, reporting
from .options import given_values, option_property
from .request import needs_idle, start
from .training_python import training_python


class TrackOptions:
    """What is tracked, and with what: of the operator, and of the panel that calls it."""

    footage: option_property(Track, "footage")
    cameras: option_property(Track, "cameras")
    model: option_property(Track, "model", "Head Model")
    avatar: option_property(Track, "avatar", subtype="DIR_PATH")
    directory: path_property("Capture", "Folder for the tracked capture", "DIR_PATH")
    focal: option_property(Track, "focal", "Focal Length")
    start: option_property(Track, "start")
    stop: option_property(Track, "stop")
    step: option_property(Track, "step")
    mattes: bpy.props.EnumProperty(
        name="Mattes", description="Masks that tell the person from the background",
        items=[
            *((name, name.title(), text.capitalize()) for name, text in MATTES.items()),
            ("folder", "Folder", "Those of a folder, named as the images"),
        ],
    )  # fmt: skip
    matte_folder: path_property(
        "Matte Folder", "Folder of masks, named as the images of the footage", "DIR_PATH"
    )


class TrackFootage(bpy.types.Operator, TrackOptions):
    """Track the head that the footage shows, in a process that continues when Blender is closed,
    and import it"""

    bl_idname = ids.TRACK_FOOTAGE
    bl_label = "Track Footage"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    landmarks: option_property(Track, "landmarks", subtype="DIR_PATH", options={"SKIP_SAVE"})
    python: bpy.props.StringProperty(
        name="Python",
        description="Python interpreter that tracks; empty: that of the preferences, or Blender's "
        "own",
        subtype="FILE_PATH", options={"SKIP_SAVE"},
    )  # fmt: skip

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_idle(cls, context, Kind.TRACKING)

    @reporting
    def execute(self, context: Any) -> set[str]:
        names = (
            "footage",
            "cameras",
            "model",
            "avatar",
            "landmarks",
            "focal",
            "start",
            "stop",
            "step",
        )
        given = {"model": None, **given_values(self, Track, *names)}
        out = file_path(self.directory, "capture").resolve()
        mattes = (
            str(file_path(self.matte_folder, "mattes").resolve())
            if self.mattes == "folder"
            else self.mattes
        )
        request, python = (
            Track(**given, out=out, mattes=mattes),
            training_python(context, self.python),
        )
        return start_tracking(self, context, request, python)


def start_tracking(
    operator: Any, context: Any, request: Track | SolveAgain, python: str
) -> set[str]:
    """Start a worker for the request, whose capture is imported when it is done; without a window,
    wait for that.

    Raises StgaError.
    """
    if start(context.scene, request, python):
        operator.report(
            {"INFO"}, f"Tracked {request.out if isinstance(request, Track) else request.capture}"
        )
    return {"FINISHED"}
