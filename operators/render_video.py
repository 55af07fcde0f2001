"""Renders a video of the shown splats: Blender records what each image shows, a worker renders and
encodes it."""

import shutil
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from math import pi
from pathlib import Path
from typing import Any, ClassVar

import bpy
from bpy_extras.io_utils import ExportHelper

from ..stga_addon.capture.camera import Camera, to_and_fro
from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.blender import RenderRecording
from ..stga_addon.jobs.render import Render
from ..stga_addon.jobs.table import Kind
from ..stga_addon.raster.posed_splats import PosedSplats
from ..stga_addon.render.video import Recorder, check_output
from ..stga_addon.scene.cameras import scene_camera, turntable_cameras
from ..stga_addon.scene.gpu.renderer import has_gpu_context
from ..stga_addon.scene.layers import SceneLayer
from ..stga_addon.scene.objects import frames_per_second
from ..stga_addon.scene.render.drawn_video import DrawnVideo
from ..stga_addon.scene.render.scene_splats import SplatCache, visible_layers
from ..stga_addon.scene.render.view_transform import srgb_background
from ..stga_addon.worker.status import status_writer
from . import ids, monitor
from .common import (
    file_filter,
    file_path,
    is_head,
    path_property,
    polled,
    reporting,
    scene_settings,
)
from .options import option_property
from .render_engine import render_device
from .request import needs_idle, start
from .training_python import has_training_python, training_python

RECORDING = "recording.bin"
RECORDING_INTERVAL_S = 0.001
"""Between two recorded images, so that Blender handles its events."""


class RenderVideo(bpy.types.Operator, ExportHelper):
    """Render the splats as an MP4 video or as PNGs, in a process beside Blender: go on working
    meanwhile"""

    bl_idname = ids.RENDER_VIDEO
    bl_label = "Render Video"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    filepath: path_property(
        "File or Folder", "An .mp4 file, or a folder for PNGs", options={"SKIP_SAVE"}
    )
    path: bpy.props.EnumProperty(
        name="Camera", description="How the camera moves",
        items=(
            (
                "turntable",
                "Turntable",
                "The scene's camera moves around the head, which plays its motion to and fro",
            ),
            (
                "scene",
                "As Animated",
                "The scene's camera and animation, from the scene's first to its last frame",
            ),
        ),
    )  # fmt: skip
    format: bpy.props.EnumProperty(
        name="Format", description="What is written",
        items=(
            ("mp4", "MP4", "One video file, H.264"),
            ("png", "PNG Sequence", "One PNG per image; with alpha where the film is transparent"),
        ),
    )  # fmt: skip
    angle: bpy.props.FloatProperty(
        name="Angle",
        description="Of the turntable, to both sides; 0: the sides that the capture's cameras saw",
        subtype="ANGLE", min=0.0, max=2 * pi, default=0.0,
    )  # fmt: skip
    seconds: option_property(Render, "seconds", min=0.1, soft_max=60.0)
    filename_ext = ""
    filter_glob: file_filter(".mp4")

    _recording: Any = None

    @classmethod
    def poll(cls, context: Any) -> bool:
        if not polled(cls, scene_settings(context).splats is not None, "Show an avatar first"):
            return False
        if not needs_idle(cls, context, Kind.VIDEO):
            return False
        message = (
            "Needs a GPU, or a Python that trains, which is chosen in the add-on's preferences"
        )
        return polled(cls, has_training_python(context) or has_gpu_context(), message)

    def check(self, context: Any) -> bool:
        """Keep the path's extension in step with the format; whether it changed."""
        path = self.filepath.removesuffix(".mp4")
        if self.format == "mp4":
            path = bpy.path.ensure_ext(path, ".mp4")
        changed, self.filepath = path != self.filepath, path
        return changed

    @reporting
    def execute(self, context: Any) -> set[str]:
        output = file_path(self.filepath, "video").resolve()
        if self.format == "mp4" and output.suffix.lower() != ".mp4":
            output = output.with_name(f"{output.name}.mp4")
        if self.format == "png" and output.suffix.lower() == ".mp4":
            output = output.with_suffix("")
        self._python = training_python(context) if has_training_python(context) else None
        frames = self._frames(context)
        self._recording = _Recording(
            context, output, frames, self._cameras(context, len(frames)), drawn=self._python is None
        )
        if bpy.app.background:
            return self._record_and_render(context)
        self._timer = context.window_manager.event_timer_add(
            RECORDING_INTERVAL_S, window=context.window
        )
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def _record_and_render(self, context: Any) -> set[str]:
        """Without a window: nothing is left but the video."""
        try:
            while self._recording.record_next():
                pass
            self._recording.render(self._python)
            self.report({"INFO"}, f"Rendered {self._recording.output}")
            return {"FINISHED"}
        finally:
            self._recording.discard()

    def modal(self, context: Any, event: Any) -> set[str]:
        if event.type == "ESC" or self._recording.is_cancelled:
            self.cancel(context)
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        try:
            if self._recording.record_next():
                return {"RUNNING_MODAL"}
            self._recording.render(self._python)
            context.window_manager.event_timer_remove(self._timer)
            return {"FINISHED"}
        except StgaError as error:
            self.cancel(context)
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        except Exception:
            self.cancel(context)
            raise

    def cancel(self, context: Any) -> None:
        """End the recording, also when Blender quits or loads another file meanwhile; the file
        dialog that is left has none."""
        if self._recording is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._recording.discard()

    def _frames(self, context: Any) -> list[int]:
        scene = context.scene
        frames = list(range(scene.frame_start, scene.frame_end + 1))
        if self.path == "scene":
            return frames
        return to_and_fro(
            frames, max(len(frames), round(self.seconds * frames_per_second(scene)), 1)
        )

    def _cameras(self, context: Any, count: int) -> Sequence[Camera] | None:
        """One camera per frame of `count`, None for the scene's own at each frame."""
        if self.path == "scene":
            return None
        settings = scene_settings(context)
        subject = settings.head if is_head(settings.head) else settings.splats
        return turntable_cameras(subject, context.evaluated_depsgraph_get(), count, self.angle)


