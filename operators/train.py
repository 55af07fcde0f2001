"""Capture and selection → trained avatar, in Blender's own process."""

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.capture.model import Capture
from ..stga_addon.errors import StgaError
from ..stga_addon.scene import tags
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.scene.groups import read_selection
from . import ids
from .common import capture_of, file_path, head_of, needs_head, reporting, settings

# module -> what pip calls it
NEEDED = {"torch": "torch", "numba": "numba", "scipy": "scipy", "PIL": "pillow", "platformdirs": "platformdirs"}


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


class Train(bpy.types.Operator):
    """Train the avatar on the capture's images, in Blender's own process; Blender waits until the time is up"""

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
    seed: bpy.props.IntProperty(name="Seed", description="Fixes every random choice", min=0)

    resume: bpy.props.BoolProperty(
        name="Resume",
        description="Continue the run in the folder, with the settings and the budget it was started with",
    )

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_head(cls, context)

    @reporting
    def execute(self, context: Any) -> set[str]:
        _require_runtime()
        head = head_of(context)
        capture = capture_of(head)
        folder = file_path(self.directory, "run folder")
        avatar = self._train(context, capture, folder, head)
        settings(context).avatar = str(avatar)
        self.report({"INFO"}, f"Trained {avatar}")
        return {"FINISHED"}

    def _train(self, context: Any, capture: Capture, folder: Path, head: Any) -> Path:
        from ..stga_addon.training.folder import Run, read_run
        from ..stga_addon.training.run import train
        from ..stga_addon.training.settings import make_settings

        if self.resume:
            run = read_run(folder)
        else:
            budget = {"iterations": self.iterations} if self.iterations else {"seconds": 60 * self.minutes}
            chosen = make_settings(self.strategy, seed=self.seed, **budget)
            flame = Path(head[tags.FLAME_MODEL]) if head[tags.FLAME_MODEL] else None
            run = Run(capture.root, flame, head[tags.PRINCIPAL_POINT], chosen)
        manager = context.window_manager

        def show(progress: Any) -> bool:
            manager.progress_update(100 * progress.share)
            return False

        manager.progress_begin(0, 100)
        try:
            return train(capture, folder, run, _painted_selection(head), resume=self.resume, report=show)
        finally:
            manager.progress_end()


def _painted_selection(head: Any) -> dict[int, Any] | None:
    """The head's selection groups as they are now; None where there are none, so that the trainer selects itself."""
    if any(tags.group_timestep(group.name) is not None for group in head.vertex_groups):
        return read_selection(head)
    return None


def _require_runtime() -> None:
    missing = [package for module, package in NEEDED.items() if find_spec(module) is None]
    if missing:
        python = f"{sys.executable}, {sys.version.split()[0]}"
        raise StgaError(
            f"training needs {', '.join(missing)} in Blender's own Python ({python}): install what is missing, "
            "or train outside Blender with `python -m stga_addon train` and show the avatar here"
        )
