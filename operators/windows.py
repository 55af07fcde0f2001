"""What Blender's windows show: redrawn panels, the opened sidebar, a step to undo."""

from itertools import count

import bpy

from ..stga_addon.jobs.monitor_state import CHECK_INTERVAL_S
from ..stga_addon.scene.avatar_scene import open_sidebar, window_screens
from . import timers
from .common import TAB

MAX_SIDEBAR_ATTEMPTS = 10


def push_undo(what: str = "Show Result") -> None:
    """Let undo come back to what is in the file now."""
    if bpy.ops.ed.undo_push.poll():
        bpy.ops.ed.undo_push(message=what)


def redraw() -> None:
    for screen in window_screens():
        for area in screen.areas:
            if area.type in ("VIEW_3D", "PREFERENCES"):
                for region in area.regions:
                    if area.type == "PREFERENCES" or region.type == "UI":
                        region.tag_redraw()


def show_panel() -> None:
    """Open the sidebar at the add-on's tab, from a timer and for a few seconds at most."""
    attempts = count(1)

    def attempt() -> float | None:
        is_over = open_sidebar(TAB, window_screens()) or next(attempts) >= MAX_SIDEBAR_ATTEMPTS
        return None if is_over else CHECK_INTERVAL_S

    if timers.has_timer():
        bpy.app.timers.register(attempt, first_interval=CHECK_INTERVAL_S)
