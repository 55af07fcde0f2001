"""Redraws viewports whose render thread has finished an image, from a timer: bpy belongs to the main thread."""

from typing import Any
from weakref import ref

import bpy

from .viewport import ViewportRenderer

POLL_INTERVAL_S = 1 / 60

_active: dict[ViewportRenderer, "ref[Any]"] = {}
"""Renderers whose threads run, and the engines of their viewports; Blender frees an engine with its viewport."""


def redraw_when_rendered(renderer: ViewportRenderer, engine: Any) -> None:
    """Call `engine.tag_redraw()` for each image of the renderer, until its thread ends."""
    _active[renderer] = ref(engine)
    if not bpy.app.timers.is_registered(_poll):
        bpy.app.timers.register(_poll, first_interval=POLL_INTERVAL_S, persistent=True)


def stop() -> None:
    """End the timer and the render threads; waits for the images in progress."""
    if bpy.app.timers.is_registered(_poll):
        bpy.app.timers.unregister(_poll)
    for renderer in _active:
        renderer.cancel()
    for renderer in _active:
        renderer.join()
    _active.clear()


def _poll() -> float | None:
    """Redraw what has changed; returns the seconds until the next call, None once every thread has ended."""
    for renderer in list(_active):
        is_busy = renderer.is_busy()  # before the update is taken, so that the last one is not missed
        if not _redraw(renderer):
            renderer.cancel()
            del _active[renderer]
        elif not is_busy:
            del _active[renderer]
    return POLL_INTERVAL_S if _active else None


def _redraw(renderer: ViewportRenderer) -> bool:
    """Redraw the renderer's viewport if there is something new; False where the viewport was closed."""
    engine = _active[renderer]()
    if engine is None:
        return False
    try:
        if renderer.take_update():
            engine.tag_redraw()
    except ReferenceError:  # Blender has freed its part of the engine
        return False
    return True
