"""The Train step, in a worker process beside Blender: analyzing the capture, training an avatar,
refining a region of it, and extending it by a further take of the same head."""

from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..stga_addon.capture.meshes import SELECTED_WEIGHT
from ..stga_addon.errors import StgaError
from ..stga_addon.jobs import train as jobs
from ..stga_addon.jobs.analyze import Analyze
from ..stga_addon.jobs.monitor_state import Dismissed
from ..stga_addon.jobs.table import TRAINS, Kind
from ..stga_addon.scene import vertex_groups as groups
from ..stga_addon.training.effect_catalog import parse_choice
from ..stga_addon.training.run.folder import AVATAR, has_run, next_folder, read_run
from ..stga_addon.training.settings import PRESETS, TrainingSettings, make_settings
from ..stga_addon.worker.training_python import missing_packages
from . import monitor, options
from .common import Action, Edit, capture_source, file_path, head_of, needs_head
from .options import ONCE
from .request import idle, start
from .training_python import test, training_python

ALL_FRAMES = {"default": -1, "min": -1, "options": ONCE}


class AnalyzeCapture(Action, bpy.types.Operator):
    """Find out which effects the capture calls for, how long each preset takes on this machine, and
    whether the mesh fits its images"""

    repair: options.field(jobs.Train, "repair", options=ONCE)

    needs = (idle(Kind.ANALYSIS), needs_head)

    def run(self, context: Any) -> None:
        settings = context.scene.stga
        source = capture_source(head_of(context))
        refused = monitor.state_of(context.scene, Kind.TRAINING)
        if self.repair and refused.can_be_dismissed and refused.snapshot.state.failed:
            monitor.handle(context.scene, Kind.TRAINING, Dismissed())
        effects = dict(map(parse_choice, chosen_effects(settings)))
        timed = not self.repair
        request = Analyze(*source, effects, settings.device, timed=timed, repair=self.repair)
        start(context.scene, request, training_python(context))


def chosen_effects(settings: Any) -> list[str]:
    """The user's choices of effects, as NAME=on or NAME=off."""
    return [f"{row.name}={row.choice}" for row in settings.effects if row.choice != "auto"]


# Options of the operators, and of the panel that calls them


def preset_property(**more: Any) -> Any:
    """Training preset: of the operator, and of the panel, which also takes over its time."""
    purposes = (
        (name, name.capitalize(), preset.purpose.capitalize()) for name, preset in PRESETS.items()
    )
    default = ("none", "Default", "Default settings, trained for the time in Minutes")
    description = "Accuracy, and with it training time"
    return options.choice("Preset", description, default, *purposes, **more)


def list_adapters(owner: Any, context: Any, text: str) -> list[str]:
    """The GPUs that the last test of the Python found, in its order."""
    return list(test.found.adapters) if test.found else []


class DeviceOptions:
    """Where an avatar is trained."""

    device: options.choice(
        "Device",
        "Device that trains. Auto resumes a run on the device that it was trained on",
        ("auto", "Auto", "A GPU if one is faster than the CPU and right, else the CPU"),
        ("cpu", "CPU", "The processor"),
        ("gpu", "GPU", "A GPU; training fails if none works"),
    )
    adapter: options.text(
        "GPU",
        "Name of the GPU; empty: the first. The list is that of the last test of the Python",
        search=list_adapters,
        search_options={"SUGGESTION"},
    )


class TrainOptions(DeviceOptions):
    """How an avatar is trained."""

    minutes: options.number("Minutes", "Training time", default=5.0, min=0.01)
    strategy: options.field(
        TrainingSettings, "strategy", labels={"gaussian-avatars": "GaussianAvatars"}
    )
    preset: preset_property()


class RefineOptions:
    """What is refined, and for how long."""

    group: options.text(
        "Vertex Group",
        "Vertex group whose triangles are refined; empty: the active one. In Edit Mode, the "
        "selected triangles are refined instead",
    )
    seconds: options.field(
        jobs.Refine, "seconds", description="Training time", default=20.0, min=0.1
    )
    growth: options.field(jobs.Refine, "growth", "More Splats", soft_max=2.0, subtype="FACTOR")


class ExtendOptions:
    """What a run is extended by, and for how long."""

    take: options.path(
        "Take", "Further capture of the same head, or video or folder of photos", "DIR_PATH"
    )
    seconds: options.field(
        jobs.Extend, "seconds", description="Training time", default=60.0, min=0.1
    )


class TrainingOperator(Action):
    """Mixin of operators that train: options which no panel has, and the start of a training."""

    needs = (needs_head, idle(*TRAINS))

    iterations: options.field(TrainingSettings, "iterations", options=ONCE)
    python: options.python("trains")
    wait: options.boolean(
        "Wait",
        "Return when training has ended, as always without a window; Blender's own Python trains "
        "then, if it has the packages",
        options=ONCE,
    )

    def start(self: Any, context: Any, request: Any) -> None:
        """Start the training, or wait for it; Blender's own Python trains where it waits and has
        the packages. Raises StgaError."""
        waits = self.wait or bpy.app.background
        python = None
        if not waits or self.python or missing_packages():
            python = training_python(context, self.python)
        if start(context.scene, request, python, wait=self.wait):
            self.inform(f"Trained {request.run}")

    @property
    def chosen_device(self: Any) -> str:
        """What `choose_device` takes."""
        is_named = self.device == "gpu" and self.adapter
        return f"gpu:{self.adapter}" if is_named else str(self.device)

    def budget(self: Any, seconds: float) -> dict[str, Any]:
        return {"iterations": self.iterations} if self.iterations else {"seconds": seconds}


