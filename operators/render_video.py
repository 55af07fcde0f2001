"""Rendering: the engine and the GPU display of splats, and videos, of which Blender records what
each image shows; a worker renders and encodes it."""

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from math import nan, pi
from pathlib import Path
from typing import Any

import bpy

from ..stga_addon.capture.camera import Camera, to_and_fro
from ..stga_addon.files import naming
from ..stga_addon.jobs.blender import RenderRecording
from ..stga_addon.jobs.monitor_state import Dismissed
from ..stga_addon.jobs.render import Render
from ..stga_addon.jobs.table import Kind
from ..stga_addon.progress import Cancelled, Progress
from ..stga_addon.raster.posed_splats import PosedSplats
from ..stga_addon.render.video import Recorder, check_output
from ..stga_addon.scene import light
from ..stga_addon.scene.cameras import scene_camera, turntable_cameras
from ..stga_addon.scene.evaluation import kept_evaluated
from ..stga_addon.scene.gpu.context import has_gpu_context
from ..stga_addon.scene.gpu.packing import View, in_range
from ..stga_addon.scene.layers import SceneLayer
from ..stga_addon.scene.objects import (
    Identity,
    SceneView,
    frame_kept,
    frames_per_second,
    is_rendering,
)
from ..stga_addon.scene.render import engine, viewport_display
from ..stga_addon.scene.render.drawn_video import DrawnVideo
from ..stga_addon.scene.render.scene_splats import SplatCache, all_layers, with_heads
from ..stga_addon.scene.render.view_transform import srgb_background
from ..stga_addon.scene.tags import is_head
from ..stga_addon.worker.status import status_writer
from . import monitor, options
from .common import (
    AtEnd,
    FileExport,
    StepGenerator,
    Stepwise,
    file_path,
    need,
    preferences,
    scene_frames,
)
from .options import ONCE
from .request import idle, start
from .training_python import has_training_python, training_python

RECORDING = "recording.bin"
"""File in the video's temporary folder with the recorded splats of each image."""
RECORDING_INTERVAL_S = 0.001
"""Interval between two recorded images, so that Blender handles its events."""


def render_device() -> str:
    """The rendering device in the preferences, as `render.composer.Composer` takes it."""
    stored = preferences(bpy.context)
    return str(stored.render_device) if stored else "auto"


