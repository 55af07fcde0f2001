"""Driving the head live: starting and stopping to listen, calibrating, recording, choosing among
senders."""

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.driving.head_map import head_map
from ..stga_addon.driving.live.sources import (
    LOOPBACK,
    SOURCES,
    Receiver,
    Recording,
    leaves_this_machine,
)
from ..stga_addon.driving.open_motion import MAX_SMOOTHING_S, MotionOptions, trained_range
from ..stga_addon.errors import StgaError
from ..stga_addon.scene.rig.motion import LivePose, store_range, stored_range
from . import ids, live_session
from .apply_motion import exchange_property
from .common import (
    capture_of,
    file_path,
    flame_of,
    head_of,
    needs_rig,
    needs_rig_or_shapes,
    path_property,
    polled,
    reporting,
    rig_or_none,
    scene_settings,
    tell,
)
from .live_session import LiveSession, Target, live_options
from .options import option_property

MAX_PORT = 65535


class DriveOptions:
    """What the panel stores about driving live; annotations of `ui.properties.DriveSettings`."""

    source: bpy.props.EnumProperty(
        name="Source", description="What sends the face",
        items=[(name, source.label, source.hint) for name, source in SOURCES.items()],
    )  # fmt: skip
    address: bpy.props.StringProperty(
        name="Listen On",
        description=f"Address of this computer on which packets are received. {LOOPBACK}: from "
        "this computer alone; 0.0.0.0: from every computer and phone of the network",
        default=LOOPBACK,
    )
    port: bpy.props.IntProperty(
        name="Port", description="UDP port; 0: the source's usual one", min=0, max=MAX_PORT,
        default=0,
    )  # fmt: skip
    phone: bpy.props.StringProperty(
        name="Phone", description="IP address that the app on the phone shows", default=LOOPBACK
    )
    strength: option_property(MotionOptions, "strength", soft_max=2.0)
    smoothing: bpy.props.FloatProperty(
        name="Smoothing", description="Time constant in seconds; the head follows later by as much",
        min=0.0, soft_max=0.2, max=MAX_SMOOTHING_S,
    )  # fmt: skip
    stay_trained: bpy.props.FloatProperty(
        name="Stay Trained",
        description="Lead expression, jaw and eyes softly back to the range of the head's own "
        "recording; 1: fully",
        min=0.0, max=1.0,
    )  # fmt: skip
    mirror: option_property(MotionOptions, "mirror")
    exchange_jaw: exchange_property("jaw")
    exchange_mouth: exchange_property("mouth")
    takes: path_property(
        "Takes",
        "Folder for recorded takes (CSV); one that begins with // lies beside the .blend file",
        "DIR_PATH", default="//stga_takes",
    )  # fmt: skip


class MeasureRange(bpy.types.Operator):
    """Measure the range of expression, jaw and eyes in the recording that the head was trained
    on"""

    bl_idname = ids.MEASURE_RANGE
    bl_label = "Measure Trained Range"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    poll = classmethod(needs_rig)

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = head_of(context)
        own = flame_of(capture_of(head), head.name)
        store_range(head, trained_range([own.frame(timestep) for timestep in own.timesteps]))
        return {"FINISHED"}


class DriveLive(bpy.types.Operator):
    """Let a phone or program move the head; Esc over the viewport stops it. Keyframes are only made
    by Record"""

    bl_idname = ids.DRIVE_LIVE
    bl_label = "Drive Live"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    poll = classmethod(needs_rig_or_shapes)

    @reporting
    def execute(self, context: Any) -> set[str]:
        head, settings = head_of(context), scene_settings(context).drive
        source = SOURCES[settings.source]
        if (
            leaves_this_machine(source, settings.address, settings.phone)
            and not bpy.app.online_access
        ):
            raise StgaError(
                f"{source.label}: receives from other devices, but online access is off in "
                f"Blender's preferences (System > Network); allow it, or listen on {LOOPBACK}"
            )
        rig = rig_or_none(head)
        pose = LivePose(head, rig)
        found = trained = None
        if pose.takes_frames:
            own = flame_of(capture_of(head), head.name)
            found = head_map(own, head.name)
            trained = stored_range(head)
            if trained is None and own.timesteps:
                trained = trained_range([own.frame(timestep) for timestep in own.timesteps])
                store_range(head, trained)
        receiver = Receiver(source, settings.address, settings.port, settings.phone)
        live_session.start(Target(context.scene.name, pose, found, trained), receiver)
        return {"FINISHED"}


