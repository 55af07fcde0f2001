"""Driving the head: live by a phone or program, with calibration and recording, and by a video of a
face."""

from itertools import count
from pathlib import Path
from typing import Any

import bpy

from ..stga_addon.driving.head_map import head_map
from ..stga_addon.driving.live.sources import (
    LOOPBACK,
    SOURCES,
    Receiver,
    leaves_this_machine,
)
from ..stga_addon.driving.open_motion import MAX_SMOOTHING_S, MotionOptions
from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.convert_motion import SHAPES_SUFFIX, ConvertMotion
from ..stga_addon.jobs.table import Kind
from ..stga_addon.scene import tags
from ..stga_addon.scene.objects import show_progress
from ..stga_addon.scene.rig.motion import LivePose, stored_range
from ..stga_addon.tracking.footage.sources import VIDEO_SUFFIXES, is_video
from ..stga_addon.training.run.folder import has_run, read_run
from . import live_session, options
from .apply_motion import exchange_property, own_range, stay_trained_property
from .common import (
    Action,
    Edit,
    FileImport,
    call,
    file_path,
    given_values,
    head_of,
    need,
    needs_rig,
    needs_rig_or_shapes,
    own_motion,
    rig_or_none,
)
from .live_session import LiveSession, Target, live_options
from .options import ONCE
from .request import idle, start
from .training_python import training_python

MAX_PORT = 65535


class DriveOptions:
    """What the panel stores about driving live; annotations of `ui.properties.DriveSettings`."""

    source: options.choice(
        "Source",
        "What sends the face",
        *((name, source.label, source.hint) for name, source in SOURCES.items()),
    )
    address: options.text(
        "Listen On",
        f"Address of this computer on which packets are received. {LOOPBACK}: from this computer "
        "alone; 0.0.0.0: from every computer and phone of the network",
        default=LOOPBACK,
    )
    port: options.integer("Port", "UDP port; 0: the source's usual one", min=0, max=MAX_PORT)
    phone: options.text("Phone", "IP address that the app on the phone shows", default=LOOPBACK)
    strength: options.field(MotionOptions, "strength", soft_max=2.0)
    smoothing: options.number(
        "Smoothing",
        "Time constant in seconds; the head follows later by as much",
        min=0.0,
        soft_max=0.2,
        max=MAX_SMOOTHING_S,
    )
    stay_trained: stay_trained_property()
    mirror: options.field(MotionOptions, "mirror")
    exchange_jaw: exchange_property("jaw")
    exchange_mouth: exchange_property("mouth")
    takes: options.path(
        "Takes",
        "Folder for recorded takes (CSV); one that begins with // lies beside the .blend file",
        "DIR_PATH",
        default="//stga_takes",
    )


class MeasureRange(Edit, bpy.types.Operator):
    """Measure the range of expression, jaw and eyes in the recording that the head was trained
    on"""

    bl_label = "Measure Trained Range"
    needs = (needs_rig,)

    def run(self, context: Any) -> None:
        head = head_of(context)
        own_range(head, own_motion(head))


# Live


class DriveLive(Action, bpy.types.Operator):
    """Let a phone or program move the head; Esc over the viewport stops it. Keyframes are only made
    by Record"""

    needs = (needs_rig_or_shapes,)

    def run(self, context: Any) -> None:
        head, settings = head_of(context), context.scene.stga.drive
        source = SOURCES[settings.source]
        leaves = leaves_this_machine(source, settings.address, settings.phone)
        if leaves and not bpy.app.online_access:
            raise StgaError(
                f"{source.label}: receives from other devices, but online access is off in "
                f"Blender's preferences (System > Network); allow it, or listen on {LOOPBACK}"
            )
        pose = LivePose(head, rig_or_none(head))
        found = trained = None
        if pose.takes_frames:
            own = own_motion(head)
            show_progress(0.1)
            found = head_map(own, head.name)
            show_progress(0.9)
            trained = stored_range(head) or own_range(head, own)
        receiver = Receiver(source, settings.address, settings.port, settings.phone)
        live_session.start(Target(context.scene.name, pose, found, trained), receiver)


