"""What the panel's steps remember between clicks; saved with the .blend."""

import json
from typing import Any

import bpy

from ..operators import ids
from ..operators.common import register_classes, unregister_classes
from ..operators.train import preset_property, strategy_property
from ..stga_addon.scene.compat import PATH_OPTIONS


class SelectedFrame(bpy.types.PropertyGroup):
    """A line of the table of what each frame trains; filled by the operators of `operators.select`."""

    frame: bpy.props.IntProperty(name="Frame", description="Frame of the scene, which is the timestep of the capture")
    triangles: bpy.props.IntProperty(name="Triangles", description="Triangles that the frame selects")
    splats: bpy.props.IntProperty(name="Splats", description="Splats on those triangles")


def _forget_rows(chosen: Any, context: Any) -> None:
    chosen.selected_frames.clear()  # they counted another head
    chosen.effects.clear()
    chosen.preset_timing = ""


def seconds_of_presets(chosen: Any) -> dict[str, float]:
    """Preset -> seconds that it trains on this machine, where the capture was looked at."""
    return dict(json.loads(chosen.preset_timing or "{}"))


def _take_minutes(chosen: Any, context: Any) -> None:
    seconds = seconds_of_presets(chosen).get(chosen.preset)
    if seconds:
        chosen.minutes = seconds / 60


class EffectRow(bpy.types.PropertyGroup):
    """A line of the plan; filled by `operators.plan`. Its `name` is the effect's."""

    choice: bpy.props.EnumProperty(
        name="Choice",
        description="Who decides",
        items=(
            ("auto", "Auto", "The capture decides"),
            ("on", "On", "Computed, whatever the capture says"),
            ("off", "Off", "Not computed"),
        ),
    )
    on: bpy.props.BoolProperty(name="On")
    reason: bpy.props.StringProperty(name="Reason")
    cost: bpy.props.StringProperty(name="Cost")


class SceneSettings(bpy.types.PropertyGroup):
    """One per scene; operators read what the scene works on, the panel hands the rest to them as arguments."""

    # The module bpy 4.2 crashes when its Python ends where a property has a poll or update function; Blender does not.

    head: bpy.props.PointerProperty(
        name="Head",
        description="The imported head that the steps work on",
        type=bpy.types.Object,
        update=_forget_rows,
    )
    selected_frames: bpy.props.CollectionProperty(type=SelectedFrame)
    selected_row: bpy.props.IntProperty(options={"HIDDEN"})
    motion_source: bpy.props.PointerProperty(
        name="From", description="Another imported head, whose motion this head takes", type=bpy.types.Object
    )
    splats: bpy.props.PointerProperty(
        name="Splats", description="The splats whose display is set here", type=bpy.types.Object
    )
    run_folder: bpy.props.StringProperty(
        name="Run Folder",
        description="Where training writes the avatar and its checkpoints",
        subtype="DIR_PATH",
        options=PATH_OPTIONS,
        default="//stga_run",
    )
    minutes: bpy.props.FloatProperty(name="Minutes", description="Wall time of training", default=5.0, min=0.01)
    strategy: strategy_property()
    preset: preset_property(update=_take_minutes)
    preset_timing: bpy.props.StringProperty(options={"HIDDEN"})  # JSON: preset -> what `operators.plan` was told
    effects: bpy.props.CollectionProperty(type=EffectRow)
    analysis_error: bpy.props.StringProperty(options={"HIDDEN"})  # why the capture could not be looked at
    live_preview: bpy.props.BoolProperty(
        name="Live Preview", description="Refresh the splats every few seconds while they train", default=True
    )
    show_result: bpy.props.BoolProperty(
        name="Show When Done", description="Show the avatar on the head as soon as it is trained", default=True
    )
    training_run: bpy.props.StringProperty(options={"HIDDEN"})  # absolute path of the current or last run
    result_shown: bpy.props.BoolProperty(options={"HIDDEN"})  # its result has reached the scene
    avatar: bpy.props.StringProperty(
        name="Avatar", description="Trained avatar file (.npz)", subtype="FILE_PATH", options=PATH_OPTIONS
    )


def register() -> None:
    register_classes((SelectedFrame, EffectRow, SceneSettings))
    setattr(bpy.types.Scene, ids.SETTINGS, bpy.props.PointerProperty(type=SceneSettings))


def unregister() -> None:
    delattr(bpy.types.Scene, ids.SETTINGS)
    unregister_classes((SelectedFrame, EffectRow, SceneSettings))
