"""What the demo and measurements do with files that are open in Blender."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...driving.demo_speech import SPEECH_FILE
from ...errors import StgaError
from ...flame.sequence import FlameSequence
from ...scene import light, tags
from ...scene.demo_shot import build_shot
from ...scene.display import splat_attributes as stored
from ...scene.display import splat_nodes
from ...scene.display.splat_nodes import AS_TRAINED, POINTS
from ...scene.display.splat_object import display_mode, set_input
from ...scene.light import lighting_settings
from ...scene.objects import save_file
from ...scene.render import engine


def new_file() -> None:
    """Start from an empty file with factory settings: no default cube, no user preferences."""
    bpy.ops.wm.read_factory_settings(use_empty=True)


def open_file(path: Path) -> None:
    """Open a .blend file."""
    bpy.ops.wm.open_mainfile(filepath=str(path.resolve()))


def object_named(name: str) -> Any:
    """The object of that name in the open file."""
    return bpy.data.objects[name]


@contextmanager
def registered() -> Iterator[None]:
    """Register the engine and the settings of lighting for the block, where no extension has."""
    if lighting_settings(bpy.context.scene) is not None:
        yield
        return
    light.register()
    engine.register(lambda: "")
    try:
        yield
    finally:
        engine.unregister()
        light.unregister()


def make_shot(folder: Path, person: FlameSequence) -> None:
    """Build the demo's shot around the head with splats in the open file, and save it in the folder
    of the demo's speech. Raises StgaError."""
    with registered():
        build_shot(tags.heads_of(bpy.context.scene)[0], person, folder / SPEECH_FILE)
        save_file(folder / "shot.blend")


def evaluated_splats(splat_object: Any) -> tuple[np.ndarray, ...]:
    """What a splat object displays as points at the current frame, in its object space: position
    (N, 3), rotation (N, 4) wxyz and linear standard deviations (N, 3), float32; of splats displayed
    as trained, too. Raises StgaError where it displays quads, which are instances."""
    if display_mode(splat_object) == AS_TRAINED:
        set_input(splat_object, splat_nodes.DISPLAY, POINTS)
        try:
            return evaluated_splats(splat_object)
        finally:
            set_input(splat_object, splat_nodes.DISPLAY, AS_TRAINED)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    for instance in depsgraph.object_instances:
        owner = instance.parent if instance.is_instance else instance.object
        is_of_object = owner is not None and owner.original == splat_object
        if is_of_object and instance.object.type == "POINTCLOUD":
            names = "position", stored.WORLD_ROTATION, stored.WORLD_SCALE
            return tuple(stored.read_attribute(instance.object.data, name) for name in names)
    raise StgaError(f"{splat_object.name}: shows quads or nothing, expected points")
