"""Operators, one module for each step of the panel."""

from collections.abc import Callable, Iterable
from typing import Any

import bpy

from . import (
    apply_motion,
    drive,
    duplicate,
    export,
    import_capture,
    kernels,
    monitor,
    opened_files,
    pick,
    pose,
    render_video,
    request,
    select,
    show,
    track,
    train,
    training_python,
)
from .common import AtEnd, close_steps, register_classes

MODULES = (
    track,
    import_capture,
    select,
    train,
    request,
    training_python,
    pick,
    pose,
    show,
    render_video,
    apply_motion,
    drive,
    duplicate,
    export,
)
"""Modules with operators, in the order in which these are registered."""
PICK = "stga.pick_avatar"
"""Operator that selects the avatar under the pointer."""
KEYS = (
    ("Pose", "EMPTY", "stga.turn_jaw", "R", "PRESS", False),
    ("3D View", "VIEW_3D", "stga.stop_live", "ESC", "PRESS", False),
    ("Object Mode", "EMPTY", PICK, "LEFTMOUSE", "CLICK", False),
    ("Object Mode", "EMPTY", PICK, "LEFTMOUSE", "CLICK", True),
)
"""Keymap, its space, operator, key and event, with Shift: R turns a jaw about its hinge, Esc over a
3D viewport stops the live session, a click selects an avatar."""
CLASSES = tuple(
    thing
    for module in MODULES
    for thing in vars(module).values()
    if isinstance(thing, type) and issubclass(thing, (bpy.types.Operator, bpy.types.FileHandler))
    if thing.__module__ == module.__name__
)
IMPORTS = (
    ("stga.avatar_from_video", "Avatar from Video (STGA)…"),
    ("stga.import_capture", "Head Capture (STGA)"),
    ("stga.import_avatar", "Gaussian Head Avatar (.glb)"),
    ("stga.import_motion", "FLAME Motion (.npz)"),
    ("stga.import_meshes", "Mesh Sequence (STGA)"),
    ("stga.import_ply", "Gaussian Splats (.ply, .spz, .splat)"),
)
EXPORTS = (
    ("stga.export_avatar", "Gaussian Head Avatar (STGA)"),
    ("stga.export_splats", "Gaussian Splats (.ply, .spz, .glb, .usdc)"),
    ("stga.export_performance", "ARKit Curves (STGA)"),
    ("stga.export_cameras", "Cameras for Tracking (STGA)"),
    ("stga.export_head_model", "Head Model for Tracking (STGA)"),
)


def _menu(entries: Iterable[tuple[str, str]]) -> Callable[[Any, Any], None]:
    """What draws a menu's entries."""

    def draw(menu: Any, context: Any) -> None:
        for operator, text in entries:
            menu.layout.operator(operator, text=text)

    return draw


def register(at_end: AtEnd) -> None:
    register_classes(CLASSES, at_end)
    for menu, entries in (
        (bpy.types.TOPBAR_MT_file_import, IMPORTS),
        (bpy.types.TOPBAR_MT_file_export, EXPORTS),
    ):
        draw = _menu(entries)
        menu.append(draw)
        at_end(menu.remove, draw)
    keys = bpy.context.window_manager.keyconfigs.addon
    for name, space, operator, key, event, shift in KEYS if keys is not None else ():
        items = keys.keymaps.new(name=name, space_type=space).keymap_items
        item = items.new(operator, key, event, shift=shift)
        if operator == PICK:
            item.properties.extend = shift
        at_end(items.remove, item)
    for part in (kernels, opened_files, monitor, pose, render_video, drive):
        part.register(at_end)
    at_end(close_steps)
