"""Operators, one module for each step of the panel."""

from importlib import import_module
from typing import Any

import bpy

from . import arkit_controls, drive, ids, monitor, pose, prepare
from .common import register_classes, unregister_classes

MODULES = (
    ".avatar_from_video", ".track", ".track_correct", ".export_head_model", ".open_demo",
    ".import_capture", ".import_motion", ".import_meshes", ".select", ".analyze", ".train",
    ".continue_run", ".select_extension", ".request", ".failure_report", ".training_python",
    ".pose", ".show", ".light", ".preview_images", ".render_video", ".apply_motion",
    ".arkit_controls", ".drive", ".drive_video", ".import_ply", ".export", ".export_cameras",
    ".export_performance", ".drop",
)  # fmt: skip
"""Whose operators and file handlers are registered."""
PARTS = (prepare, monitor, arkit_controls, drive, pose)
"""With handlers, timers or keys."""
CLASSES = tuple(
    thing
    for module in (import_module(name, __package__) for name in MODULES)
    for thing in vars(module).values()
    if isinstance(thing, type) and issubclass(thing, (bpy.types.Operator, bpy.types.FileHandler))
    if thing.__module__ == module.__name__
)


def _import_menu(menu: Any, context: Any) -> None:
    menu.layout.operator(ids.AVATAR_FROM_VIDEO, text="Avatar from Video (STGA)…")
    menu.layout.operator(ids.IMPORT_CAPTURE, text="Head Capture (STGA)")
    menu.layout.operator(ids.IMPORT_MOTION, text="FLAME Motion (.npz)")
    menu.layout.operator(ids.IMPORT_MESHES, text="Mesh Sequence (STGA)")
    menu.layout.operator(ids.IMPORT_PLY, text="Gaussian Splats (.ply)")


def _export_menu(menu: Any, context: Any) -> None:
    menu.layout.operator(ids.EXPORT_AVATAR, text="Gaussian Head Avatar (STGA)")
    menu.layout.operator(ids.EXPORT_PERFORMANCE, text="ARKit Curves (STGA)")
    menu.layout.operator(ids.EXPORT_CAMERAS, text="Cameras for Tracking (STGA)")
    menu.layout.operator(ids.EXPORT_HEAD_MODEL, text="Head Model for Tracking (STGA)")


def register() -> None:
    register_classes(CLASSES)
    bpy.types.TOPBAR_MT_file_import.append(_import_menu)
    bpy.types.TOPBAR_MT_file_export.append(_export_menu)
    for part in PARTS:
        part.register()


def unregister() -> None:
    for part in reversed(PARTS):
        part.unregister()
    bpy.types.TOPBAR_MT_file_export.remove(_export_menu)
    bpy.types.TOPBAR_MT_file_import.remove(_import_menu)
    unregister_classes(CLASSES)
