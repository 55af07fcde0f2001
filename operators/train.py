"""Capture and selection → trained avatar, in Blender's own process."""

import sys
from importlib.util import find_spec
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.scene import tags
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.scene.groups import read_selection
from . import ids
from .common import capture_of, file_path, head_of, needs_head, reporting, settings

NEEDED = ("torch", "numba")


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
    strategy: bpy.props.EnumProperty(
        name="Strategy",
        description="Which splats an iteration trains",
        items=(
            ("selective", "Selective", "Local iterations on what each frame selects, global ones in between"),
            ("global", "Global", "Every iteration trains all splats"),
            ("gaussian-avatars", "GaussianAvatars", "That method's binding, losses and rates"),
        ),
    )
    seed: bpy.props.IntProperty(name="Seed", description="Fixes every random choice", min=0)

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_head(cls, context)

    @reporting
    def execute(self, context: Any) -> set[str]:
        folder = file_path(self.directory, "run folder")
        _require_runtime()
        from ..stga_addon.training.run import train
        from ..stga_addon.training.settings import make_settings

        head = head_of(context)
        budget = {"iterations": self.iterations} if self.iterations else {"seconds": 60 * self.minutes}
        chosen = make_settings(self.strategy, seed=self.seed, **budget)
        avatar = train(capture_of(head), folder, chosen, selection=_painted_selection(head))
        settings(context).avatar = str(avatar)
        self.report({"INFO"}, f"Trained {avatar}")
        return {"FINISHED"}


def _painted_selection(head: Any) -> dict[int, Any] | None:
    """The head's selection groups as they are now; None where there are none, so that the trainer selects itself."""
    if any(tags.group_timestep(group.name) is not None for group in head.vertex_groups):
        return read_selection(head)
    return None


def _require_runtime() -> None:
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        python = f"{sys.executable}, {sys.version.split()[0]}"
        raise StgaError(
            f"training needs {' and '.join(missing)} in Blender's own Python ({python}): install it there, "
            "or train outside Blender with `python -m stga_addon train` and show the avatar here"
        )
