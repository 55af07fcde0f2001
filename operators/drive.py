"""Driving the head: live by a phone or program, at most one in this Blender, with calibration and
recording; and by a video of a face."""

import gc
import tempfile
from collections import deque
from contextlib import suppress
from itertools import count
from pathlib import Path
from time import monotonic
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..stga_addon.driving import open_motion
from ..stga_addon.driving.head_map import HeadMap, head_map
from ..stga_addon.driving.inverse import write_performance
from ..stga_addon.driving.live import sources
from ..stga_addon.driving.live.sources import LOOPBACK, SOURCES
from ..stga_addon.driving.open_motion import MotionOptions
from ..stga_addon.driving.performance import FacePacket, Performance
from ..stga_addon.driving.performers import RECORDED_SUFFIXES
from ..stga_addon.errors import StgaError
from ..stga_addon.files import naming
from ..stga_addon.jobs.convert_motion import SHAPES_SUFFIX, ConvertMotion
from ..stga_addon.jobs.table import Kind
from ..stga_addon.scene import tags
from ..stga_addon.scene.avatar_scene import viewports, window_screens
from ..stga_addon.scene.objects import (
    Identity,
    after_render,
    frames_per_second,
    show_progress,
)
from ..stga_addon.scene.record import capture_of, stored_path
from ..stga_addon.scene.rig.keyframes import check_sliders
from ..stga_addon.scene.rig.motion import LivePose, stored_range
from ..stga_addon.training.run.folder import read_run
from . import common, options, timers
from .apply_motion import TAKEN_OVER, MotionProperties, measured_range
from .common import Action, Edit, FileImport, file_path, head_of, need, recorded_motion, rig_or_none
from .options import ONCE
from .request import idle, start
from .training_python import training_python
from .windows import redraw

MAX_PORT = 65535
"""Largest number of a UDP port, which has 16 bits."""
TICK_S = 1 / 60
"""Interval at which the head is posed: 60 times a second."""
MIN_WAIT_S = 0.001
"""Least wait after a tick, so that Blender handles its events."""
PANEL_INTERVAL_S = 0.2
"""Interval at which the panel's figures are drawn anew."""
SLOWEST_TICKS = 600
"""Ticks of the last ten seconds, of which the panel shows the slowest."""
LEFT_TAKES = "stga_takes"
"""Folder beside other temporary files for takes that have no other place as a session ends."""


class DriveSettings(bpy.types.PropertyGroup, MotionProperties):
    """What the panel stores about driving live."""

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
    port: options.integer("Port", "UDP port; 0: the source's standard one", min=0, max=MAX_PORT)
    phone: options.text("Phone", "IP address that the app on the phone shows", default=LOOPBACK)
    smoothing: options.number(
        "Smoothing",
        "Time constant in seconds; the head follows later by as much",
        min=0.0,
        soft_max=0.2,
        max=open_motion.MAX_SMOOTHING_S,
    )
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
    needs = (common.needs_rig, common.needs_editable_head)

    def run(self, context: Any) -> None:
        head = head_of(context)
        measured_range(head, recorded_motion(head))


# Live


