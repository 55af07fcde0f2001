"""The open .blend file: opening and saving it, its scene, objects and frames."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import bpy

from ..errors import StgaError


def new_file() -> None:
    """Start from an empty file with factory settings: no default cube, no user preferences."""
    bpy.ops.wm.read_factory_settings(use_empty=True)


def empty_file() -> None:
    """Start from an empty file; preferences and add-ons stay."""
    bpy.ops.wm.read_homefile(use_empty=True)


def save_file(path: Path) -> None:
    """Save the open file. Raises StgaError where it cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        bpy.ops.wm.save_as_mainfile(filepath=str(path.resolve()), compress=True)
    except (OSError, RuntimeError) as error:
        raise StgaError(f"{path}: cannot be saved ({error})") from error


def open_file(path: Path) -> None:
    """Open a .blend file. Raises StgaError where it cannot be read."""
    try:
        bpy.ops.wm.open_mainfile(filepath=str(path.resolve()))
    except RuntimeError as error:
        raise StgaError(f"{path}: cannot be opened ({error})") from error


def current_scene() -> Any:
    """The scene of the open file."""
    return bpy.context.scene


def object_named(name: str) -> Any:
    """The object of that name in the open file. Raises StgaError where there is none."""
    found = bpy.data.objects.get(name)
    if found is None:
        raise StgaError(f"{bpy.data.filepath}: has no object '{name}'")
    return found


def frames_per_second(scene: Any) -> float:
    """At which the scene plays."""
    return float(scene.render.fps / scene.render.fps_base)


def set_frames_per_second(scene: Any, rate: float) -> None:
    """Let the scene play at the rate, which Blender holds as an integer and a divisor."""
    whole = max(1, round(rate))
    scene.render.fps, scene.render.fps_base = whole, whole / rate


def go_to_frame(frame: int) -> None:
    """Move the open scene to a frame and evaluate it."""
    bpy.context.scene.frame_set(frame)
    bpy.context.view_layer.update()


def iterate_frames(numbers: Iterable[int]) -> Iterator[int]:
    """Set each frame in turn, with progress at the mouse pointer; restore the current one last."""
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