class RenderVideo(Stepwise, bpy.types.Operator, FileExport):
    """Render the splats as an MP4 video or as PNGs, in a process beside Blender: go on working
    meanwhile"""

    needs = (
        need(lambda context: context.scene.stga.splats, "Show an avatar first"),
        idle(Kind.VIDEO),
        need(
            lambda context: has_training_python(context) or has_gpu_context(),
            "Needs a GPU, or a Python that trains: choose one in the preferences",
        ),
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
    others = "PASS_THROUGH"

    def check(self, context: Any) -> bool:
        """Keep the path's extension in step with the format; whether it changed."""
        path = self.filepath.removesuffix(".mp4")
        if self.format == "mp4":
            path = bpy.path.ensure_ext(path, ".mp4")
        changed = path != self.filepath
        self.filepath = path
        return changed

    def run(self, context: Any) -> set[str] | None:
        output = file_path(self.filepath, "video").resolve()
        is_video = output.suffix.lower() == ".mp4"
        if self.format == "mp4" and not is_video:
            output = output.with_name(f"{output.name}.mp4")
        if self.format == "png" and is_video:
            output = output.with_suffix("")
        python = training_python(context) if has_training_python(context) else None
        steps = self.record(context, output, python)
        next(steps)
        if not bpy.app.background:
            return self.begin(context, steps, RECORDING_INTERVAL_S)
        for _ in steps:
            pass
        self.inform(f"Rendered {output}")
        return None

    def _shots(self, context: Any) -> tuple[list[int], Sequence[Camera] | None]:
        """The frame and the camera of each image; no cameras: the scene's own."""
        scene = context.scene
        frames = list(scene_frames(scene))
        if self.path != "turntable":
            return frames, None
        asked = round(self.seconds * frames_per_second(scene))
        stga = scene.stga
        frames = to_and_fro(frames, max(len(frames), asked))
        subject = stga.head if is_head(stga.head) else stga.splats
        depsgraph = context.evaluated_depsgraph_get()
        return frames, turntable_cameras(subject, depsgraph, len(frames), self.angle)

    def record(self, context: Any, output: Path, python: str | None) -> StepGenerator:
        """Record the images, one a step; then a worker renders and encodes them, or, without a
        Python, Blender encodes what it has drawn. The scene's frame is restored.

        Until the worker takes over, this process is that of the request in the folder, and writes
        its status. Raises StgaError, as on a full disk or where head or scene are gone, and
        Cancelled.
        """
        scene = context.scene
        view = SceneView(context)
        frames, cameras = self._shots(context)
        check_output(output)
        fps = frames_per_second(scene)
        background = srgb_background(scene)
        with ExitStack() as kept:
            folder = _temporary_folder()
            kept.callback(shutil.rmtree, folder, ignore_errors=True)
            with ExitStack() as recording:
                recording.enter_context(frame_kept(view.scene))
                recording.enter_context(kept_evaluated(with_heads(scene)))
                status = recording.enter_context(status_writer(folder))
                recorder = Recorder(folder / RECORDING)
                recording.callback(recorder.close)
                drawn = DrawnVideo(folder, output, background) if python is None else None
                # what the worker takes is not known yet
                left = {} if drawn is not None else {"left_s": nan}
                status.report(Progress(stage="Recording"))
                monitor.follow(scene, Kind.VIDEO, output, folder)
                kept.callback(_dismiss, view.scene)
                monitor.check_now(scene, Kind.VIDEO)
                yield
                posed = list[PosedSplats]()
                images = _images(view, frames, cameras)
                for number in range(len(frames)):
                    yield from _while_rendering(status, number / len(frames), output)
                    layers, camera_view, is_new = next(images)
                    if drawn is not None:
                        drawn.add(layers, camera_view)
                    else:
                        if is_new or any(layer.relit for layer in layers):
                            posed = [layer.posed(camera_view.camera.position) for layer in layers]
                        recorder.add(
                            [in_range(each, camera_view) for each in posed], camera_view.camera
                        )
                    fraction = (number + 1) / len(frames)
                    if status.report(Progress(fraction, "Recording", figures=lambda: left)):
                        raise Cancelled(f"{output}: cancelled")
                    yield
                while is_rendering():  # Blender has one render at a time
                    yield
                if drawn is not None:
                    drawn.encode(fps)
            if drawn is None:
                how = (len(frames), fps, background, render_device())
                request = RenderRecording(recorder.path, output, *how)
                start(view.scene.get(), request, python, folder)
            else:
                monitor.check_now(view.scene.get(), Kind.VIDEO)
            if not bpy.app.background:
                kept.pop_all()


def _while_rendering(status: Any, fraction: float, output: Path) -> StepGenerator:
    """Wait while Blender renders: it sets frames itself, and would get ours."""
    while is_rendering():
        if status.report(Progress(fraction, "Waiting for the render")):
            raise Cancelled(f"{output}: cancelled")
        yield


def _images(
    view: SceneView, frames: Sequence[int], cameras: Sequence[Camera] | None
) -> Iterator[tuple[list[SceneLayer], View, bool]]:
    """What each image shows: layers, and by which view; and whether the layers are new. cameras:
    None: the scene's, which has their clip distances."""
    cache = SplatCache()
    before = None
    for number, frame in enumerate(frames):
        with view.in_context() as scene:
            is_new = frame != before or frame != scene.frame_current
            if is_new:
                scene.frame_set(frame)
                cache.frame_changed()
                layers = all_layers(bpy.context.evaluated_depsgraph_get(), cache)
            depsgraph = bpy.context.evaluated_depsgraph_get()
            camera = cameras[number] if cameras else scene_camera(depsgraph)
            camera_view = engine.camera_view(camera, scene.camera.evaluated_get(depsgraph))
        before = frame
        yield layers, camera_view, is_new


def _dismiss(scene: Identity) -> None:
    if (found := scene.find()) is not None:
        monitor.handle(found, Kind.VIDEO, Dismissed())


def _temporary_folder() -> Path:
    with naming(Path(tempfile.gettempdir())):
        return Path(tempfile.mkdtemp(prefix="stga_video_"))


def register(at_end: AtEnd) -> None:
    light.register()
    at_end(light.unregister)
    engine.register(lambda: training_python(bpy.context), render_device)
    at_end(engine.unregister)
    viewport_display.register()
    at_end(viewport_display.unregister)
