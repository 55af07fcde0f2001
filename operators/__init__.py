"""What a person can do: one file an action."""

from typing import Any

import bpy

from . import ids, plan, watch
from .apply_motion import ApplyMotion
from .common import register_classes, unregister_classes
from .export import Export
from .import_capture import ImportCapture
from .import_meshes import ImportMeshes
from .import_motion import ImportMotion
from .import_ply import ImportPly
from .plan import PlanEffects
from .report import CopyReport
from .runtime import CancelRuntime, MakeRuntime, TestRuntime
from .select import CountSelected, HeatMap, Select, ToggleRegion
from .show import MoreBounces, ShowAvatar, StandardView
from .train import CancelTraining, DismissTraining, Train

CLASSES = (
    ImportCapture,
    ImportMotion,
    ImportMeshes,
    Select,
    ToggleRegion,
    CountSelected,
    HeatMap,
    PlanEffects,
    Train,
    CancelTraining,
    DismissTraining,
    CopyReport,
    MakeRuntime,
    TestRuntime,
    CancelRuntime,
    ShowAvatar,
    StandardView,
    MoreBounces,
    ApplyMotion,
    ImportPly,
    Export,
)


def _import_menu(menu: Any, context: Any) -> None:
    menu.layout.operator(ids.IMPORT_CAPTURE, text="Head Capture (STGA)")
    menu.layout.operator(ids.IMPORT_MOTION, text="FLAME Motion (.npz)")
    menu.layout.operator(ids.IMPORT_MESHES, text="Mesh Sequence (STGA)")
    menu.layout.operator(ids.IMPORT_PLY, text="Gaussian Splats (.ply)")


def _export_menu(menu: Any, context: Any) -> None:
    menu.layout.operator(ids.EXPORT, text="Gaussian Head Avatar (STGA)")


def register() -> None:
    register_classes(CLASSES)
    bpy.types.TOPBAR_MT_file_import.append(_import_menu)
    bpy.types.TOPBAR_MT_file_export.append(_export_menu)
    watch.register()


def unregister() -> None:
    watch.unregister()
    plan.stop()
    bpy.types.TOPBAR_MT_file_export.remove(_export_menu)
    bpy.types.TOPBAR_MT_file_import.remove(_import_menu)
    unregister_classes(CLASSES)
