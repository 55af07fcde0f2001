"""Opening, saving and looking up objects in the .blend file."""

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
