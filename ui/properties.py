"""Properties of a scene, saved with the .blend file."""

import json
from typing import Any

import bpy

from ..operators import ids
from ..operators.common import path_property, register_classes, unregister_classes
from ..operators.continue_run import ExtendOptions, RefineOptions
from ..operators.drive import DriveOptions
from ..operators.track import TrackOptions
from ..operators.train import TrainOptions, preset_property


class SelectedFrame(bpy.types.PropertyGroup):
    """Row of the table of selected triangles; filled by `operators.select`."""

    frame: bpy.props.IntProperty(
        name="Frame", description="Frame of the scene: the timestep of the capture"
    )
    triangles: bpy.props.IntProperty(
        name="Triangles", description="Triangles selected in the frame"
    )
    splats: bpy.props.IntProperty(name="Splats", description="Splats on those triangles")


def _forget_rows(settings: Any, context: Any) -> None:
    settings.selected_frames.clear()  # rows of another head
    settings.effects.clear()
    settings.preset_timing = ""


def _current_row(settings: Any) -> int:
    frames = [row.frame for row in settings.selected_frames]
    frame = settings.id_data.frame_current
    return frames.index(frame) if frame in frames else -1


def _go_to_row(settings: Any, row: int) -> None:
    settings.id_data.frame_set(settings.selected_frames[row].frame)


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
        name="Choice", description="Whether training models this effect",
        items=(
            ("auto", "Auto", "Decided by analyzing the capture"),
            ("on", "On", "Always"),
            ("off", "Off", "Never"),
        ),
    )  # fmt: skip
    on: bpy.props.BoolProperty(name="On")
    reason: bpy.props.StringProperty(name="Reason")
    cost: bpy.props.StringProperty(name="Cost")
    is_open: bpy.props.BoolProperty(
        name="Details", description="Choose whether it is on, and see why and at what cost it is"
    )


class TrackSettings(TrackOptions, bpy.types.PropertyGroup):
    """The panel's options of Track Footage."""

    directory: path_property(
        "Capture", "Folder for the tracked capture", "DIR_PATH", default="//stga_capture"
    )


class RefineSettings(RefineOptions, bpy.types.PropertyGroup):
    """The panel's options of Refine."""

    all_frames: bpy.props.BoolProperty(
        name="All Frames", description="Train the region on all frames of the capture", default=True
    )
    first: bpy.props.IntProperty(name="First Frame", description="First frame to train on", min=0)
    last: bpy.props.IntProperty(name="Last Frame", description="Last frame to train on", min=0)


class ExtendSettings(ExtendOptions, bpy.types.PropertyGroup):
    """The panel's options of Extend with Take."""


class DriveSettings(DriveOptions, bpy.types.PropertyGroup):
    """The panel's options of driving live."""


class SceneSettings(TrainOptions, bpy.types.PropertyGroup):
    """Settings of the panel, one group for each scene; passed to operators as arguments, but for
    head and splats."""

    # The module bpy 4.2 crashes when its Python ends where a property has a poll or update
    # function; Blender does not.

    head: bpy.props.PointerProperty(
        name="Head", description="Imported head that the steps work on", type=bpy.types.Object,
        update=_forget_rows,
    )  # fmt: skip
    track: bpy.props.PointerProperty(type=TrackSettings)
    # absolute path of the current or last tracking
    tracking_capture: bpy.props.StringProperty(options={"HIDDEN"})
    tracking_shown: bpy.props.BoolProperty(options={"HIDDEN"})  # it was imported
    # absolute path of the current or last video's avatar
    avatar_folder: bpy.props.StringProperty(options={"HIDDEN"})
    avatar_shown: bpy.props.BoolProperty(options={"HIDDEN"})  # it has reached the scene
    selected_frames: bpy.props.CollectionProperty(type=SelectedFrame)
    selected_row: bpy.props.IntProperty(
        name="Frame", description="Go to this frame", get=_current_row, set=_go_to_row
    )
    motion_source: bpy.props.PointerProperty(
        name="From", description="Another imported head, whose motion is applied to this one",
        type=bpy.types.Object,
    )  # fmt: skip
    drive: bpy.props.PointerProperty(type=DriveSettings)
    splats: bpy.props.PointerProperty(
        name="Splats", description="Splats whose display is set here", type=bpy.types.Object
    )
    run_folder: path_property(
        "Run Folder", "Folder for the avatar and its checkpoints", "DIR_PATH", default="//stga_run"
    )
    refine: bpy.props.PointerProperty(type=RefineSettings)
    extend: bpy.props.PointerProperty(type=ExtendSettings)
    preset: preset_property(update=_take_minutes)
    preset_timing: bpy.props.StringProperty(options={"HIDDEN"})  # JSON of `preset_times`
    effects: bpy.props.CollectionProperty(type=EffectRow)
    live_preview: bpy.props.BoolProperty(
        name="Live Preview", description="Update the splats every few seconds during training",
        default=True,
    )  # fmt: skip
    show_result: bpy.props.BoolProperty(
        name="Show When Trained",
        description="Show the avatar on the head when training has finished", default=True,
    )  # fmt: skip
    # absolute path of the current or last run
    training_run: bpy.props.StringProperty(options={"HIDDEN"})
    result_shown: bpy.props.BoolProperty(options={"HIDDEN"})  # its avatar has reached the scene
    avatar: path_property("Avatar", "Trained avatar file (.npz)")


CLASSES = (
    SelectedFrame,
    EffectRow,
    TrackSettings,
    RefineSettings,
    ExtendSettings,
    DriveSettings,
    SceneSettings,
)


def register() -> None:
    register_classes(CLASSES)
    setattr(bpy.types.Scene, ids.SETTINGS, bpy.props.PointerProperty(type=SceneSettings))
    setattr(bpy.types.WindowManager, ids.MESSAGE, bpy.props.StringProperty())


def unregister() -> None:
    delattr(bpy.types.WindowManager, ids.MESSAGE)
    delattr(bpy.types.Scene, ids.SETTINGS)
    unregister_classes(CLASSES)
