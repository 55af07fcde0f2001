"""Gives FLAME heads sliders named as ARKit's blend shapes."""

from contextlib import suppress
from threading import Thread
from typing import Any, ClassVar

import bpy
import numpy as np
from bpy.app.handlers import persistent

from ..stga_addon.capture.open import open_capture
from ..stga_addon.driving.head_map import HeadMap, head_map
from ..stga_addon.errors import StgaError
from ..stga_addon.scene.rig.keyframes import EXPRESSION_NAMES, add_shapes, has_shapes, head_shapes
from . import ids, live_session, monitor
from .common import (
    capture_source,
    flame_of,
    head_of,
    needs_rig,
    polled,
    reporting,
    rig_or_none,
    scene_settings,
)

POLL_INTERVAL_S = 0.3
Shapes = tuple[HeadMap, np.ndarray, np.ndarray]


class AddArkitControls(bpy.types.Operator):
    """Add 52 sliders named as ARKit's blend shapes: jawOpen, mouthSmileLeft, …"""

    bl_idname = ids.ADD_ARKIT_CONTROLS
    bl_label = "Add Face Sliders"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        has_names = EXPRESSION_NAMES in (scene_settings(context).head or {})
        return needs_rig(cls, context) and polled(cls, not has_names, "The head has its sliders")

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = head_of(context)
        add_shapes(head, *_compute_shapes(capture_source(head), head.name))
        return {"FINISHED"}


def _compute_shapes(source: tuple[Any, ...], name: str) -> Shapes:
    """Seconds of work. Raises StgaError for a head whose face ARKit's shapes do not fit."""
    sequence = flame_of(open_capture(*source), name)
    found = head_map(sequence, name)
    return found, *head_shapes(sequence, found)


def needs_sliders(head: Any) -> bool:
    """Whether a head has neither expressions with ARKit's names nor the sliders."""
    rig = rig_or_none(head)
    return rig is not None and EXPRESSION_NAMES not in head and not has_shapes(head)


def begin_sliders(head: Any) -> None:
    """Give a head that needs them its sliders as soon as a thread has computed them, and any its
    map, for which *Drive Live* would wait; scripts call the operators."""
    if monitor.has_timer() and rig_or_none(head) is not None and head.library is None:
        monitor.watch(_Sliders(head))


preparing: set[str] = set()
"""Names of heads whose sliders are being computed."""


class _Sliders:
    """What a thread computes for a head, which is looked up by its name: undo moves it."""

    def __init__(self, head: Any) -> None:
        self._head, self._made = head.name, list[Shapes]()
        arguments = capture_source(head), needs_sliders(head)
        self._thread = Thread(target=self._make, args=arguments, daemon=True)
        self._thread.start()
        if needs_sliders(head):
            preparing.add(self._head)

    def _make(self, source: tuple[Any, ...], has_none: bool) -> None:
        with suppress(StgaError):  # the operator says what is wrong
            if has_none:
                self._made.append(_compute_shapes(source, self._head))
            else:
                head_map(flame_of(open_capture(*source), self._head), self._head)

    def tick(self) -> float | None:
        is_driven = live_session.session() is not None  # which further sliders would end
        if self._thread.is_alive() or is_driven or bpy.app.is_job_running("RENDER"):
            return POLL_INTERVAL_S
        preparing.discard(self._head)
        head = bpy.data.objects.get(self._head)
        if self._made and needs_sliders(head):
            if head.mode == "EDIT":
                return POLL_INTERVAL_S
            add_shapes(head, *self._made[0])
            monitor.push_undo()
            monitor.redraw()
        return None

    def close(self) -> None:
        preparing.discard(self._head)


@persistent
def _after_load(_: Any) -> None:
    for scene in bpy.data.scenes:
        if scene.library is None:
            begin_sliders(getattr(scene, ids.SETTINGS).head)


def register() -> None:
    bpy.app.handlers.load_post.append(_after_load)


def unregister() -> None:
    bpy.app.handlers.load_post.remove(_after_load)
