"""A video in the panel: its progress, its end, and the button that starts one."""

from typing import Any

from ..operators import ids, monitor
from ..stga_addon.requests.monitor_state import Kind
from ..stga_addon.worker.status import WorkerState
from .request import draw_end, draw_running
from .text import draw_text


def draw_video(layout: Any, context: Any) -> None:
    """Draw the button Render Video, or what the last video has come to."""
    if draw_running(layout, context, Kind.VIDEO):
        return
    video = monitor.state_of(context.scene, Kind.VIDEO)
    if video.subject is None:
        layout.operator(ids.RENDER_VIDEO, text="Render Video…", icon="RENDER_ANIMATION")
        return
    box = draw_end(layout, context, video)
    if video.snapshot.state == WorkerState.FINISHED:
        opened = box.operator("wm.path_open", text=f"Open {video.subject.name}", icon="PLAY")
        opened.filepath = str(video.subject)
        draw_text(box, context, str(video.subject.parent), "FILE_FOLDER")
