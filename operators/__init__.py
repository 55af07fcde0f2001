"""Operators, one module for each step of the panel."""

from typing import Any

import bpy

from . import (
    apply_motion,
    avatar_from_video,
    drive,
    drop,
    export,
    import_capture,
    live_session,
    monitor,
    pose,
    render_video,
    request,
    select,
    show,
    track,
    train,
    training_python,
)
from .common import register_classes, unregister_classes

MODULES = (avatar_from_video, track, import_capture, select, train, request, training_python, pose)
MODULES += (show, render_video, apply_motion, drive, export, drop)
PARTS = (training_python, monitor, pose, render_video)
"""With handlers, timers or an engine."""
KEYS = (("Pose", "EMPTY", "stga.turn_jaw", "R"), ("3D View", "VIEW_3D", "stga.stop_live", "ESC"))
"""Keymap, its space, operator and key: R turns a jaw about its hinge, Esc over a 3D viewport stops
the live session."""
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
    ("stga.import_motion", "FLAME Motion (.npz)"),
    ("stga.import_meshes", "Mesh Sequence (STGA)"),
    ("stga.import_ply", "Gaussian Splats (.ply)"),
)
EXPORTS = (
    ("stga.export_avatar", "Gaussian Head Avatar (STGA)"),
    ("stga.export_performance", "ARKit Curves (STGA)"),
    ("stga.export_cameras", "Cameras for Tracking (STGA)"),
    ("stga.export_head_model", "Head Model for Tracking (STGA)"),
)

_keymap_items: list[tuple[Any, Any]] = []


def _import_menu(menu: Any, context: Any) -> None:
    for operator, text in IMPORTS:
        menu.layout.operator(operator, text=text)


def _export_menu(menu: Any, context: Any) -> None:
    for operator, text in EXPORTS:
        menu.layout.operator(operator, text=text)


def register() -> None:
    register_classes(CLASSES)
    bpy.types.TOPBAR_MT_file_import.append(_import_menu)
    bpy.types.TOPBAR_MT_file_export.append(_export_menu)
    keys = bpy.context.window_manager.keyconfigs.addon
    for name, space, operator, key in KEYS if keys is not None else ():  # none without a window
        keymap = keys.keymaps.new(name=name, space_type=space)
        _keymap_items.append((keymap, keymap.keymap_items.new(operator, key, "PRESS")))
    for part in PARTS:
        part.register()


def unregister() -> None:
    if (running := live_session.session()) is not None:
        running.stop()
    for part in reversed(PARTS):
        part.unregister()
    for keymap, item in _keymap_items:
        keymap.keymap_items.remove(item)
    _keymap_items.clear()
    bpy.types.TOPBAR_MT_file_export.remove(_export_menu)
    bpy.types.TOPBAR_MT_file_import.remove(_import_menu)
    unregister_classes(CLASSES)
