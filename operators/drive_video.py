"""Drives the head by a video of a face: a worker finds the performance, which is then applied."""

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.convert_motion import SHAPES_SUFFIX, ConvertMotion
from ..stga_addon.jobs.table import Kind
from ..stga_addon.scene import tags
from ..stga_addon.tracking.footage.sources import VIDEO_SUFFIXES, is_video
from ..stga_addon.training.run.folder import has_run, read_run
from . import ids
from .common import (
    FileImport,
    file_filter,
    file_path,
    head_of,
    needs_rig_or_shapes,
    reporting,
    rig_or_none,
    scene_settings,
)
from .drive import takes_folder
from .options import given_values, option_property
from .request import needs_idle, start
from .training_python import training_python


class DriveVideo(bpy.types.Operator, FileImport):
    """Find the motion of the face in a video, write it as a file into the takes, and apply it to
    the head"""

    bl_idname = ids.DRIVE_VIDEO
    bl_label = "Drive from Video"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    avatar: option_property(
        ConvertMotion, "avatar", "Track with Avatar", subtype="DIR_PATH", options={"SKIP_SAVE"}
    )
    filename_ext = ".mp4"
    filter_glob: file_filter(*VIDEO_SUFFIXES)

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_idle(cls, context, Kind.PERFORMANCE) and needs_rig_or_shapes(cls, context)

    def invoke(self, context: Any, event: Any) -> set[str]:
        run = scene_settings(context).run_folder
        if not self.avatar and run and has_run(Path(bpy.path.abspath(run))):
            self.avatar = run
        return super().invoke(context, event)

    @reporting
    def execute(self, context: Any) -> set[str]:
        video = file_path(self.filepath, "video")
        if not is_video(video):
            raise StgaError(f"{video}: is no video; expected {', '.join(VIDEO_SUFFIXES)}")
        folder, _ = takes_folder(context)
        given, suffix = given_values(self, ConvertMotion, "avatar"), SHAPES_SUFFIX
        if given and _is_of(given["avatar"], head_of(context)):
            suffix, render = ".npz", context.scene.render  # exact, a timestep for each frame
            given["fps"] = render.fps / render.fps_base
        output = _free_path(folder, video.stem, suffix)
        start(context.scene, ConvertMotion(video, output, **given), training_python(context))
        return {"FINISHED"}


def _is_of(run: Path, head: Any) -> bool:
    """Whether a run's avatar was trained on the capture that the head was imported from."""
    return rig_or_none(head) is not None and read_run(run).capture == Path(head[tags.CAPTURE])


def _free_path(folder: Path, stem: str, suffix: str) -> Path:
    path, number = folder / f"{stem}{suffix}", 1
    while path.exists():
        number += 1
        path = folder / f"{stem}_{number}{suffix}"
    return path
