"""Tracks a head through footage in a worker process beside Blender, and imports what it tracked."""

from pathlib import Path
from typing import Any, ClassVar

import bpy
from bpy.app.handlers import persistent

from ..stga_addon.errors import StgaError
from ..stga_addon.requests.folder import remove_request, request_folder
from ..stga_addon.requests.values import SolveAgain, Track
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.tracking.folder import is_flame
from ..stga_addon.worker.status import WorkerSnapshot, WorkerState, request_cancel
from . import ids, monitor
from .common import file_path, reporting, scene_settings
from .environment import training_python
from .export_head_model import write_shape_key_model
from .request import start, wait_for_result

HEAD_MODEL = "head_model.npz"
"""In the capture's folder: the shape keys that it was tracked with."""


def path_property(name: str, description: str, subtype: str = "FILE_PATH", **more: Any) -> Any:
    """A path of the operator, and of the panel that calls it."""
    return bpy.props.StringProperty(name=name, description=description, subtype=subtype, options=PATH_OPTIONS, **more)


def footage_property() -> Any:
    return path_property("Footage", "Folder with a folder of images or a video for each camera; or one video")


def cameras_property() -> Any:
    return path_property(
        "Cameras",
        "Calibration: COLMAP, Metashape, RealityCapture or transforms.json; empty: the one in the footage's folder",
    )


def model_property() -> Any:
    return path_property(
        "Head Model",
        "FLAME (.pkl, .npz), linear model (.npz) or morph targets (.glb); empty: the active object's shape keys",
    )


def detector_property() -> Any:
    return path_property("Detector", "Google's face_landmarker.task; empty: the network that comes with mediapipe")


def mattes_property() -> Any:
    return bpy.props.EnumProperty(
        name="Mattes",
        description="Masks that tell the person from the background",
        items=(
            ("auto", "Auto", "Made for frames without a mask"),
            ("none", "None", "Only those of the footage"),
            ("folder", "Folder", "Those of a folder, named as the images"),
        ),
    )


def matte_folder_property() -> Any:
    return path_property("Matte Folder", "Folder of masks, named as the images of the footage", "DIR_PATH")


def focal_property() -> Any:
    return bpy.props.FloatProperty(
        name="Focal Length", description="In pixels, of a single camera without calibration; 0: a guess", min=0.0
    )


def start_property() -> Any:
    return bpy.props.IntProperty(name="Start", description="First frame of the footage, counted from 0", min=0)


def stop_property() -> Any:
    return bpy.props.IntProperty(name="Stop", description="Frame to stop before; 0: all", min=0)


def step_property() -> Any:
    return bpy.props.IntProperty(name="Step", description="Use every nth frame", min=1, default=1)


