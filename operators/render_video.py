"""Rendering: the engine and the GPU display of splats, and videos, of which Blender records what
each image shows; a worker renders and encodes it."""

import shutil
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from math import pi
from pathlib import Path
from typing import Any

import bpy
from bpy_extras.io_utils import ExportHelper

from ..stga_addon.capture.camera import Camera, to_and_fro
from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.blender import RenderRecording
from ..stga_addon.jobs.render import Render
from ..stga_addon.jobs.table import Kind
from ..stga_addon.progress import Progress
from ..stga_addon.raster.posed_splats import PosedSplats
from ..stga_addon.render.video import Recorder, check_output
from ..stga_addon.scene import light
from ..stga_addon.scene.cameras import scene_camera, turntable_cameras
from ..stga_addon.scene.gpu.renderer import has_gpu_context
from ..stga_addon.scene.layers import SceneLayer
from ..stga_addon.scene.objects import frames_per_second
from ..stga_addon.scene.render import engine, viewport_display
from ..stga_addon.scene.render.drawn_video import DrawnVideo
from ..stga_addon.scene.render.scene_splats import SplatCache, visible_layers
from ..stga_addon.scene.render.view_transform import srgb_background
from ..stga_addon.worker.status import status_writer
from . import monitor, options
from .common import Action, file_path, is_head, need, preferences, scene_frames
from .options import ONCE
from .request import idle, start
from .training_python import has_training_python, training_python

RECORDING = "recording.bin"
RECORDING_INTERVAL_S = 0.001
"""Between two recorded images, so that Blender handles its events."""


def render_device() -> str:
    """The rendering device in the preferences, as `render.device.Composer` takes it."""
    stored = preferences(bpy.context)
    return str(stored.render_device) if stored else "auto"


def _has_renderer(context: Any) -> bool:
    return has_training_python(context) or has_gpu_context()


class RenderVideo(Action, bpy.types.Operator, ExportHelper):
    """Render the splats as an MP4 video or as PNGs, in a process beside Blender: go on working
    meanwhile"""

    needs = (
        need(lambda context: context.scene.stga.splats, "Show an avatar first"),
        idle(Kind.VIDEO),
        need(_has_renderer, "Needs a GPU, or a Python that trains: choose one in the preferences"),
    )

    filepath: options.path("File or Folder", "An .mp4 file, or a folder for PNGs", options=ONCE)
    path: options.choice(
        "Camera",
        "How the camera moves",
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
    )
    format: options.choice(
        "Format",
        "What is written",
        ("mp4", "MP4", "One video file, H.264"),
        ("png", "PNG Sequence", "One PNG per image; with alpha where the film is transparent"),
    )
    angle: options.number(
        "Angle",
        "Of the turntable, to both sides; 0: the sides that the capture's cameras saw",
        subtype="ANGLE",
        min=0.0,
        max=2 * pi,
    )
    seconds: options.field(Render, "seconds", min=0.1, soft_max=60.0)
    filename_ext = ""
    filter_glob: options.file_filter(".mp4")
    _recording: Any = None

    def check(self, context: Any) -> bool:
        """Keep the path's extension in step with the format; whether it changed."""
        path = self.filepath.removesuffix(".mp4")
        if self.format == "mp4":
            path = bpy.path.ensure_ext(path, ".mp4")
        changed, self.filepath = path != self.filepath, path
        return changed

    def run(self, context: Any) -> set[str] | None:
        output = file_path(self.filepath, "video").resolve()
        is_video, manager = output.suffix.lower() == ".mp4", context.window_manager
        if self.format == "mp4" and not is_video:
            output = output.with_name(f"{output.name}.mp4")
        if self.format == "png" and is_video:
            output = output.with_suffix("")
        self._python = training_python(context) if has_training_python(context) else None
        frames, drawn = self._frames(context.scene), self._python is None
        cameras = self._cameras(context, len(frames))
        self._recording = _Recording(context, output, frames, cameras, drawn)
        if bpy.app.background:
            self._record_and_render()
            return None
        self._timer = manager.event_timer_add(RECORDING_INTERVAL_S, window=context.window)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def _record_and_render(self) -> None:
        """Without a window: nothing is left but the video."""
        try:
            while self._recording.record_next():
                pass
            self._recording.render(self._python)
            self.inform(f"Rendered {self._recording.output}")
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

    def _frames(self, scene: Any) -> list[int]:
        frames = list(scene_frames(scene))
        if self.path == "scene":
            return frames
        asked = round(self.seconds * frames_per_second(scene))
        return to_and_fro(frames, max(len(frames), asked))

    def _cameras(self, context: Any, count: int) -> Sequence[Camera] | None:
        """One camera per frame of `count`, None for the scene's own at each frame."""
        if self.path == "scene":
            return None
        settings = context.scene.stga
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
            background = srgb_background(context.scene)
            self._drawn = DrawnVideo(self.folder, output, background) if drawn else None
            self._status.report(Progress(stage="Recording"))
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
        share = self._recorded / len(self._frames)
        self.is_cancelled = self._status.report(Progress(share, "Recording"))
        return self._recorded < len(self._frames)

    def render(self, python: str | None) -> None:
        """End the recording, and start its worker; without one, encode what was drawn.

        Raises StgaError on a full disk, and as `request.start` does.
        """
        self._restore()
        self._recorder.close()
        scene, fps, count = self._scene, frames_per_second(self._scene), len(self._frames)
        if python is None:
            assert self._drawn is not None
            self._drawn.encode(fps)
            self._files.close()
            monitor.check_now(scene, Kind.VIDEO)
            return
        self._files.close()
        how = (count, fps, srgb_background(scene), render_device())
        start(scene, RenderRecording(self._recorder.path, self.output, *how), python, self.folder)

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
        problem = f"cannot be written ({error.strerror or error})"
        raise StgaError(f"{tempfile.gettempdir()}: {problem}") from error


def register() -> None:
    light.register()
    engine.register(lambda: training_python(bpy.context), render_device)
    viewport_display.register()


def unregister() -> None:
    viewport_display.unregister()
    engine.unregister()
    light.unregister()
