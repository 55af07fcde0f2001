"""Properties of a scene, saved with the .blend file."""

import json
from typing import Any

import bpy

from ..operators import ids, track
from ..operators.common import register_classes, unregister_classes
from ..operators.train import adapter_property, device_property, preset_property, strategy_property
from ..stga_addon.scene.compat import PATH_OPTIONS


class SelectedFrame(bpy.types.PropertyGroup):
    """Row of the table of selected triangles; filled by `operators.select`."""

    frame: bpy.props.IntProperty(name="Frame", description="Frame of the scene: the timestep of the capture")
    triangles: bpy.props.IntProperty(name="Triangles", description="Triangles selected in the frame")
    splats: bpy.props.IntProperty(name="Splats", description="Splats on those triangles")


def _forget_rows(settings: Any, context: Any) -> None:
    settings.selected_frames.clear()  # rows of another head
    settings.effects.clear()
    settings.preset_timing = ""


def preset_times(settings: Any) -> dict[str, float]:
    """Preset -> seconds of training on this machine; empty before the capture was analyzed."""
    return dict(json.loads(settings.preset_timing or "{}"))


def _take_minutes(settings: Any, context: Any) -> None:
    seconds = preset_times(settings).get(settings.preset)
    if seconds:
        settings.minutes = seconds / 60


class EffectRow(bpy.types.PropertyGroup):
    """Row of the table of effects, `name` is the effect's; filled by `operators.analyze`."""

    choice: bpy.props.EnumProperty(
        name="Choice",
        description="Whether training models this effect",
        items=(
            ("auto", "Auto", "Decided by analyzing the capture"),
            ("on", "On", "Always"),
            ("off", "Off", "Never"),
        ),
    )
    on: bpy.props.BoolProperty(name="On")
    reason: bpy.props.StringProperty(name="Reason")
    cost: bpy.props.StringProperty(name="Cost")


class SceneSettings(bpy.types.PropertyGroup):
    """Settings of the panel, one group for each scene; passed to operators as arguments, but for head and splats."""

    # The module bpy 4.2 crashes when its Python ends where a property has a poll or update function; Blender does not.

    head: bpy.props.PointerProperty(
        name="Head",
        description="Imported head that the steps work on",
        type=bpy.types.Object,
        update=_forget_rows,
    )
    footage: track.footage_property()
    footage_cameras: track.cameras_property()
    head_model: track.model_property()
    capture_folder: track.path_property(
        "Capture", "Folder for the tracked capture", "DIR_PATH", default="//stga_capture"
    )
    detector: track.detector_property()
    focal: track.focal_property()
    mattes: track.mattes_property()
    matte_folder: track.matte_folder_property()
    footage_start: track.start_property()
    footage_stop: track.stop_property()
    footage_step: track.step_property()
    tracking_capture: bpy.props.StringProperty(options={"HIDDEN"})  # absolute path of the current or last tracking
    tracking_model: bpy.props.StringProperty(options={"HIDDEN"})  # absolute path of its head model
    tracking_pending: bpy.props.BoolProperty(options={"HIDDEN"})  # it is to be imported when it is done
    tracking_error: bpy.props.StringProperty(options={"HIDDEN"})  # why it could not be imported
    selected_frames: bpy.props.CollectionProperty(type=SelectedFrame)
    selected_row: bpy.props.IntProperty(options={"HIDDEN"})
    motion_source: bpy.props.PointerProperty(
        name="From", description="Another imported head, whose motion is applied to this one", type=bpy.types.Object
    )
    splats: bpy.props.PointerProperty(
        name="Splats", description="Splats whose display is set here", type=bpy.types.Object
    )
    run_folder: bpy.props.StringProperty(
        name="Run Folder",
        description="Folder for the avatar and its checkpoints",
        subtype="DIR_PATH",
        options=PATH_OPTIONS,
        default="//stga_run",
    )
    minutes: bpy.props.FloatProperty(name="Minutes", description="Training time", default=5.0, min=0.01)
    refine_group: bpy.props.StringProperty(
        name="Region", description="Vertex group whose triangles are refined; empty: the active one"
    )
    refine_all_frames: bpy.props.BoolProperty(
        name="All Frames", description="Train the region on all frames of the capture", default=True
    )
    refine_first: bpy.props.IntProperty(name="First Frame", description="First frame to train on", min=0)
    refine_last: bpy.props.IntProperty(name="Last Frame", description="Last frame to train on", min=0)
    refine_seconds: bpy.props.FloatProperty(name="Seconds", description="Training time", default=20.0, min=0.1)
    refine_growth: bpy.props.FloatProperty(
        name="More Splats",
        description="Splats that may be added, as a share of those in the region",
        min=0.0,
        soft_max=2.0,
        subtype="FACTOR",
    )
    take: bpy.props.StringProperty(
        name="Take",
        description="Folder of a further capture of the same head",
        subtype="DIR_PATH",
        options=PATH_OPTIONS,
    )
    extend_seconds: bpy.props.FloatProperty(name="Seconds", description="Training time", default=60.0, min=0.1)
    strategy: strategy_property()
    preset: preset_property(update=_take_minutes)
    device: device_property()
    adapter: adapter_property()
    preset_timing: bpy.props.StringProperty(options={"HIDDEN"})  # JSON of `preset_times`
    effects: bpy.props.CollectionProperty(type=EffectRow)
    extension_error: bpy.props.StringProperty(options={"HIDDEN"})  # why it could not be selected what Extend trains
    analysis_error: bpy.props.StringProperty(options={"HIDDEN"})  # why the analysis failed
    live_preview: bpy.props.BoolProperty(
        name="Live Preview", description="Update the splats every few seconds during training", default=True
    )
    show_result: bpy.props.BoolProperty(
        name="Show When Trained", description="Show the avatar on the head when training has finished", default=True
    )
    training_run: bpy.props.StringProperty(options={"HIDDEN"})  # absolute path of the current or last run
    result_shown: bpy.props.BoolProperty(options={"HIDDEN"})  # its avatar has reached the scene
    avatar: bpy.props.StringProperty(
        name="Avatar", description="Trained avatar file (.npz)", subtype="FILE_PATH", options=PATH_OPTIONS
    )


def register() -> None:
    register_classes((SelectedFrame, EffectRow, SceneSettings))
    setattr(bpy.types.Scene, ids.SETTINGS, bpy.props.PointerProperty(type=SceneSettings))


def unregister() -> None:
    delattr(bpy.types.Scene, ids.SETTINGS)
    unregister_classes((SelectedFrame, EffectRow, SceneSettings))
