"""The scene's current frame."""

from collections.abc import Iterable, Iterator

import bpy


def go_to_frame(frame: int) -> None:
    """Move the open scene to a frame and evaluate it."""
    bpy.context.scene.frame_set(frame)
    bpy.context.view_layer.update()


def iterate_frames(numbers: Iterable[int]) -> Iterator[int]:
    """Set each frame of the scene in turn, with progress at the mouse pointer; in the end the frame is what it was."""
    scene, manager, numbers = bpy.context.scene, bpy.context.window_manager, list(numbers)
    before, between = scene.frame_current, scene.frame_subframe
    manager.progress_begin(0, max(len(numbers), 1))
    try:
        for done, number in enumerate(numbers):
            scene.frame_set(number)
            manager.progress_update(done)
            yield number
    finally:
        manager.progress_end()
        scene.frame_set(before, subframe=between)
