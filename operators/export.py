"""Exports an avatar to the files of other viewers and tools."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import bpy
from bpy_extras.io_utils import ExportHelper

from ..stga_addon.avatar.file import read_avatar
from ..stga_addon.driving.head_map import page_controls
from ..stga_addon.errors import StgaError
from ..stga_addon.export.formats import (
    FORMATS,
    Meshes,
    check_free_space,
    check_suffix,
    export_avatar,
)
from ..stga_addon.format import format_bytes
from ..stga_addon.jobs.export import Export
from ..stga_addon.scene.arrays import evaluated_vertices
from ..stga_addon.scene.display.splat_object import check_head
from ..stga_addon.scene.objects import frames_per_second, iterate_frames
from ..stga_addon.scene.rig.motion import sample_motion
from . import ids
from .common import (
    capture_of,
    file_filter,
    file_path,
    flame_of,
    head_of,
    needs_head,
    path_property,
    reporting,
    scene_settings,
    tell,
)
from .export_range import RangeExport
from .export_web import exact_motion, scene_playback
from .options import option_property

STEP_INTERVAL_S = 0.005
SUFFIXES = tuple(suffix for format in FORMATS.values() for suffix in format.suffixes)


class ExportAvatar(bpy.types.Operator, ExportHelper):
    """Export a trained avatar, posed as the head in the scene, for other viewers of Gaussian
    splats"""

    bl_idname = ids.EXPORT_AVATAR
    bl_label = "Export Avatar"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    filepath: path_property(
        "File or Folder",
        "A folder for PLY Sequence and GaussianAvatars, a file for the other formats",
        options={"SKIP_SAVE"},
    )
    avatar: path_property(
        "Avatar", "Avatar file (.npz); empty: the one shown", options={"SKIP_SAVE"}
    )
    format: bpy.props.EnumProperty(
        name="Format", description="File format",
        items=tuple((name, format.label, format.description) for name, format in FORMATS.items()),
    )  # fmt: skip

    filter_glob: file_filter(*SUFFIXES)
    motion_only: option_property(Export, "motion_only")
    _range: RangeExport | None = None
    _is_invoked = False

    poll = classmethod(needs_head)

    @property
    def filename_ext(self) -> str:
        """What ExportHelper appends to the path."""
        return next(iter(FORMATS[self.format].suffixes), "")

    def check(self, context: Any) -> bool:
        """Keep the path's extension in step with the format; whether it changed."""
        path = self.filepath
        if not path.lower().endswith(FORMATS[self.format].suffixes or ("/",)):
            for suffix in SUFFIXES:
                path = path.removesuffix(suffix)
            path += self.filename_ext
        changed, self.filepath = path != self.filepath, path
        return changed

    def draw(self, context: Any) -> None:
        self.layout.use_property_split = True
        self.layout.prop(self, "format")
        self.layout.prop(self, "avatar")
        if self.format == "web":
            self.layout.prop(self, "motion_only")
        if FORMATS[self.format].source == "range":
            frames = _frames(context)
            column = self.layout.column()
            column.label(text=f"Frames {frames[0]} to {frames[-1]} of the scene", icon="TIME")
            column.label(text=self._size(context, len(frames)), icon="DISK_DRIVE")

    def _size(self, context: Any, frames: int) -> str:
        try:
            source = self._source(context)
            return (
                f"About {format_bytes(_size(source, source.stat().st_mtime, self.format, frames))}"
            )
        except (StgaError, OSError) as error:
            return str(error)

    def _source(self, context: Any) -> Path:
        return file_path(self.avatar or scene_settings(context).avatar, "avatar")

    def invoke(self, context: Any, event: Any) -> set[str]:
        self._is_invoked = True
        return super().invoke(context, event)  # type: ignore[no-any-return]

    @reporting
    def execute(self, context: Any) -> set[str]:
        head, frames = head_of(context), _frames(context)
        path, write = self._writer(context, head, frames)
        if FORMATS[self.format].source != "range":
            write((frame, evaluated_vertices(head)) for frame in (context.scene.frame_current,))
        elif not self._is_invoked:
            write((frame, evaluated_vertices(head)) for frame in iterate_frames(frames))
        else:
            self._range = RangeExport(head, frames, write)
            self._timer = context.window_manager.event_timer_add(
                STEP_INTERVAL_S, window=context.window
            )
            context.window_manager.modal_handler_add(self)
            return {"RUNNING_MODAL"}
        self.report({"INFO"}, f"Exported to {path}")
        return {"FINISHED"}

    def _writer(
        self, context: Any, head: Any, frames: range
    ) -> tuple[Path, Callable[[Meshes], Any]]:
        """Where the file comes to lie, and what writes it. Raises StgaError for what can be known
        before."""
        format = FORMATS[self.format]
        path = file_path(self.filepath, "export")
        if format.suffixes and not path.suffix:
            path = path.with_suffix(self.filename_ext)
        check_suffix(path, self.format)
        avatar = read_avatar(self._source(context))
        check_head(avatar, head)
        motion = playback = None
        if self.format == "web":
            playback = scene_playback(context, head, frames, self.motion_only)
            motion = None if self.motion_only else exact_motion(head, frames, self._warn)
            playback = replace(playback, controls=page_controls(motion))
        if format.source == "range":
            check_free_space(path, FORMATS[self.format].size(avatar, len(frames)))
        elif format.source == "motion":
            motion = sample_motion(head, flame_of(capture_of(head), head.name), frames, self._warn)
        fps = frames_per_second(context.scene)
        return path, lambda meshes: export_avatar(
            path, avatar, self.format, meshes, motion, fps, playback
        )

    def modal(self, context: Any, event: Any) -> set[str]:
        """Export one frame a timer event; Esc cancels."""
        job = self._range
        assert job is not None
        if event.type == "ESC" or event.type == "TIMER":
            is_running = False if event.type == "ESC" else job.step()
            context.workspace.status_text_set(
                f"Exporting frame {job.done} of {job.total}   Esc: Cancel"
            )
            if not is_running:
                return self._end(context)
        return {"RUNNING_MODAL"}

    def cancel(self, context: Any) -> None:
        """Blender closes, or the file dialog is left."""
        if self._range is not None:
            self._end(context)

    @reporting
    def _end(self, context: Any) -> set[str]:
        job = self._range
        assert job is not None
        context.window_manager.event_timer_remove(self._timer)
        context.workspace.status_text_set(None)
        if job.finish():
            self.report({"INFO"}, f"Exported {job.total} frames to {self.filepath}")
            return {"FINISHED"}
        self.report({"WARNING"}, f"Export cancelled after {job.done} of {job.total} frames")
        return {"CANCELLED"}

    def _warn(self, sentence: str) -> None:
        tell(self, "WARNING", sentence)


@lru_cache(maxsize=8)
def _size(avatar: Path, modified: float, format: str, frames: int) -> int:
    """`Format.size` of an avatar file last modified at this time. Raises StgaError where it cannot
    be read."""
    return FORMATS[format].size(read_avatar(avatar), frames)


def _frames(context: Any) -> range:
    return range(context.scene.frame_start, context.scene.frame_end + 1)