class _Recording:
    """Records the images of a video, one scene frame at a time; the scene's frame is restored at
    the end.

    Until the worker takes over, this process is that of the request in the folder, and writes its
    status.
    """

    def __init__(
        self,
        context: Any,
        output: Path,
        frames: Sequence[int],
        cameras: Sequence[Camera] | None,
        drawn: bool,
    ) -> None:
        self._scene, self._frames, self._cameras = context.scene, frames, cameras
        self._shown = context.scene.frame_current, context.scene.frame_subframe
        self._view_layer = context.view_layer
        self._cache, self._posed = SplatCache(), (-1, list[PosedSplats]())
        self._layers: list[SceneLayer] = []
        self._recorded, self.output, self.is_cancelled = 0, output, False
        check_output(output)
        self._files = ExitStack()
        with ExitStack() as failed:
            self.folder = _temporary_folder()
            failed.callback(shutil.rmtree, self.folder, ignore_errors=True)
            self._status = self._files.enter_context(status_writer(self.folder))
            failed.callback(self._files.close)
            self._recorder = Recorder(self.folder / RECORDING)
            self._drawn = (
                DrawnVideo(self.folder, output, srgb_background(context.scene)) if drawn else None
            )
            self._status.update(0.0, "Recording")
            monitor.follow(context.scene, Kind.VIDEO, output, self.folder)
            monitor.check_now(context.scene, Kind.VIDEO)
            failed.pop_all()

    def record_next(self) -> bool:
        """Record an image; whether there are more. Raises StgaError, as where the head is gone."""
        frame = self._frames[self._recorded]
        # The recorded scene, which the window may no longer show.
        with bpy.context.temp_override(scene=self._scene, view_layer=self._view_layer):
            if frame != self._posed[0]:
                self._scene.frame_set(frame)
                self._cache.light.forget_casters()
                self._layers = visible_layers(bpy.context.evaluated_depsgraph_get(), self._cache)
            given = None if self._cameras is None else self._cameras[self._recorded]
            camera = given or scene_camera(bpy.context.evaluated_depsgraph_get())
        if frame != self._posed[0] or any(layer.relit for layer in self._layers):
            self._posed = frame, [layer.posed(camera.position) for layer in self._layers]
        if self._drawn is None:
            self._recorder.add(self._posed[1], camera)
        else:
            self._drawn.add(self._layers, camera)
        self._recorded += 1
        self.is_cancelled = self._status.update(self._recorded / len(self._frames), "Recording")
        return self._recorded < len(self._frames)

    def render(self, python: str | None) -> None:
        """End the recording, and start its worker; without one, encode what was drawn.

        Raises StgaError on a full disk, and as `request.start` does.
        """
        self._restore()
        self._recorder.close()
        if python is None:
            assert self._drawn is not None
            self._drawn.encode(frames_per_second(self._scene))
            self._files.close()
            monitor.check_now(self._scene, Kind.VIDEO)
            return
        self._files.close()
        request = RenderRecording(
            self._recorder.path,
            self.output,
            len(self._frames),
            frames_per_second(self._scene),
            srgb_background(self._scene),
            render_device(),
        )
        start(self._scene, request, python, self.folder)

    def discard(self) -> None:
        """End the recording and remove its files."""
        self._restore()
        with suppress(StgaError):  # a full disk
            self._recorder.close()
        self._files.close()
        with suppress(ReferenceError):  # another file was opened
            monitor.dismiss(self._scene, Kind.VIDEO)
        shutil.rmtree(self.folder, ignore_errors=True)

    def _restore(self) -> None:
        frame, subframe = self._shown
        with suppress(ReferenceError):  # another file was opened
            self._scene.frame_set(frame, subframe=subframe)


def _temporary_folder() -> Path:
    try:
        return Path(tempfile.mkdtemp(prefix="stga_video_"))
    except OSError as error:
        raise StgaError(
            f"{tempfile.gettempdir()}: cannot be written ({error.strerror or error})"
        ) from error