class _NeedsSession:
    """Mixin: an operator on the session that is running."""

    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        return polled(
            cls,
            live_session.session() is not None,
            "No source is listened to; choose Drive Live first",
        )

    @property
    def running(self) -> LiveSession:
        found = live_session.session()
        assert found is not None
        return found


class StopLive(_NeedsSession, bpy.types.Operator):
    """Stop listening; the head goes back to its own animation, and a recording is kept"""

    bl_idname = ids.STOP_LIVE
    bl_label = "Stop"

    @reporting
    def execute(self, context: Any) -> set[str]:
        running = self.running
        recording, running.recording = running.recording, None
        running.stop()
        if recording is not None and len(recording) > 1:
            _apply(self, context, recording)
        return {"FINISHED"}


class CalibrateLive(_NeedsSession, bpy.types.Operator):
    """Take the performer's face and head of this moment as the resting ones, which do not move the
    head"""

    bl_idname = ids.CALIBRATE_LIVE
    bl_label = "Set Neutral"

    @reporting
    def execute(self, context: Any) -> set[str]:
        self.running.calibrate()
        return {"FINISHED"}


class RecordLive(_NeedsSession, bpy.types.Operator):
    """Record what is received; again: write the take as CSV and apply it to the head as a new
    action"""

    bl_idname = ids.RECORD_LIVE
    bl_label = "Record"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    @reporting
    def execute(self, context: Any) -> set[str]:
        running = self.running
        if running.recording is None:
            running.start_recording(context.scene.frame_current)
            return {"FINISHED"}
        recording, running.recording = running.recording, None
        _apply(self, context, recording)
        running.show_again()
        return {"FINISHED"}


class FollowLive(_NeedsSession, bpy.types.Operator):
    """Follow this sender instead of the other"""

    bl_idname = ids.FOLLOW_LIVE
    bl_label = "Follow"

    address: bpy.props.StringProperty(name="Address", description="IP address of the sender")
    subject: bpy.props.StringProperty(name="Subject", description="Its name for itself")

    @reporting
    def execute(self, context: Any) -> set[str]:
        self.running.stream.follow((self.address, self.subject))
        return {"FINISHED"}


def takes_folder(context: Any) -> tuple[Path, str]:
    """The folder of takes, which is made, and a warning where it does not last, or "". Raises
    StgaError."""
    folder = scene_settings(context).drive.takes
    warning = ""
    if folder.startswith("//") and not bpy.data.filepath:
        path = Path(bpy.app.tempdir)
        warning = (
            f"{path}: is emptied when Blender ends; save the .blend file to keep takes beside it"
        )
    else:
        path = file_path(folder, "takes")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StgaError(f"{path}: cannot be made ({error.strerror or error})") from error
    return path, warning


def _apply(operator: Any, context: Any, recording: Recording) -> None:
    """Write the take and apply it. Raises StgaError."""
    folder, warning = takes_folder(context)
    if warning:
        tell(operator, "WARNING", warning)
    path = live_session.write_take(recording, folder)
    options = live_options(scene_settings(context).drive, recording.rest is not None)
    try:
        bpy.ops.stga.apply_motion(
            filepath=str(path),
            start=recording.start,
            strength=options.strength,
            neutral=options.neutral,
            smoothing=options.smoothing,
            mirror=options.mirror,
            stay_trained=options.stay_trained or 0.0,
        )
    except RuntimeError as error:
        raise StgaError(str(error).strip().removeprefix("Error: ")) from error
    operator.report({"INFO"}, f"Recorded {len(recording)} faces: {path}")


_keymap_items: list[tuple[Any, Any]] = []


def register() -> None:
    """Let Esc over a 3D viewport stop the session; without a window, Blender has no keys."""
    keys = bpy.context.window_manager.keyconfigs.addon
    if keys is not None:
        keymap = keys.keymaps.new(name="3D View", space_type="VIEW_3D")
        _keymap_items.append((keymap, keymap.keymap_items.new(ids.STOP_LIVE, "ESC", "PRESS")))


def unregister() -> None:
    running = live_session.session()
    if running is not None:
        running.stop()
    for keymap, item in _keymap_items:
        keymap.keymap_items.remove(item)
    _keymap_items.clear()
