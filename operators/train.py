"""Capture and selection → trained avatar, by a worker process beside Blender."""

import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.training_job import (
    TrainingJob,
    job_folder,
    remove_job,
    run_training_job,
    worker_arguments,
    write_job,
)
from ..stga_addon.scene import tags
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.scene.vertex_groups import training_selection
from ..stga_addon.training.effect_plan import parse_choices
from ..stga_addon.training.settings import PRESETS, make_settings
from ..stga_addon.worker.environment import missing_packages
from ..stga_addon.worker.launch import start_worker
from ..stga_addon.worker.status import failure_report, inspect_worker, request_cancel
from . import ids, monitor
from .common import file_path, head_of, needs_head, reporting, scene_settings
from .environment import training_python


def strategy_property() -> Any:
    """The choice of strategy: the operator's, and the panel's that is handed to it."""
    return bpy.props.EnumProperty(
        name="Strategy",
        description="Which splats an iteration trains",
        items=(
            ("global", "Global", "Every iteration trains all splats: best on the captures measured so far"),
            ("selective", "Selective", "Local iterations on what each frame selects, global ones in between"),
            ("gaussian-avatars", "GaussianAvatars", "That method's binding, losses and rates"),
        ),
    )


def preset_property(**more: Any) -> Any:
    """The choice of a preset: the operator's, and the panel's that is handed to it."""
    purposes = [(name, name.capitalize(), preset.purpose.capitalize()) for name, preset in PRESETS.items()]
    return bpy.props.EnumProperty(
        name="Preset",
        description="How good, and so how long",
        items=(("none", "Default", "The default settings, for as long as Minutes says"), *purposes),
        **more,
    )


class Train(bpy.types.Operator):
    """Train the avatar on the capture's images: in a process beside Blender, which goes on when Blender is closed"""

    bl_idname = ids.TRAIN
    bl_label = "Train Avatar"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    directory: bpy.props.StringProperty(
        name="Run Folder",
        description="Where the avatar and its checkpoints are written",
        subtype="DIR_PATH",
        options=PATH_OPTIONS,
    )
    minutes: bpy.props.FloatProperty(name="Minutes", description="Wall time of training", default=5.0, min=0.01)
    iterations: bpy.props.IntProperty(
        name="Iterations", description="Train this many iterations, whatever time they take; 0: by time", min=0
    )
    strategy: strategy_property()
    preset: preset_property()
    seed: bpy.props.IntProperty(name="Seed", description="Fixes every random choice", min=0)
    effects: bpy.props.StringProperty(
        name="Effects",
        description="NAME=on or NAME=off, separated by spaces, for what the capture is not to decide itself",
    )
    resume: bpy.props.BoolProperty(
        name="Resume",
        description="Continue the run in the folder, with the settings and the budget it was started with",
    )
    python: bpy.props.StringProperty(
        name="Python",
        description="The interpreter that trains; empty: the training environment",
        subtype="FILE_PATH",
    )
    wait: bpy.props.BoolProperty(
        name="Wait",
        description="Return when training has ended, as it always does without a window; "
        "Blender's own Python trains then, where it has all that it takes",
    )

    @classmethod
    def poll(cls, context: Any) -> bool:
        if not needs_head(cls, context):
            return False
        if monitor.snapshot_of(context.scene).state.is_alive:
            cls.poll_message_set("Training is under way; cancel it first")
            return False
        return True

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = head_of(context)
        run = file_path(self.directory, "run folder").resolve()
        waits = self.wait or bpy.app.background
        here = waits and not self.python and not missing_packages()
        python = "" if here else training_python(context, self.python)
        write_job(run, self._job(head), training_selection(head))
        if here:
            monitor.set_job(context.scene, run)
            avatar = _work_here(context, run)
        else:
            process = start_worker(job_folder(run), python, worker_arguments(run))
            monitor.set_job(context.scene, run)
            monitor.started(job_folder(run), process)
            if not waits:
                return {"FINISHED"}
            avatar = _wait(run, process)
        scene_settings(context).avatar = str(avatar)
        scene_settings(context).result_shown = True
        self.report({"INFO"}, f"Trained {avatar}")
        return {"FINISHED"}

    def _job(self, head: Any) -> TrainingJob:
        budget = {"iterations": self.iterations} if self.iterations else {"seconds": 60 * self.minutes}
        chosen = None
        if not self.resume:
            effects = None if self.strategy == "gaussian-avatars" else parse_choices(self.effects.split())
            preset = None if self.preset == "none" else self.preset
            chosen = make_settings(self.strategy, preset=preset, seed=self.seed, effects=effects, **budget)
        capture, model = Path(head[tags.CAPTURE]), head.get(tags.FLAME_MODEL)
        if not capture.is_dir():
            raise StgaError(f"{capture}: is not a folder; expected that of the capture, which the head came from")
        return TrainingJob(capture, Path(model) if model else None, head.get(tags.PRINCIPAL_POINT, "vhap"), chosen)


class CancelTraining(bpy.types.Operator):
    """Stop training soon, and keep the avatar as it is by then; Resume goes on from there"""

    bl_idname = ids.CANCEL_TRAINING
    bl_label = "Cancel Training"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        if monitor.snapshot_of(context.scene).state.is_alive:
            return True
        cls.poll_message_set("Nothing is being trained")
        return False

    @reporting
    def execute(self, context: Any) -> set[str]:
        folder = job_folder(monitor.run_of(context.scene))
        request_cancel(folder)
        monitor.follow(folder)
        return {"FINISHED"}


class DismissTraining(bpy.types.Operator):
    """Forget how training ended: its log and messages; the run, its avatar and checkpoints stay"""

    bl_idname = ids.DISMISS_TRAINING
    bl_label = "Dismiss"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        if monitor.run_of(context.scene) is None:
            cls.poll_message_set("There is nothing to dismiss")
            return False
        if monitor.snapshot_of(context.scene).state.is_alive:
            cls.poll_message_set("Training is under way; cancel it first")
            return False
        return True

    @reporting
    def execute(self, context: Any) -> set[str]:
        folder = job_folder(monitor.run_of(context.scene))
        remove_job(monitor.run_of(context.scene))
        monitor.forget(folder)
        monitor.set_job(context.scene, None)
        return {"FINISHED"}


def _work_here(context: Any, run: Path) -> Path:
    manager = context.window_manager

    def show(progress: Any) -> bool:
        manager.progress_update(100 * progress.share)
        return False

    manager.progress_begin(0, 100)
    try:
        return run_training_job(run, also=show)
    finally:
        manager.progress_end()


def _wait(run: Path, process: "subprocess.Popen[bytes]") -> Path:
    """Wait for the worker. Raises StgaError with its sentence where it failed; the traceback goes to the terminal."""
    process.wait()
    last = inspect_worker(job_folder(run), process)
    if last.state.failed:
        print(failure_report(job_folder(run), last), file=sys.stderr)
        raise StgaError(last.status.error)
    return run / "avatar.npz"