class LiveSession:
    """Receives packets, poses the head and records. A timer calls `tick` (`watch`).

    found, trained: the head's map and the range that its avatar was trained on; None where shape
    keys of ARKit's names are posed.
    """

    def __init__(
        self,
        scene: Identity,
        pose: LivePose,
        found: HeadMap | None,
        trained: open_motion.TrainedRange | None,
        receiver: sources.Receiver,
    ) -> None:
        self.scene = scene
        self.receiver = receiver
        self.stream = sources.Stream(receiver.source)
        self.rest: Performance | None = None
        self.recording: sources.Recording | None = None
        self._said = ""
        self._pose = pose
        self._map = found
        self._trained = trained
        self._recent: deque[FacePacket] = deque(maxlen=sources.RESTING_PACKETS)
        self._shown: Performance | None = None
        self._shown_at = self._drawn_at = float("-inf")
        self.ticks_s: deque[float] = deque(maxlen=SLOWEST_TICKS)

    def tick(self) -> float | None:
        """Read what has arrived and pose the head; seconds until the next call, None where head or
        scene are gone."""
        begin = monotonic()
        if not self._pose.is_there or self.scene.find() is None:
            self.close()
            return None
        silent = self.stream.silent_s(begin)
        if silent is None or silent > sources.REQUEST_INTERVAL_S:
            self.receiver.ask(begin)
        newest = None
        for address, data in self.receiver.read():
            packet = self.stream.receive(address, data, begin)
            if packet is None:
                continue
            newest = packet
            self._recent.append(packet)
            if self.recording is not None:
                self.recording.add(packet, begin)
        # Blender crashes where a mesh changes while it renders.
        if newest is not None and not bpy.app.is_job_running("RENDER"):
            options = self.options()
            since = begin - self._shown_at
            row = open_motion.corrected(sources.row_of(newest), options, self.rest)
            self._shown = sources.eased(self._shown, row, since, options.smoothing)
            self._shown_at = begin
            self.show_again()
        if begin - self._drawn_at >= PANEL_INTERVAL_S:
            self._drawn_at = begin
            redraw()
        took = monotonic() - begin
        self.ticks_s.append(took)
        return max(MIN_WAIT_S, TICK_S - took)

    def calibrate(self) -> None:
        """The performer's face of now is the resting one. Raises StgaError before the first
        face."""
        if not self._recent:
            raise StgaError("Drive: no face has been received yet")
        self.rest = sources.row_of(*self._recent)

    def show_again(self) -> None:
        """Pose the head as it was shown last, after an animation has posed it."""
        if self._shown is None or not self._pose.is_there:
            return
        options = self.options()
        if self._map is None:
            self._pose.set_weights(open_motion.at_strength(self._shown, options).weights[0])
        else:
            frames = self._map.frames(self._shown)
            frames, _ = open_motion.finished(frames, options, self._trained)
            self._pose.set_frame(frames[0])
        for area in viewports(window_screens()):
            area.tag_redraw()

    def options(self) -> MotionOptions:
        """The panel's; the resting face is taken off where it is calibrated."""
        options: MotionOptions = self.scene.get().stga.drive.motion_options(_neutral(self.rest))
        return options

    def write_take(self, folder: Path) -> Path:
        """Write what is being recorded as the next take in the folder, and record no more. Raises
        StgaError, and records on, where it cannot be written."""
        assert self.recording is not None
        performance = self.recording.performance()
        if performance is None:
            self.recording = None
            raise StgaError("Record: fewer than two faces were received; nothing was recorded")
        names = (f"take_{number:03d}.csv" for number in count(1))
        with naming(folder):
            path = next(folder / name for name in names if not (folder / name).exists())
        write_performance(path, performance)
        self.recording = None
        return path

    def save_recording(self) -> None:
        """Write what is being recorded into the takes, else where it lasts, and say where: its head
        or file are going."""
        faces = len(self.recording or ())
        if faces < 2:
            return
        scene = self.scene.find()
        folders = [Path(tempfile.gettempdir()) / LEFT_TAKES]
        with suppress(StgaError):
            folder, warning = takes_folder(scene) if scene is not None else (folders[0], "")
            folders[:0] = [] if warning else [folder]
        for folder in folders:
            try:
                path = self.write_take(folder)
                kept = f"is kept, but not applied, as driving has ended: {path}"
                self._said = f"The take of {faces} faces {kept}"
                break
            except StgaError as error:
                self._said = f"The take of {faces} faces is lost: {error}"
        print(self._said)
        self._show_said()

    def _show_said(self) -> None:
        manager = bpy.context.window_manager
        if manager is not None and self._said:
            manager.stga_message = self._said
            manager.stga_failed = True

    def close(self) -> None:
        """Stop listening, and save what is being recorded; the head stays as it is."""
        global _session
        if _session is not self:
            return
        _session = None
        gc.unfreeze()
        self.receiver.close()
        timers.unwatch(self)
        bpy.app.handlers.frame_change_post.remove(_show_again)
        self.save_recording()
        self._show_said()  # also in the window of a file that was opened

    def stop(self) -> None:
        """Stop listening and give the head back to its own animation, after a render that goes
        on."""
        self.close()
        after_render(self._give_back)

    def _give_back(self) -> None:
        if self._pose.is_there:
            self._pose.restore()
            scene = self.scene.find()
            if scene is not None:
                scene.frame_set(scene.frame_current)

    def apply_take(self, path: Path, recording: sources.Recording) -> None:
        """Apply a take to the head that was driven, a step to undo. Raises StgaError."""
        try:
            self._apply_take(path, recording)
        except StgaError as error:
            raise StgaError(f"Recorded {path}, but it was not applied: {error}") from error

    def _apply_take(self, path: Path, recording: sources.Recording) -> None:
        scene = self.scene.get()
        if scene.stga.head != self._pose.head.get():
            raise StgaError("the panel holds another head than the one that was driven")
        chosen = {name: getattr(scene.stga.drive, name) for name in TAKEN_OVER}
        chosen["neutral"] = _neutral(recording.rest)
        place = {} if bpy.context.scene == scene else {"scene": scene}
        with bpy.context.temp_override(**place):
            apply = bpy.ops.stga.apply_motion
            undoable = bpy.context.window is not None
            start = recording.start
            common.call(apply, "EXEC_DEFAULT", undoable, filepath=str(path), start=start, **chosen)