class Train(TrainingOperator, TrainOptions, bpy.types.Operator):
    """Train the avatar on the capture's images, in a process that continues when Blender is
    closed"""

    bl_label = "Train Avatar"

    directory: options.path("Run Folder", "Folder for the avatar and its checkpoints", "DIR_PATH")
    seed: options.field(TrainingSettings, "seed", options=ONCE)
    effects: options.text(
        "Effects",
        "NAME=on or NAME=off, separated by spaces, for effects that the capture should not decide",
        options=ONCE,
    )
    resume: options.boolean(
        "Resume",
        "Continue the run in the folder with the settings and budget that it was started with",
        options=ONCE,
    )
    more: options.boolean(
        "More", "Train the run in the folder for so many minutes more", options=ONCE
    )

    def run(self, context: Any) -> None:
        head = head_of(context)
        run = file_path(self.directory, "run folder").resolve()
        capture, flame, point = capture_source(head)
        if not capture.is_dir():
            expected = "expected the capture that the head was imported from"
            raise StgaError(f"{capture}: is not a folder; {expected}")
        selection = groups.training_selection(head)
        if self.resume or self.more:
            # with takes, the head may be that of any of them
            moved = None if read_run(run).takes else capture
            device = self.chosen_device
            more_s = 60 * self.minutes if self.more else None
            self.start(context, jobs.Resume(run, moved, flame, point, device, selection, more_s))
            return
        if has_run(run):
            run = self._take_next_folder(context, run)
        preset = None if self.preset == "none" else self.preset
        effects = None
        if self.strategy != "gaussian-avatars":
            effects = dict(map(parse_choice, self.effects.split()))
        budget = self.budget(60 * self.minutes)
        settings = make_settings(
            self.strategy, preset=preset, seed=self.seed, effects=effects, **budget
        )
        request = jobs.Train(run, capture, settings, flame, point, self.chosen_device, selection)
        self.start(context, request)

    def _take_next_folder(self, context: Any, occupied: Path) -> Path:
        """The next free folder beside one that holds a run, also in the panel."""
        free = next_folder(occupied)
        settings = context.scene.stga
        if Path(bpy.path.abspath(settings.run_folder)).resolve() == occupied:
            given = settings.run_folder.rstrip("/\\")
            settings.run_folder = given.removesuffix(occupied.name) + free.name
        self.warn(f"'{occupied.name}' is taken: training into '{free.name}' beside it")
        return free


class ContinueOperator(TrainingOperator, Edit):
    """Mixin of operators that train a run further, in a new folder."""

    def go_on(self: Any, context: Any, make: Any, *what: Any, **more: Any) -> None:
        """Start the training of the request `make(run, parent, *what, …)`; the panel stays at the
        run before until the new one has an avatar. Raises StgaError where there is no avatar to go
        on with."""
        parent = file_path(self.directory, "run folder").resolve()
        if not (parent / AVATAR).is_file():
            raise StgaError(f"{parent}: holds no trained avatar; train one first")
        source = {"flame": capture_source(head_of(context))[1], "device": self.chosen_device}
        how = {**more, **self.budget(self.seconds), **source}
        self.start(context, make(next_folder(parent), parent, *what, **how))


class Refine(ContinueOperator, RefineOptions, DeviceOptions, bpy.types.Operator):
    """Train one region of the avatar further; all other splats stay as they are. In Edit Mode the
    region is the selected triangles, otherwise a vertex group"""

    directory: options.path("Run Folder", "Folder of the run to refine", "DIR_PATH")
    region: options.text(
        "Region",
        "Region of the capture, such as mouth, to refine instead of a vertex group",
        options=ONCE,
    )
    first: options.integer("First Frame", "First frame to train on", **ALL_FRAMES)
    last: options.integer("Last Frame", "Last frame to train on; -1: all", **ALL_FRAMES)

    def run(self, context: Any) -> None:
        weights = None if self.region else self._painted_region(head_of(context))
        frames = None if self.last < 0 else (max(self.first, 0), self.last)
        self.go_on(context, jobs.Refine, self.region, weights, frames, growth=self.growth)

    def _painted_region(self, head: Any) -> np.ndarray:
        """(F,) weights of the triangles selected in Edit Mode, or of a vertex group. Raises
        StgaError for none."""
        if head.mode == "EDIT":
            weights = groups.selected_triangles(head).astype(np.float32)
            where = "no triangle is selected in Edit Mode"
        else:
            named = head.vertex_groups
            found = named.get(self.group) if self.group else named.active
            if found is None:
                problem = f"has no vertex group '{self.group}' to refine"
                raise StgaError(f"{head.name}: {problem}; paint one, or select in Edit Mode")
            weights = groups.read_triangle_weights(head, found.name)
            where = f"no triangle has all its corners in the vertex group '{found.name}'"
        if not (weights >= SELECTED_WEIGHT).any():
            raise StgaError(f"{head.name}: {where}")
        return weights


class Extend(ContinueOperator, ExtendOptions, DeviceOptions, bpy.types.Operator):
    """Train a further take of the same head into the avatar, which keeps what it has learned"""

    bl_label = "Extend with Take"

    directory: options.path("Run Folder", "Folder of the run to extend", "DIR_PATH")

    def run(self, context: Any) -> None:
        take = file_path(self.take, "take").resolve()
        if not take.exists():
            expected = "expected a further capture of the same head, or footage"
            raise StgaError(f"{take}: does not exist; {expected}")
        self.go_on(context, jobs.Extend, (take,))