class TrackFootage(bpy.types.Operator):
    """Track the head that the footage shows, in a process that continues when Blender is closed, and import it"""

    bl_idname = ids.TRACK_FOOTAGE
    bl_label = "Track Footage"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    footage: footage_property()
    model: model_property()
    directory: path_property("Capture", "Folder for the tracked capture", "DIR_PATH")
    cameras: cameras_property()
    detector: detector_property()
    landmarks: bpy.props.StringProperty(
        name="Landmarks",
        description="Folder with landmark files of another detector",
        subtype="DIR_PATH",
        options=PATH_OPTIONS | {"SKIP_SAVE"},
    )
    focal: focal_property()
    start: start_property()
    stop: stop_property()
    step: step_property()
    mattes: mattes_property()
    matte_folder: matte_folder_property()
    python: bpy.props.StringProperty(
        name="Python",
        description="Python interpreter that tracks; empty: the training environment of the preferences",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_idle_tracking(cls, context)

    @reporting
    def execute(self, context: Any) -> set[str]:
        python = training_python(context, self.python)
        out, footage = file_path(self.directory, "capture").resolve(), file_path(self.footage, "footage")
        if self.model:
            model = file_path(self.model, "head model").resolve()
        else:
            model = out / HEAD_MODEL
            write_shape_key_model(context, model)

        def optional(value: str, what: str) -> Path | None:
            return file_path(value, what).resolve() if value else None

        request = Track(
            footage.resolve(),
            model,
            out,
            optional(self.cameras, "cameras"),
            optional(self.landmarks, "landmarks"),
            optional(self.detector, "detector"),
            self.focal or None,
            self.start,
            self.stop or None,
            self.step,
            mattes=str(file_path(self.matte_folder, "mattes").resolve()) if self.mattes == "folder" else self.mattes,
        )
        return start_tracking(self, context, out, request, python)


class CancelTracking(bpy.types.Operator):
    """Stop tracking; the landmarks of whole cameras are kept, and Track continues with the others"""

    bl_idname = ids.CANCEL_TRACKING
    bl_label = "Cancel Tracking"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        if is_tracking(context.scene):
            return True
        cls.poll_message_set("Nothing is being tracked")
        return False

    @reporting
    def execute(self, context: Any) -> set[str]:
        folder = request_folder(tracked_folder(context.scene))
        request_cancel(folder)
        monitor.monitor_worker(folder)
        return {"FINISHED"}


class DismissTracking(bpy.types.Operator):
    """Remove the status and log of the last tracking; what it tracked stays"""

    bl_idname = ids.DISMISS_TRACKING
    bl_label = "Dismiss"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        if not scene_settings(context).tracking_capture:
            cls.poll_message_set("Nothing was tracked in this scene yet")
            return False
        return needs_idle_tracking(cls, context)

    @reporting
    def execute(self, context: Any) -> set[str]:
        settings = scene_settings(context)
        remove_request(request_folder(Path(settings.tracking_capture)))
        settings.tracking_capture, settings.tracking_error = "", ""
        return {"FINISHED"}


def start_tracking(operator: Any, context: Any, out: Path, request: Track | SolveAgain, python: str) -> set[str]:
    """Start a worker for the request, whose capture is imported when it is done; without a window, wait for that.

    Raises StgaError, without a window also with the worker's error.
    """
    folder = request_folder(out)
    process = start(folder, request, python)
    settings = scene_settings(context)
    settings.tracking_capture, settings.tracking_model = str(out), str(request.model)
    settings.tracking_pending, settings.tracking_error = True, ""
    monitor.monitor_worker(folder, process)
    if not bpy.app.background:
        _follow(context.scene)
        return {"FINISHED"}
    wait_for_result(folder, process)
    _import(context.scene)
    if settings.tracking_error:
        raise StgaError(settings.tracking_error)
    operator.report({"INFO"}, f"Tracked {out}")
    return {"FINISHED"}


def tracked_folder(scene: Any) -> Path:
    """The folder that the scene's last tracking writes into."""
    return Path(getattr(scene, ids.SETTINGS).tracking_capture)


def tracking_snapshot(scene: Any) -> WorkerSnapshot:
    """Status of the scene's last tracking as the timer last saw it."""
    if not getattr(scene, ids.SETTINGS).tracking_capture:
        return WorkerSnapshot()
    return monitor.snapshot(request_folder(tracked_folder(scene)))


def is_tracking(scene: Any) -> bool:
    return tracking_snapshot(scene).state.is_alive


def needs_idle_tracking(operator: Any, context: Any) -> bool:
    """Poll: whether nothing is being tracked in this scene."""
    if is_tracking(context.scene):
        operator.poll_message_set("Tracking is running; cancel it first")
        return False
    return True


def _follow(scene: Any) -> None:
    """Import what the scene's worker tracks when it has ended."""
    uid, folder = scene.session_uid, request_folder(tracked_folder(scene))

    def when_ended() -> bool:
        for each in bpy.data.scenes:
            if each.session_uid == uid and getattr(each, ids.SETTINGS).tracking_pending:
                getattr(each, ids.SETTINGS).tracking_pending = False
                if monitor.inspect_status(folder).state == WorkerState.FINISHED:
                    _import(each)
        return True

    monitor.monitor_worker(folder, when_ended=when_ended)


def _import(scene: Any) -> None:
    """Import the scene's tracked capture; `tracking_error` says what failed."""
    settings, out = getattr(scene, ids.SETTINGS), tracked_folder(scene)
    settings.tracking_pending = False
    flame = settings.tracking_model if is_flame(out) else ""
    window = next((each for each in bpy.context.window_manager.windows if each.scene == scene), None)
    try:
        with bpy.context.temp_override(**({"window": window} if window is not None else {"scene": scene})):
            bpy.ops.stga.import_capture("EXEC_DEFAULT", window is not None, directory=str(out), flame=flame)
    except RuntimeError as error:  # what the operator reported
        settings.tracking_error = str(error).strip().removeprefix("Error: ")


@persistent
def _after_load(_: Any) -> None:
    for scene in bpy.data.scenes:
        if scene.library is None and getattr(scene, ids.SETTINGS).tracking_pending and monitor.has_timer():
            _follow(scene)


def register() -> None:
    bpy.app.handlers.load_post.append(_after_load)


def unregister() -> None:
    bpy.app.handlers.load_post.remove(_after_load)