class _OfSession(Action):
    """Mixin of operators on the session that is running."""

    needs = (
        need(lambda _: live_session.session(), "No source is listened to; choose Drive Live first"),
    )

    def run(self, context: Any) -> None:
        running = live_session.session()
        assert running is not None
        self.act(context, running)

    def keep_recording(self: Any, context: Any, running: LiveSession, min_faces: int) -> None:
        """End the recording: write the take and apply it. Raises StgaError."""
        recording, running.recording = running.recording, None
        if recording is None or len(recording) < min_faces:
            return
        folder, warning = takes_folder(context)
        if warning:
            self.warn(warning)
        path = live_session.write_take(recording, folder)
        options = live_options(context.scene.stga.drive, recording.rest is not None)
        names = ("strength", "neutral", "smoothing", "mirror")
        chosen = {name: getattr(options, name) for name in names}
        chosen |= {"start": recording.start, "stay_trained": options.stay_trained or 0.0}
        call(bpy.ops.stga.apply_motion, filepath=str(path), **chosen)
        self.inform(f"Recorded {len(recording)} faces: {path}")


class StopLive(_OfSession, bpy.types.Operator):
    """Stop listening; the head goes back to its own animation, and a recording is kept"""

    bl_label = "Stop"

    def act(self, context: Any, running: LiveSession) -> None:
        running.stop()
        self.keep_recording(context, running, min_faces=2)


class CalibrateLive(_OfSession, bpy.types.Operator):
    """Take the performer's face and head of this moment as the resting ones, which do not move the
    head"""

    bl_label = "Set Neutral"

    def act(self, context: Any, running: LiveSession) -> None:
        running.calibrate()


class RecordLive(_OfSession, Edit, bpy.types.Operator):
    """Record what is received; again: write the take as CSV and apply it to the head as a new
    action"""

    bl_label = "Record"

    def act(self, context: Any, running: LiveSession) -> None:
        if running.recording is None:
            running.start_recording(context.scene.frame_current)
            return
        self.keep_recording(context, running, min_faces=0)
        running.show_again()


class FollowLive(_OfSession, bpy.types.Operator):
    """Follow this sender instead of the other"""

    bl_label = "Follow"

    address: options.text("Address", "IP address of the sender")
    subject: options.text("Subject", "Its name for itself")

    def act(self, context: Any, running: LiveSession) -> None:
        running.stream.follow((self.address, self.subject))


def takes_folder(context: Any) -> tuple[Path, str]:
    """The folder of takes, which is made, and a warning where it does not last, or "". Raises
    StgaError."""
    folder, warning = context.scene.stga.drive.takes, ""
    if folder.startswith("//") and not bpy.data.filepath:
        path = Path(bpy.app.tempdir)
        remedy = "save the .blend file to keep takes beside it"
        warning = f"{path}: is emptied when Blender ends; {remedy}"
    else:
        path = file_path(folder, "takes")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StgaError(f"{path}: cannot be made ({error.strerror or error})") from error
    return path, warning


# By a video


class DriveVideo(Action, bpy.types.Operator, FileImport):
    """Find the motion of the face in a video, write it as a file into the takes, and apply it to
    the head"""

    bl_label = "Drive from Video"
    needs = (idle(Kind.PERFORMANCE), needs_rig_or_shapes)

    avatar: options.field(
        ConvertMotion, "avatar", "Track with Avatar", subtype="DIR_PATH", options=ONCE
    )
    filter_glob: options.file_filter(*VIDEO_SUFFIXES)

    def invoke(self, context: Any, event: Any) -> set[str]:
        run = context.scene.stga.run_folder
        if not self.avatar and run and has_run(Path(bpy.path.abspath(run))):
            self.avatar = run
        return super().invoke(context, event)

    def run(self, context: Any) -> None:
        video, head = file_path(self.filepath, "video"), head_of(context)
        if not is_video(video):
            raise StgaError(f"{video}: is no video; expected {', '.join(VIDEO_SUFFIXES)}")
        folder, _ = takes_folder(context)
        given, suffix = given_values(self, ConvertMotion, "avatar"), SHAPES_SUFFIX
        is_trained_on = bool(given) and rig_or_none(head) is not None
        if is_trained_on and read_run(given["avatar"]).capture == Path(head[tags.CAPTURE]):
            suffix, render = ".npz", context.scene.render  # exact, a timestep for each frame
            given["fps"] = render.fps / render.fps_base
        names = (video.stem, *(f"{video.stem}_{number}" for number in count(2)))
        output = next(path for name in names if not (path := folder / f"{name}{suffix}").exists())
        start(context.scene, ConvertMotion(video, output, **given), training_python(context))
