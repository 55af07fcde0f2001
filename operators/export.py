"""Exports an avatar to the files of other viewers and tools; what the head plays, the cameras and a
head model for tracking."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import bpy
import numpy as np
from bpy_extras.io_utils import ExportHelper

from ..stga_addon.avatar.file import read_avatar
from ..stga_addon.capture.camera import Camera, camera_from_gl
from ..stga_addon.driving.head_map import page_controls
from ..stga_addon.driving.inverse import captured_performance, write_performance
from ..stga_addon.errors import StgaError
from ..stga_addon.export import formats
from ..stga_addon.export.formats import FORMATS, Meshes
from ..stga_addon.export.playback import Playback
from ..stga_addon.flame.sequence import FlameSequence
from ..stga_addon.format import format_bytes
from ..stga_addon.jobs.export import Export
from ..stga_addon.progress import Cancelled
from ..stga_addon.scene.arrays import evaluated_vertices
from ..stga_addon.scene.cameras import export_cameras, scene_camera
from ..stga_addon.scene.display.splat_object import check_head
from ..stga_addon.scene.objects import Warn, frames_per_second, iterate_frames
from ..stga_addon.scene.rig.head import has_shape_keys, shape_key_model
from ..stga_addon.scene.rig.motion import sample_motion
from ..stga_addon.scene.vertex_groups import training_selection
from ..stga_addon.tracking.head_model import shape_arrays, write_linear_model
from . import common, options
from .common import Action, Stepwise, file_path, head_of, need, needs_head, own_motion, scene_frames
from .options import ONCE

STEP_INTERVAL_S = 0.005
MAX_WAITING_MESHES = 2
SUFFIXES = tuple(suffix for format in FORMATS.values() for suffix in format.suffixes)


class ExportAvatar(Stepwise, bpy.types.Operator, ExportHelper):
    """Export a trained avatar, posed as the head in the scene, for other viewers of Gaussian
    splats"""

    needs = (needs_head,)

    filepath: options.path(
        "File or Folder",
        "A folder for PLY Sequence and GaussianAvatars, a file for the other formats",
        options=ONCE,
    )
    avatar: options.path("Avatar", "Avatar file (.npz); empty: the one shown", options=ONCE)
    format: options.choice(
        "Format",
        "File format",
        *((name, format.label, format.description) for name, format in FORMATS.items()),
    )
    filter_glob: options.file_filter(*SUFFIXES)
    motion_only: options.field(Export, "motion_only")
    _is_invoked = False

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
        changed = path != self.filepath
        self.filepath = path
        return changed

    def draw(self, context: Any) -> None:
        self.layout.use_property_split = True
        shown = ("format", "avatar", *(("motion_only",) if self.format == "web" else ()))
        for name in shown:
            self.layout.prop(self, name)
        if FORMATS[self.format].source == "range":
            frames = scene_frames(context.scene)
            column = self.layout.column()
            column.label(text=f"Frames {frames[0]} to {frames[-1]} of the scene", icon="TIME")
            try:
                source = self._source(context)
                size = _size(source, source.stat().st_mtime, self.format, len(frames))
                text = f"About {format_bytes(size)}"
            except (StgaError, OSError) as error:
                text = str(error)
            column.label(text=text, icon="DISK_DRIVE")

    def _source(self, context: Any) -> Path:
        return file_path(self.avatar or context.scene.stga.avatar, "avatar")

    def invoke(self, context: Any, event: Any) -> set[str]:
        self._is_invoked = True
        return super().invoke(context, event)

    def run(self, context: Any) -> set[str] | None:
        head = head_of(context)
        scene = context.scene
        path = file_path(self.filepath, "export")
        format = FORMATS[self.format]
        frames = scene_frames(scene)
        fps = frames_per_second(scene)
        if format.suffixes and not path.suffix:
            path = path.with_suffix(self.filename_ext)
        formats.check_suffix(path, self.format)
        avatar = read_avatar(self._source(context))
        check_head(avatar, head)
        motion = None
        playback = Playback(fps=fps)
        if self.format == "web":
            motion = None if self.motion_only else exact_motion(head, frames, self.warn)
            playback = scene_playback(context, head, frames, self.motion_only)
            playback = replace(playback, controls=page_controls(motion))
        if format.source == "range":
            formats.check_free_space(path, format.size(avatar, len(frames)))
        elif format.source == "motion":
            motion = sample_motion(head, own_motion(head), frames, self.warn)

        def write(meshes: Meshes) -> None:
            formats.export_avatar(path, avatar, self.format, meshes, motion, playback)

        if format.source != "range":
            frames = range(scene.frame_current, scene.frame_current + 1)
        if self._is_invoked:
            steps = self.export(context, path, head, frames, write)
            return self.begin(context, steps, STEP_INTERVAL_S)
        write((frame, evaluated_vertices(head)) for frame in iterate_frames(frames))
        self.inform(f"Exported to {path}")
        return None

    def export(
        self, context: Any, path: Path, head: Any, frames: range, write: Callable[[Meshes], Any]
    ) -> Iterator[None]:
        """Pose the head, a frame a step, for `write`, which takes the numbered meshes in a thread;
        restore the scene's frame at the end, and say what has become of the export."""
        waiting: Queue[Any] = Queue(MAX_WAITING_MESHES)

        def meshes() -> Meshes:
            while (item := waiting.get()) is not None:
                if isinstance(item, Cancelled):
                    raise item
                yield item

        posing = iterate_frames(frames)
        is_fed = False
        done = 0
        pool = ThreadPoolExecutor(1, "stga export")
        written = pool.submit(write, meshes())
        pool.shutdown(wait=False)
        try:
            while not written.done():
                if not is_fed and not waiting.full():
                    frame = next(posing, None)
                    is_fed = frame is None
                    waiting.put(None if is_fed else (frame, evaluated_vertices(head)))
                    done += not is_fed
                posed = f" frame {done} of {len(frames)}" if len(frames) > 1 else ""
                context.workspace.status_text_set(f"Exporting{posed}   Esc: Cancel")
                yield
        except GeneratorExit:  # what is posed as a whole is written as a whole
            pass
        finally:
            posing.close()
            context.workspace.status_text_set(None)
        if not is_fed:
            with suppress(Empty):
                while True:
                    waiting.get_nowait()
            waiting.put(Cancelled())
        try:
            written.result()
            self.inform(f"Exported to {path}")
        except Cancelled:
            sentence = f"Export cancelled after {done} of {len(frames)} frames"
            self.report({"WARNING"}, sentence)


