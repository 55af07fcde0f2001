"""Makes an avatar from a video: tracks and trains in a process beside Blender, and shows both as
they become."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.table import TRAINS
from ..stga_addon.jobs.track import (
    CAPTURE_FOLDER,
    RUN_FOLDER,
    MakeAvatar,
    Track,
    check_inputs,
    read_inputs,
)
from ..stga_addon.jobs.train import Train as TrainRequest
from ..stga_addon.tracking.footage.sources import VIDEO_SUFFIXES
from ..stga_addon.training.settings import make_settings
from . import monitor, options
from .common import Action, FileImport, file_path
from .options import ONCE
from .request import idle, start
from .training_python import training_python

MAX_FOLDERS = 1000
DIGITS = 3
"""Of numbers that Blender keeps in single precision, which continue only as they began."""


class AvatarFromVideo(Action, bpy.types.Operator, FileImport):
    """Make an avatar from a video of a face: track the head, train, and show the avatar on it. What
    was begun with the same video is continued"""

    bl_label = "Avatar from Video"
    needs = (idle(*TRAINS),)

    filepath: options.path("Video", "Video of a face", options=ONCE)
    folder: options.path(  # not `directory`, which Blender's file browser sets to that of the file
        "Folder",
        "Folder for capture and avatar; empty: one beside the .blend file, else beside the video",
        "DIR_PATH",
        options=ONCE,
    )
    minutes: options.number("Minutes", "Training time", default=5.0, min=0.01)
    focal: options.field(Track, "focal", "Focal Length", options=ONCE)
    python: options.python("tracks and trains", options={*ONCE, "HIDDEN"})
    filter_glob: options.file_filter(*VIDEO_SUFFIXES)

    def invoke(self, context: Any, event: Any) -> set[str]:
        if not self.filepath:
            return self.execute(context) if self.folder else super().invoke(context, event)
        video = file_path(self.filepath, "video").resolve()  # dropped
        self.folder = str(proposed_folder(self._tracking(video, Path())).parent)
        return context.window_manager.invoke_props_dialog(
            self, width=480, title=self.bl_label, confirm_text="Make"
        )

    def draw(self, context: Any) -> None:
        self.layout.use_property_split = True
        for name in ("folder", "minutes", "focal"):
            self.layout.prop(self, name)

    def run(self, context: Any) -> None:
        if self.folder and not self.filepath:  # continues
            began_with = read_inputs(file_path(self.folder, "folder"))
            self.filepath = str(began_with.get("footage", ""))
            self.focal = began_with.get("focal") or 0.0
        video = file_path(self.filepath, "video").resolve()
        if not video.is_file():
            raise StgaError(f"{video}: is not a file; expected a video")
        python = training_python(context, self.python)
        if self.folder:
            capture = file_path(self.folder, "folder").resolve() / CAPTURE_FOLDER
        else:
            capture = proposed_folder(self._tracking(video, Path()))
        settings = make_settings("global", seconds=round(60 * self.minutes, DIGITS), effects={})
        train = TrainRequest(capture.parent / RUN_FOLDER, capture, settings)
        request = MakeAvatar(self._tracking(video, capture), train)
        monitor.show_panel()  # where it can be watched and cancelled, also after a drop
        if start(context.scene, request, python):
            self.inform(f"Made {request.out}")

    def _tracking(self, video: Path, capture: Path) -> Track:
        return Track(video, None, capture, focal=round(self.focal, DIGITS) or None)


def proposed_folder(track: Track) -> Path:
    """The folder of the capture in the first folder beside the .blend file, else beside the video,
    that is free or in which this video's avatar was begun."""
    beside = Path(bpy.data.filepath).parent if bpy.data.filepath else track.footage.parent
    name = f"{track.footage.stem} avatar"
    for each in (name, *(f"{name} {number}" for number in range(2, MAX_FOLDERS))):
        capture = beside / each / CAPTURE_FOLDER
        with suppress(StgaError):
            check_inputs(replace(track, out=capture))
            return capture
    problem = f"holds {MAX_FOLDERS} avatars of {track.footage.name}; choose a folder"
    raise StgaError(f"{beside}: {problem}")
