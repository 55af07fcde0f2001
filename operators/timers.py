"""Timers of what goes on beside the interface."""

from contextlib import suppress
from typing import Protocol

import bpy

from .common import describe


def has_timer() -> bool:
    """Whether Blender has a window, and so runs timers."""
    return not bpy.app.background


class Watched(Protocol):
    """What has a timer of its own."""

    def tick(self) -> float | None:
        """Do a little; seconds until the next call, None: that was the last."""

    def close(self) -> None:
        """End: file or extension is gone, or `tick` has raised."""


_watched: list[Watched] = []


def watch(thing: Watched) -> None:
    """Call its `tick` from a timer until that returns None, the file is closed, or the extension
    ends."""

    def tick() -> float | None:
        interval = None
        if thing in _watched:
            try:
                interval = thing.tick()
            except Exception as error:
                print(describe(error))
                thing.close()
        if interval is None:
            unwatch(thing)
        return interval

    _watched.append(thing)
    if has_timer():
        bpy.app.timers.register(tick, first_interval=0.0, persistent=True)


def unwatch(thing: Watched) -> None:
    """Call it no more; without an effect where it is not called."""
    with suppress(ValueError):
        _watched.remove(thing)


def close_watched() -> None:
    """End all that is watched."""
    for thing in list(_watched):
        thing.close()
    _watched.clear()
