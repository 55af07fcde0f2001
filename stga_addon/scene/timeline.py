"""The scene's frames: their rate, the current one, and one after the other."""

from collections.abc import Iterable, Iterator
from typing import Any

import bpy


def frames_per_second(scene: Any) -> float:
    """At which the scene plays."""
    return float(scene.render.fps / scene.render.fps_base)


def set_frames_per_second(scene: Any, rate: float) -> None:
    """Let the scene play at the rate; Blender holds a whole number and a divisor, such as 30 and 1.001."""
    whole = max(1, round(rate))
    scene.render.fps, scene.render.fps_base = whole, whole / rate


def go_to_frame(frame: int) -> None:
    """Move the open scene to a frame and evaluate it."""
    bpy.context.scene.frame_set(frame)
    bpy.context.view_layer.update()


def iterate_frames(numbers: Iterable[int]) -> Iterator[int]:
    """Set each frame of the scene in turn, with progress at the mouse pointer; restore the current frame at the end."""
    scene, manager, numbers = bpy.context.scene, bpy.context.window_manager, list(numbers)
    frame, subframe = scene.frame_current, scene.frame_subframe
    manager.progress_begin(0, max(len(numbers), 1))
    try:
        for index, number in enumerate(numbers):
            scene.frame_set(number)
            manager.progress_update(index)
            yield number
    finally:
        manager.progress_end()
        scene.frame_set(frame, subframe=subframe)
