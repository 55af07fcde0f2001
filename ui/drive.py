"""The Drive panel: a phone or program moves the head."""

from time import monotonic
from typing import Any, ClassVar

import bpy

from ..operators import ids, live_session
from ..operators.common import scene_settings
from ..stga_addon.driving.live.sources import LOOPBACK, SOURCES
from ..stga_addon.jobs.table import Kind
from .motion import MotionPanel
from .request import draw_running
from .sidebar import SidebarPanel
from .text import draw_text

SILENT_S = 1.0


class DrivePanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_drive"
    bl_label = "Drive"
    bl_parent_id = MotionPanel.bl_idname
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    def draw(self, context: Any) -> None:
        layout, settings = self.layout, scene_settings(context).drive
        running = live_session.session()
        if running is None:
            _draw_source(layout, context, settings)
            layout.operator(ids.DRIVE_LIVE, icon="PLAY")
        else:
            layout.operator(ids.STOP_LIVE, icon="PAUSE")
            _draw_status(layout.column(align=True), running)
            row = layout.row(align=True)
            row.operator(ids.CALIBRATE_LIVE, icon="PIVOT_ACTIVE")
            recording = running.recording
            text = "Record" if recording is None else f"Stop Recording ({len(recording)})"
            row.operator(ids.RECORD_LIVE, text=text, icon="REC", depress=recording is not None)
        column = layout.column(align=True)
        for name in ("strength", "smoothing", "stay_trained"):
            column.prop(settings, name)
        column.prop(settings, "mirror")
        row = column.row(align=True)
        row.prop(settings, "exchange_jaw", text="Swap Jaw", toggle=True)
        row.prop(settings, "exchange_mouth", text="Swap Mouth", toggle=True)
        layout.prop(settings, "takes")
        if not draw_running(layout, context, Kind.PERFORMANCE):
            layout.operator(ids.DRIVE_VIDEO, text="Drive from Video…", icon="FILE_MOVIE")


def _draw_source(layout: Any, context: Any, settings: Any) -> None:
    source = SOURCES[settings.source]
    layout.prop(settings, "source")
    if source.request:
        layout.prop(settings, "phone")
    layout.prop(settings, "address")
    layout.prop(settings, "port", text=f"Port (0: {source.port})")
    draw_text(layout, context, source.hint)
    if settings.address == LOOPBACK:
        draw_text(
            layout,
            context,
            "Only programs on this computer are heard; for a phone, listen on 0.0.0.0",
        )


def _draw_status(column: Any, running: Any) -> None:
    now, stream = monotonic(), running.stream
    silent, health = stream.silent_s(now), stream.health(now)
    if silent is None:
        column.label(text=f"Waiting on port {running.receiver.port}", icon="INFO")
    elif silent > SILENT_S:
        column.label(text=f"Nothing received for {silent:.0f} s", icon="ERROR")
    elif not stream.has_face:
        column.label(text="No face in the picture", icon="ERROR")
    else:
        column.label(text=f"{health.rate:.0f} packets per second", icon="CHECKMARK")
    lost = "not numbered" if health.lost is None else str(health.lost)
    column.label(text=f"Lost: {lost}   Late: {health.late}   Foreign: {health.foreign}")
    delay = "no clock" if health.delay_s is None else f"+{1000 * health.delay_s:.0f} ms"
    column.label(text=f"Network: {delay}   Slowest pose: {1000 * running.slowest_tick_s:.0f} ms")
    if len(stream.senders) < 2:
        return
    for sender in sorted(stream.senders):
        row = column.row()
        row.label(text=" ".join(filter(None, sender)))
        button = row.operator(ids.FOLLOW_LIVE, depress=sender == stream.followed)
        button.address, button.subject = sender
