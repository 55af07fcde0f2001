"""Properties of a scene, saved with the .blend file, and preferences of the add-on."""

import json
from typing import Any

import bpy

from ..operators import options
from ..operators.common import AtEnd, package, register_classes
from ..operators.drive import DriveSettings
from ..operators.options import FACTOR
from ..operators.results import follow_head, panel_path, store_panel_path
from ..operators.track import TrackOptions
from ..operators.train import ExtendOptions, RefineOptions, TrainOptions, preset_property
from ..operators.training_python import has_training_python, test
from ..stga_addon.scene import tags
from ..stga_addon.worker.training_python import PYTHON_VARIABLE
from .sidebar import draw_text


def object_property(name: str, description: str, **more: Any) -> Any:
    about = {"name": name, "description": description, **more}
    return bpy.props.PointerProperty(type=bpy.types.Object, **about)


def _hidden(kind: Any) -> Any:
    return kind(options={"HIDDEN"})


class SelectedFrame(bpy.types.PropertyGroup):
    """Row of the table of selected triangles; filled by `operators.select`."""

    frame: options.integer("Frame", "Frame of the scene: the timestep of the capture")
    triangles: options.integer("Triangles", "Triangles selected in the frame")
    splats: options.integer("Splats", "Splats on those triangles")


def _is_body(settings: Any, thing: Any) -> bool:
    """Whether an object is an armature that is no avatar's."""
    return thing.type == "ARMATURE" and tags.KIND not in thing


def _choose_head(settings: Any, context: Any) -> None:
    follow_head(settings)
    settings.selected_frames.clear()  # rows of another head
    settings.effects.clear()
    settings.preset_timing = ""
    settings.misfit = ""


def _of_head(tag: str) -> dict[str, Any]:
    """A path that is stored with the panel's head."""
    return {
        "get": lambda settings: panel_path(settings, tag),
        "set": lambda settings, value: store_panel_path(settings, tag, value),
    }


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
    """Row of the table of effects, `name` is the effect's; filled by `operators.results`."""

    choice: options.choice(
        "Choice",
        "Whether training models this effect",
        ("auto", "Auto", "Decided by analyzing the capture"),
        ("on", "On", "Always"),
        ("off", "Off", "Never"),
    )
    on: bpy.props.BoolProperty(name="On")
    reason: bpy.props.StringProperty(name="Reason")
    cost: bpy.props.StringProperty(name="Cost")
    is_open: options.boolean("Details", "Choose whether it is on; see why, and at what cost")


class TrackSettings(TrackOptions, bpy.types.PropertyGroup):
    """The panel's options of Track Footage."""

    directory: options.path(
        "Capture", "Folder for the tracked capture", "DIR_PATH", default="//stga_capture"
    )


class RefineSettings(RefineOptions, bpy.types.PropertyGroup):
    """The panel's options of Refine."""

    all_frames: options.boolean(
        "All Frames", "Train the region on all frames of the capture", default=True
    )
    first: options.integer("First Frame", "First frame to train on", min=0)
    last: options.integer("Last Frame", "Last frame to train on", min=0)


class ExtendSettings(ExtendOptions, bpy.types.PropertyGroup):
    """The panel's options of Extend with Take."""


