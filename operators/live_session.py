"""The live session: what a phone or program sends, on the scene's head, at most one in this
Blender."""

import gc
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..stga_addon.driving.head_map import HeadMap
from ..stga_addon.driving.inverse import write_performance
from ..stga_addon.driving.live.sources import (
    REQUEST_INTERVAL_S,
    RESTING_PACKETS,
    Receiver,
    Recording,
    Stream,
    eased,
    row_of,
)
from ..stga_addon.driving.open_motion import (
    MotionOptions,
    TrainedRange,
    at_strength,
    corrected,
    frames_of,
)
from ..stga_addon.driving.performance import FacePacket, Performance
from ..stga_addon.errors import StgaError
from ..stga_addon.scene.rig.motion import LivePose
from . import monitor
from .apply_motion import exchanged_pairs

TICK_S = 1 / 60
MIN_WAIT_S = 0.001
PANEL_INTERVAL_S = 0.2
"""At which the panel's figures are drawn anew."""
SLOWEST_TICKS = 600


@dataclass(frozen=True)
class Target:
    """A head that can be driven: how it is posed, its map and the range that its avatar was trained
    on."""

    scene: str
    pose: LivePose
    map: HeadMap | None
    trained: TrainedRange | None


class LiveSession:
    """Receives packets, poses the head and records. `monitor`'s timer calls `tick`."""

    def __init__(self, target: Target, receiver: Receiver) -> None:
        self.receiver, self.stream = receiver, Stream(receiver.source)
        self.rest: Performance | None = None
        self.recording: Recording | None = None
        self.scene = target.scene
        self._target = target
        self._recent: deque[FacePacket] = deque(maxlen=RESTING_PACKETS)
        self._shown: Performance | None = None
        self._shown_at = self._drawn_at = float("-inf")
        self._ticks: deque[float] = deque(maxlen=SLOWEST_TICKS)

    def tick(self) -> float | None:
        """Read what has arrived and pose the head; seconds until the next call, None where the head
        is gone."""
        begin = monotonic()
        if not self._target.pose.is_there or self.scene not in bpy.data.scenes:
            self.close()
            return None
        silent = self.stream.silent_s(begin)
        if silent is None or silent > REQUEST_INTERVAL_S:
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
            self._show(newest, begin)
        if begin - self._drawn_at >= PANEL_INTERVAL_S:
            self._drawn_at = begin
            monitor.redraw()
        took = monotonic() - begin
        self._ticks.append(took)
        return max(MIN_WAIT_S, TICK_S - took)

    @property
    def slowest_tick_s(self) -> float:
        """Of the last ten seconds."""
        return max(self._ticks, default=0.0)

    def calibrate(self) -> None:
        """The performer's face of now is the resting one. Raises StgaError before the first
        face."""
        if not self._recent:
            raise StgaError("Drive: no face has been received yet")
        self.rest = row_of(*self._recent)

    def show_again(self) -> None:
        """Pose the head as it was shown last, after an animation has posed it."""
        if self._shown is not None and self._target.pose.is_there:
            self._pose(self._shown)

    def start_recording(self, frame: int) -> None:
        self.recording = Recording(frame, self.rest, self._options().exchange)

    def close(self) -> None:
        """Stop listening; the head stays as it is."""
        global _session
        self.receiver.close()
        monitor.unwatch(self)
        if _session is self:
            _session = None
            gc.unfreeze()
        if _show_again in bpy.app.handlers.frame_change_post:
            bpy.app.handlers.frame_change_post.remove(_show_again)

    def stop(self) -> None:
        """Stop listening and give the head back to its own animation."""
        self.close()
        if self._target.pose.is_there:
            self._target.pose.restore()
            scene = bpy.data.scenes.get(self.scene)
            if scene is not None:
                scene.frame_set(scene.frame_current)

    def _options(self) -> MotionOptions:
        return live_options(bpy.data.scenes[self.scene].stga.drive, self.rest is not None)

    def _show(self, packet: FacePacket, now: float) -> None:
        options = self._options()
        row = corrected(row_of(packet), options, self.rest)
        self._shown = eased(self._shown, row, now - self._shown_at, options.smoothing)
        self._shown_at = now
        self._pose(self._shown)

    def _pose(self, row: Performance) -> None:
        target, options = self._target, self._options()
        if target.map is not None:
            frames, _ = frames_of(target.map, row, options, target.trained)
            target.pose.set_frame(frames[0])
        else:
            target.pose.set_weights(at_strength(row, options).weights[0])
        for window in bpy.context.window_manager.windows:
            for area in window.screen.areas:
                if area.type == "VIEW_3D":
                    area.tag_redraw()


def live_options(settings: Any, calibrated: bool) -> MotionOptions:
    """The panel's options of a live source, whose resting face is taken off where it is
    calibrated."""
    names = ("strength", "smoothing", "mirror", "stay_trained")
    chosen = {name: getattr(settings, name) for name in names}
    neutral = "calibrated" if calibrated else "none"
    return MotionOptions(neutral=neutral, exchange=exchanged_pairs(settings), **chosen)


_session: LiveSession | None = None


def session() -> LiveSession | None:
    """The session that is running, if any."""
    return _session


def start(target: Target, receiver: Receiver) -> LiveSession:
    """Start a session in place of the one that is running, if any."""
    global _session
    if _session is not None:
        _session.stop()
    _session = LiveSession(target, receiver)
    bpy.app.handlers.frame_change_post.append(_show_again)
    gc.freeze()  # a collection of all that Blender and its add-ons hold takes longer than a frame
    monitor.watch(_session)
    return _session


def write_take(recording: Recording, folder: Path) -> Path:
    """Write what was recorded as the next take of a folder. Raises StgaError for fewer than two
    packets, and where it cannot be written."""
    performance = recording.performance()
    if performance is None:
        raise StgaError("Record: fewer than two faces were received; nothing was recorded")
    number = 1
    while (path := folder / f"take_{number:03d}.csv").exists():
        number += 1
    write_performance(path, performance)
    return path


@persistent
def _show_again(scene: Any, depsgraph: Any) -> None:
    """The scene's own animation posed the head: pose it live again, so that it does not flicker
    between two packets.

    Rendered animations keep their own pose.
    """
    if _session is not None and scene.name == _session.scene and depsgraph.mode == "VIEWPORT":
        _session.show_again()
