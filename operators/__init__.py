"""Operators, one module for each step of the panel."""

from typing import Any

import bpy

from ..stga_addon.requests.environment_job import CAN_MAKE
from . import drive, ids, monitor, prepare
from .analyze import AnalyzeCapture
from .apply_motion import ApplyMotion
from .arkit_controls import AddArkitControls, RemoveArkitControls
from .common import register_classes, unregister_classes
from .continue_run import Extend, Refine
from .drive import CalibrateLive, DriveLive, FollowLive, MeasureRange, RecordLive, StopLive
from .drive_video import DriveVideo
from .drop import AvatarDrop, CaptureDrop, OpenNpz, PerformanceDrop, PlyDrop
from .environment import TestEnvironment
from .export import ExportAvatar
from .export_cameras import ExportCameras
from .export_head_model import ExportHeadModel
from .export_performance import ExportPerformance
from .failure_report import CopyReport
from .import_capture import ImportCapture
from .import_meshes import ImportMeshes
from .import_motion import ImportMotion
from .import_ply import ImportPly
from .light import EstimateLight, HeadShadow, RelightFrame
from .open_demo import OpenDemo
from .pose import PoseHead
from .preview_images import PreviewImages
from .render_video import RenderVideo
from .request import Cancel, Dismiss
from .select import CountSelected, HeatMap, Select, ToggleRegion
from .select_extension import SelectExtension
from .show import MoreBounces, ShowAvatar, StandardView
from .track import TrackFootage
from .track_correct import MarkKey, SolveAgain, ViewFootage
from .train import Train

MAKE_ENVIRONMENT: tuple[type, ...] = ()
if CAN_MAKE:
    from .make_environment import MakeEnvironment

    MAKE_ENVIRONMENT = (MakeEnvironment,)

CLASSES = (
    TrackFootage,
    ViewFootage,
    MarkKey,
    SolveAgain,
    ExportHeadModel,
    OpenDemo,
    ImportCapture,
    ImportMotion,
    ImportMeshes,
    Select,
    ToggleRegion,
    CountSelected,
    HeatMap,
    AnalyzeCapture,
    Train,
    Refine,
    Extend,
    SelectExtension,
    Cancel,
    Dismiss,
    CopyReport,
    *MAKE_ENVIRONMENT,
    TestEnvironment,
    PoseHead,
    ShowAvatar,
    StandardView,
    MoreBounces,
    EstimateLight,
    HeadShadow,
    RelightFrame,
    PreviewImages,
    RenderVideo,
    ApplyMotion,
    AddArkitControls,
    RemoveArkitControls,
    MeasureRange,
    DriveLive,
    StopLive,
    CalibrateLive,
    RecordLive,
    FollowLive,
    DriveVideo,
    ImportPly,
    ExportAvatar,
    ExportCameras,
    ExportPerformance,
    OpenNpz,
    CaptureDrop,
    PerformanceDrop,
    AvatarDrop,
    PlyDrop,
)


def _import_menu(menu: Any, context: Any) -> None:
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
    prepare.register()
    monitor.register()
    drive.register()


def unregister() -> None:
    drive.unregister()
    monitor.unregister()
    prepare.unregister()
    bpy.types.TOPBAR_MT_file_export.remove(_export_menu)
    bpy.types.TOPBAR_MT_file_import.remove(_import_menu)
    unregister_classes(CLASSES)