class SceneSettings(TrainOptions, bpy.types.PropertyGroup):
    """Settings of the panel, one group for each scene; passed to operators as arguments."""

    # The module bpy 4.2 crashes when its Python ends where a property has a poll or update
    # function; Blender does not.

    head: object_property("Head", "Imported head that the steps work on", update=_choose_head)
    track: bpy.props.PointerProperty(type=TrackSettings)
    # absolute paths of the last tracking, avatar of a video, and run; whether they have reached the
    # scene (`operators.results.PLACES`)
    tracking_capture: _hidden(bpy.props.StringProperty)
    tracking_shown: _hidden(bpy.props.BoolProperty)
    avatar_folder: _hidden(bpy.props.StringProperty)
    avatar_shown: _hidden(bpy.props.BoolProperty)
    training_run: _hidden(bpy.props.StringProperty)
    result_shown: _hidden(bpy.props.BoolProperty)
    shot_run: _hidden(bpy.props.StringProperty)  # the run whose avatar gets the demo's shot
    # heads that these are trained for (`operators.results.HEADS`)
    avatar_head: object_property("Head", "Head of the avatar of a video", options={"HIDDEN"})
    training_head: object_property("Head", "Head that is trained", options={"HIDDEN"})
    selected_frames: bpy.props.CollectionProperty(type=SelectedFrame)
    selected_row: options.integer("Frame", "Go to this frame", get=_current_row, set=_go_to_row)
    motion_source: object_property(
        "From", "Another imported head, whose motion is applied to this one"
    )
    body: object_property(
        "Body",
        "Armature that the avatar is attached to",
        poll=_is_body,
    )
    body_bone: options.text("Bone", "Bone that carries the avatar, such as the body's neck")
    pose_strength: options.number(
        "Strength", "Of the next pose; 1: the pose, 0.5: halfway to it", default=1.0, **FACTOR
    )
    key_pose: options.boolean("Keyframe", "Keyframe what the next pose changes")
    drive: bpy.props.PointerProperty(type=DriveSettings)
    splats: object_property("Splats", "Splats whose display is set here")
    run_folder: options.path(
        "Run Folder",
        "Folder for the avatar and its checkpoints",
        "DIR_PATH",
        **_of_head(tags.RUN),
    )
    holds_run: _hidden(bpy.props.BoolProperty)  # the run folder, which panels do not look into
    refine: bpy.props.PointerProperty(type=RefineSettings)
    extend: bpy.props.PointerProperty(type=ExtendSettings)
    preset: preset_property(update=_take_minutes)
    preset_timing: _hidden(bpy.props.StringProperty)  # JSON of `preset_times`
    effects: bpy.props.CollectionProperty(type=EffectRow)
    misfit: _hidden(bpy.props.StringProperty)  # of the capture's mesh and images, by the analysis
    live_preview: options.boolean(
        "Live Preview", "Update the splats every few seconds during training", default=True
    )
    show_result: options.boolean(
        "Show When Trained", "Show the avatar on the head when training has finished", default=True
    )
    avatar: options.path("Avatar", "Trained avatar file (.npz)", **_of_head(tags.AVATAR))
    show_filmed: options.boolean(
        "Filmed", "From where the head was filmed, and what to film next", default=True
    )
    show_figures: options.boolean(
        "Figures", "Show speed, PSNR of held-out views in dB, loss, number of splats and memory"
    )


class Preferences(bpy.types.AddonPreferences):
    bl_idname = package()

    flame_model: options.path(
        "FLAME Model",
        "Your own FLAME model file (.pkl or .npz), from flame.is.tue.mpg.de; needed for captures "
        "tracked with FLAME, and never part of this add-on",
    )
    training_python: options.text(
        "Python",
        "An interpreter that has torch, numba and what else tracking and training need; empty: "
        "Blender's own, which has it all with the complete edition. The variable "
        f"{PYTHON_VARIABLE} takes precedence",
        subtype="FILE_PATH",
    )
    render_device: options.choice(
        "Rendering Device",
        "Device that renders splats for videos, and for images where Blender has no GPU context",
        ("auto", "Auto", "A GPU if one is faster than the CPU and right, else the CPU"),
        ("cpu", "CPU", "The processor"),
        ("gpu", "GPU", "A GPU; rendering fails if none works"),
    )

    def draw(self, context: Any) -> None:
        self.layout.prop(self, "flame_model")
        self.layout.prop(self, "render_device")
        box = self.layout.box()
        row = box.split(factor=0.8, align=True)
        row.prop(self, "training_python")
        row.operator("stga.test_python")
        if test.process is not None:
            box.label(text=f"Testing {test.python}", icon="TIME")
        elif test.error:
            draw_text(box, context, test.error, "ERROR")
        elif test.found is not None:
            draw_text(box, context, f"{test.python}: {test.found.line}", "CHECKMARK")
        elif not has_training_python(context):
            remedy = "choose another, or install the complete edition"
            draw_text(box, context, f"Blender's Python lacks packages: {remedy}", "INFO")


CLASSES = (
    SelectedFrame,
    EffectRow,
    TrackSettings,
    RefineSettings,
    ExtendSettings,
    DriveSettings,
    SceneSettings,
    Preferences,
)


def register(at_end: AtEnd) -> None:
    register_classes(CLASSES, at_end)
    bpy.types.Scene.stga = bpy.props.PointerProperty(type=SceneSettings)
    at_end(delattr, bpy.types.Scene, "stga")
    # what the last operator could not do, or there is to know of what it did
    bpy.types.WindowManager.stga_message = bpy.props.StringProperty()
    bpy.types.WindowManager.stga_failed = bpy.props.BoolProperty()
    for name in ("stga_message", "stga_failed"):
        at_end(delattr, bpy.types.WindowManager, name)
