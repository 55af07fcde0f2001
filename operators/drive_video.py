"""Drives the head by a video of a face: a worker detects the performance, which is then applied."""

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.convert_motion import ConvertMotion
from ..stga_addon.jobs.table import Kind
from ..stga_addon.tracking.footage.sources import VIDEO_SUFFIXES, is_video
from . import ids
from .common import FileImport, file_filter, file_path, needs_rig_or_shapes, reporting
from .drive import takes_folder
from .request import needs_idle, start
from .training_python import training_python


class DriveVideo(bpy.types.Operator, FileImport):
    """Detect the 52 shapes in a video of a face, write them as a CSV file into the takes, and apply
    them to the head"""

    bl_idname = ids.DRIVE_VIDEO
    bl_label = "Drive from Video"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    filename_ext = ".mp4"
    filter_glob: file_filter(*VIDEO_SUFFIXES)

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_idle(cls, context, Kind.PERFORMANCE) and needs_rig_or_shapes(cls, context)

    @reporting
    def execute(self, context: Any) -> set[str]:
        video = file_path(self.filepath, "video")
        if not is_video(video):
            raise StgaError(f"{video}: is no video; expected {', '.join(VIDEO_SUFFIXES)}")
        folder, _ = takes_folder(context)
        output = _free_path(folder, video.stem)
        start(context.scene, ConvertMotion(video, output), training_python(context))
        return {"FINISHED"}


def _free_path(folder: Path, stem: str) -> Path:
    path, number = folder / f"{stem}.csv", 1
    while path.exists():
        number += 1
        path = folder / f"{stem}_{number}.csv"
    return path
