"""What a person can do: one file an action."""

from typing import Any

import bpy

from . import ids
from .common import register_classes, unregister_classes
from .export import Export
from .import_capture import ImportCapture
from .import_ply import ImportPly
from .select import Select
from .show import ShowAvatar, StandardView
from .train import Train

CLASSES = (ImportCapture, Select, Train, ShowAvatar, StandardView, ImportPly, Export)


def _import_menu(menu: Any, context: Any) -> None:
    menu.layout.operator(ids.IMPORT_CAPTURE, text="Head Capture (STGA)")
    menu.layout.operator(ids.IMPORT_PLY, text="Gaussian Splats (.ply)")


def _export_menu(menu: Any, context: Any) -> None:
    menu.layout.operator(ids.EXPORT, text="Gaussian Head Avatar (STGA)")


def register() -> None:
    register_classes(CLASSES)
    bpy.types.TOPBAR_MT_file_import.append(_import_menu)
    bpy.types.TOPBAR_MT_file_export.append(_export_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_export.remove(_export_menu)
    bpy.types.TOPBAR_MT_file_import.remove(_import_menu)
    unregister_classes(CLASSES)
