"""A video in the making in the panel: its progress, its end, and the button that starts one."""

from typing import Any

from ..operators import ids, monitor
from ..operators.environment import has_training_python
from ..operators.render_video import video_of
from ..stga_addon.worker.status import WorkerState
from .failure import draw_failure
from .text import draw_text


def draw_video(layout: Any, context: Any) -> None:
    """Draw the button Render Video, or what the last video has come to."""
    video = video_of(context.scene)
    if video is None:
        layout.operator(ids.RENDER_VIDEO, text="Render Video…", icon="RENDER_ANIMATION")
        if not has_training_python(context):
            draw_text(layout, context, "Render Video needs a training environment", "INFO")
        return
    if video.is_recording:
        _draw_progress(layout, video.recorded / video.images, "Recording")
        return
    now = monitor.snapshot(video.folder)
    if now.state.is_alive:
        _draw_progress(layout, now.status.progress, now.status.detail or "Starting")
        return
    box = layout.box()
    row = box.row(align=True)
    if now.state.failed:
        row.label(text="Video failed", icon="ERROR")
        draw_failure(box, context, now.status.error, now.log_tail, video.folder)
    elif now.state == WorkerState.CANCELLED:
        row.label(text="Video cancelled", icon="INFO")
    else:
        row.operator("wm.path_open", text=f"Open {video.output.name}", icon="PLAY").filepath = str(video.output)
    row.operator(ids.DISMISS_VIDEO, text="", icon="X")
    if now.state == WorkerState.FINISHED:
        draw_text(box, context, str(video.output.parent), "FILE_FOLDER")


def _draw_progress(layout: Any, share: float, text: str) -> None:
    row = layout.row(align=True)
    row.progress(factor=share, text=text)
    row.operator(ids.CANCEL_VIDEO, text="", icon="CANCEL")