def _neutral(rest: Performance | None) -> str:
    """What a performance is relative to whose resting face was calibrated, or was not (None)."""
    return "none" if rest is None else "calibrated"


_session: LiveSession | None = None


def session() -> LiveSession | None:
    """The session that is running, if any."""
    return _session


def running_session() -> LiveSession:
    """The session of operators that poll for one."""
    assert _session is not None
    return _session


def stop_session() -> None:
    if _session is not None:
        _session.stop()


@persistent
def _before_load(*_: Any) -> None:
    """The takes lie beside the file that is still open."""
    if _session is not None:
        _session.save_recording()


@persistent
def _show_again(scene: Any, depsgraph: Any) -> None:
    """The scene's own animation posed the head: pose it live again, so that it does not flicker
    between two packets.

    Rendered animations keep their own pose.
    """
    if _session is None or depsgraph.mode != "VIEWPORT":
        return
    if scene.session_uid == _session.scene.uid:
        _session.show_again()


class DriveLive(Action, bpy.types.Operator):
    """Let a phone or program move the head; Esc over the viewport stops it. Keyframes are only made
    by Record"""

    needs = (common.needs_rig_or_shapes,)

    def run(self, context: Any) -> None:
        global _session
        head = head_of(context)
        settings = context.scene.stga.drive
        source = SOURCES[settings.source]
        where = (settings.address, settings.phone)
        if sources.leaves_this_machine(source, *where) and not bpy.app.online_access:
            raise StgaError(
                f"{source.label}: receives from other devices, but online access is off in "
                f"Blender's preferences (System > Network); allow it, or listen on {LOOPBACK}"
            )
        pose = LivePose(head, common.rig_or_shapes(head))
        found = trained = None
        if pose.takes_frames:
            motion = recorded_motion(head)
            show_progress(0.1)
            found = head_map(motion, head.name)
            check_sliders(head, found.expressions)
            show_progress(0.9)
            trained = stored_range(head) or measured_range(head, motion)
        receiver = sources.Receiver(source, settings.address, settings.port, settings.phone)
        stop_session()
        _session = LiveSession(Identity(context.scene), pose, found, trained, receiver)
        bpy.app.handlers.frame_change_post.append(_show_again)
        gc.freeze()  # a collection of all that Blender's add-ons hold takes longer than a frame
        timers.watch(_session)


class _OfSession(Action):
    """Mixin of operators on the session that is running."""

    needs = (need(lambda _: _session, "No source is listened to; choose Drive Live first"),)

    def write_take(self: Any, running: LiveSession) -> Path:
        """End the recording with a file. Raises StgaError, and records on, where it cannot be
        written."""
        faces = len(running.recording or ())
        try:
            folder, warning = takes_folder(running.scene.get())
            path = running.write_take(folder)
        except StgaError as error:
            if running.recording is None:
                raise
            raise StgaError(f"{error}; the recording goes on, choose another folder") from error
        if warning:
            self.warn(warning)
        self.inform(f"Recorded {faces} faces: {path}")
        return path