@lru_cache(maxsize=8)
def _size(avatar: Path, modified: float, format: str, frames: int) -> int:
    """`Format.size` of an avatar file last modified at this time. Raises StgaError."""
    return FORMATS[format].size(read_avatar(avatar), frames)


# What of the scene plays in a web page


def scene_playback(context: Any, head: Any, frames: range, motion_only: bool) -> Playback:
    """The scene's frame rate, camera, selection groups and upward direction, in the head's
    space; without a camera where it has no perspective one."""
    to_head = np.linalg.inv(np.array(head.matrix_world, np.float64))
    up = to_head[:3, :3] @ [0.0, 0.0, 1.0]
    up /= np.linalg.norm(up)
    views: dict[str, Camera] = {}
    with suppress(StgaError):
        found = scene_camera(context.evaluated_depsgraph_get())
        pose = to_head @ found.camera_to_world_gl
        pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
        lens = (found.fl_x, found.fl_y, found.cx, found.cy)
        name = bpy.path.display_name(context.scene.camera.name, has_ext=False)
        views[name] = camera_from_gl(pose, found.width, found.height, *lens)
    selection = training_selection(head)
    everything = np.ones(len(head.data.polygons), bool)
    return Playback(
        title=head.name,
        fps=frames_per_second(context.scene),
        views=views,
        up=(float(up[0]), float(up[1]), float(up[2])),
        selection=[selection.get(frame, everything) for frame in frames] if selection else None,
        motion_only=motion_only,
    )


def exact_motion(head: Any, frames: range, warn: Warn) -> FlameSequence | None:
    """FLAME parameters of what the head plays; None without a rig, or, after saying why, where they
    would not give the scene's meshes."""
    if common.rig_or_none(head) is None:
        return None
    reasons: list[str] = []
    motion = None
    try:
        motion = sample_motion(head, own_motion(head), frames, reasons.append)
    except StgaError as error:
        reasons.append(str(error))
    if reasons:
        warn(f"No sliders in the page: {reasons[0]}")
    return None if reasons else motion


# Other files


class ExportPerformance(Action, bpy.types.Operator, ExportHelper):
    """Export expression, jaw, eyes and neck of the head in the scene's frame range as curves of
    ARKit's 52 shapes"""

    bl_label = "Export ARKit Curves"
    needs = (common.needs_rig,)

    filepath: options.path("File", "CSV file in Live Link Face's layout", options=ONCE)
    filename_ext = ".csv"
    filter_glob: options.file_filter(".csv")

    def run(self, context: Any) -> None:
        head = head_of(context)
        frames = scene_frames(context.scene)
        path = file_path(self.filepath, "curves").with_suffix(self.filename_ext)
        motion = sample_motion(head, own_motion(head), frames, self.warn)
        fps = frames_per_second(context.scene)
        write_performance(path, captured_performance(motion, head.name, fps))
        self.inform(f"Exported {len(frames)} frames to {path}")


class ExportCameras(Action, bpy.types.Operator, ExportHelper):
    """Export cameras at the current frame as calibration of footage: each has a folder, video or
    image of its name"""

    filename_ext = ".json"
    filepath: options.path("File", "transforms.json in the folder of the footage", options=ONCE)
    filter_glob: options.file_filter(".json")
    selected_only: options.boolean(
        "Selected Only", "Export selected cameras instead of all in the scene"
    )

    def run(self, context: Any) -> None:
        objects = context.selected_objects if self.selected_only else context.scene.objects
        cameras = [thing for thing in objects if thing.type == "CAMERA"]
        path = file_path(self.filepath, "export")
        count = export_cameras(path, cameras, context.evaluated_depsgraph_get())
        self.inform(f"Exported {count} cameras to {path}")


class ExportHeadModel(Action, bpy.types.Operator, ExportHelper):
    """Export the active object's shape keys as a head model for tracking; keys named identity… make
    other persons"""

    filename_ext = ".npz"
    filter_glob: options.file_filter(".npz")

    needs = (
        need(
            lambda context: has_shape_keys(context.active_object), "Select a mesh with shape keys"
        ),
    )

    def run(self, context: Any) -> None:
        path = file_path(self.filepath, "head model")
        write_linear_model(path, shape_arrays(*shape_key_model(context.active_object)))
