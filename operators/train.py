"""Trains the avatar in a worker process beside Blender."""

from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.table import TRAINS
from ..stga_addon.jobs.train import Extend, Refine, Resume
from ..stga_addon.jobs.train import Train as TrainRequest
from ..stga_addon.scene.vertex_groups import training_selection
from ..stga_addon.training.effect_catalog import parse_choice
from ..stga_addon.training.run.folder import read_run
from ..stga_addon.training.settings import PRESETS, TrainingSettings, make_settings
from . import ids
from .common import capture_source, file_path, head_of, needs_head, path_property, reporting
from .options import option_property
from .request import needs_idle, python_of, start
from .training_python import test


def preset_property(**more: Any) -> Any:
    """Training preset: of the operator, and of the panel, which also takes over its time."""
    purposes = [
        (name, name.capitalize(), preset.purpose.capitalize()) for name, preset in PRESETS.items()
    ]
    return bpy.props.EnumProperty(
        name="Preset",
        description="Accuracy, and with it training time",
        items=(("none", "Default", "Default settings, trained for the time in Minutes"), *purposes),
        **more,
    )


def list_adapters(owner: Any, context: Any, text: str) -> list[str]:
    """The GPUs that the last test of the Python found, in its order."""
    return list(test.found.adapters) if test.found else []


class DeviceOptions:
    """Where an operator trains: of the operators, and of the panel that calls them."""

    device: bpy.props.EnumProperty(
        name="Device",
        description="Device that trains. Auto resumes a run on the device that it was trained on",
        items=(
            ("auto", "Auto", "A GPU if one is faster than the CPU and right, else the CPU"),
            ("cpu", "CPU", "The processor"),
            ("gpu", "GPU", "A GPU; training fails if none works"),
        ),
    )
    adapter: bpy.props.StringProperty(
        name="GPU",
        description="Name of the GPU; empty: the first. The list is that of the last test of the "
        "Python",
        search=list_adapters, search_options={"SUGGESTION"},
    )  # fmt: skip


class TrainOptions(DeviceOptions):
    """How an avatar is trained: of the operator, and of the panel that calls it."""

    minutes: bpy.props.FloatProperty(
        name="Minutes", description="Training time", default=5.0, min=0.01
    )
    strategy: option_property(
        TrainingSettings, "strategy", labels={"gaussian-avatars": "GaussianAvatars"}
    )
    preset: preset_property()


class TrainingOperator:
    """Options of an operator that trains which no panel has."""

    iterations: option_property(TrainingSettings, "iterations", options={"SKIP_SAVE"})
    python: bpy.props.StringProperty(
        name="Python",
        description="Python interpreter that trains; empty: that of the preferences, or Blender's "
        "own",
        subtype="FILE_PATH", options={"SKIP_SAVE"},
    )  # fmt: skip
    wait: bpy.props.BoolProperty(
        name="Wait",
        description="Return when training has ended, as always without a window; Blender's own "
        "Python trains then, if it has the packages",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_head(cls, context) and needs_idle(cls, context, *TRAINS)


class Train(TrainingOperator, TrainOptions, bpy.types.Operator):
    """Train the avatar on the capture's images, in a process that continues when Blender is
    closed"""

    bl_idname = ids.TRAIN
    bl_label = "Train Avatar"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    directory: path_property("Run Folder", "Folder for the avatar and its checkpoints", "DIR_PATH")
    seed: option_property(TrainingSettings, "seed", options={"SKIP_SAVE"})
    effects: bpy.props.StringProperty(
        name="Effects",
        description="NAME=on or NAME=off, separated by spaces, for effects that the capture "
        "should not decide",
        options={"SKIP_SAVE"},
    )
    resume: bpy.props.BoolProperty(
        name="Resume",
        description="Continue the run in the folder with the settings and budget that it was "
        "started with",
        options={"SKIP_SAVE"},
    )

    @reporting
    def execute(self, context: Any) -> set[str]:
        return start_training(self, context, self._request(head_of(context)))

    def _request(self, head: Any) -> TrainRequest | Resume:
        run = file_path(self.directory, "run folder").resolve()
        capture, flame, principal_point = capture_source(head)
        if not capture.is_dir():
            raise StgaError(
                f"{capture}: is not a folder; expected the capture that the head was imported from"
            )
        if self.resume:
            # The head may be that of any take.
            moved = None if read_run(run).takes else capture
            return Resume(
                run, moved, flame, principal_point, device_of(self), training_selection(head)
            )
        effects = (
            None
            if self.strategy == "gaussian-avatars"
            else dict(map(parse_choice, self.effects.split()))
        )
        preset = None if self.preset == "none" else self.preset
        budget = (
            {"iterations": self.iterations} if self.iterations else {"seconds": 60 * self.minutes}
        )
        settings = make_settings(
            self.strategy, preset=preset, seed=self.seed, effects=effects, **budget
        )
        return TrainRequest(
            run,
            capture,
            settings,
            flame,
            principal_point,
            device=device_of(self),
            selection=training_selection(head),
        )


def device_of(operator: Any) -> str:
    """What `choose_device` takes, of an operator with `DeviceOptions`."""
    return (
        f"gpu:{operator.adapter}"
        if operator.device == "gpu" and operator.adapter
        else str(operator.device)
    )


def start_training(
    operator: Any, context: Any, request: TrainRequest | Resume | Refine | Extend
) -> set[str]:
    """Start a training, or wait for it. Raises StgaError."""
    if start(context.scene, request, python_of(operator, context), wait=operator.wait):
        operator.report({"INFO"}, f"Trained {request.run}")
    return {"FINISHED"}