class StopLive(_OfSession, bpy.types.Operator):
    """Stop listening; the head goes back to its own animation, and a recording is kept"""

    bl_label = "Stop"

    def run(self, context: Any) -> None:
        running = running_session()
        recording = running.recording
        if recording is None or len(recording) < 2:
            running.stop()
            return
        path = self.write_take(running)
        running.stop()
        running.apply_take(path, recording)


class CalibrateLive(_OfSession, bpy.types.Operator):
    """Take the performer's face and head of this moment as the resting ones, which do not move the
    head"""

    bl_label = "Set Neutral"

    def run(self, context: Any) -> None:
        running_session().calibrate()


class RecordLive(_OfSession, bpy.types.Operator):
    """Record what is received; again: write the take as CSV and apply it to the head as a new
    action"""

    bl_label = "Record"

    def run(self, context: Any) -> None:
        running = running_session()
        recording = running.recording
        if recording is None:
            frame = context.scene.frame_current
            exchange = running.options().exchange
            running.recording = sources.Recording(frame, running.rest, exchange)
            return
        running.apply_take(self.write_take(running), recording)
        running.show_again()


class FollowLive(_OfSession, bpy.types.Operator):
    """Follow this sender instead of the other"""

    bl_label = "Follow"

    address: options.text("Address", "IP address of the sender")
    subject: options.text("Subject", "Its name for itself")

    def run(self, context: Any) -> None:
        running_session().stream.follow((self.address, self.subject))


def takes_folder(scene: Any) -> tuple[Path, str]:
    """The folder of takes, made here, and a warning where it does not last, or ""."""
    folder = scene.stga.drive.takes
    warning = ""
    if folder.startswith("//") and not bpy.data.filepath:
        path = Path(bpy.app.tempdir)
        remedy = "save the .blend file to keep takes beside it"
        warning = f"{path}: is emptied when Blender ends; {remedy}"
    else:
        path = file_path(folder, "takes")
    with naming(path, "made"):
        path.mkdir(parents=True, exist_ok=True)
    return path, warning


# By a video


class DriveVideo(Action, bpy.types.Operator, FileImport):
    """Find the motion of the face in a video, write it as a file into the takes, and apply it to
    the head"""

    bl_label = "Drive from Video"
    needs = (idle(Kind.PERFORMANCE), common.needs_rig_or_shapes)

    avatar: options.field(
        ConvertMotion, "avatar", "Track with Avatar", subtype="DIR_PATH", options=ONCE
    )
    filter_glob: options.file_filter(*RECORDED_SUFFIXES)

    def invoke(self, context: Any, event: Any) -> set[str]:
        run = context.scene.stga.run_folder
        if not self.avatar and common.is_run(run):
            self.avatar = run
        return super().invoke(context, event)

    def run(self, context: Any) -> None:
        video = file_path(self.filepath, "video")
        head = head_of(context)
        if video.suffix.lower() not in RECORDED_SUFFIXES:
            raise StgaError(
                f"{video}: is no recording of a face; expected {', '.join(RECORDED_SUFFIXES)}"
            )
        folder, _ = takes_folder(context.scene)
        given = common.given_values(self, ConvertMotion, "avatar")
        suffix = SHAPES_SUFFIX
        is_trained_on = bool(given) and rig_or_none(head) is not None
        run = Path(bpy.path.abspath(stored_path(head, tags.RUN)))
        if is_trained_on and (
            given["avatar"] == run.resolve()
            or read_run(given["avatar"]).capture == capture_of(head)
        ):
            # exact, a timestep for each frame
            suffix = ".npz"
            given["fps"] = frames_per_second(context.scene)
        names = (video.stem, *(f"{video.stem}_{number}" for number in count(2)))
        output = next(path for name in names if not (path := folder / f"{name}{suffix}").exists())
        start(context.scene, ConvertMotion(video, output, **given), training_python(context))


def register(at_end: common.AtEnd) -> None:
    at_end(stop_session)
    common.register_handlers(at_end, (bpy.app.handlers.load_pre, _before_load))
