"""Opens the capture of a generated person that the complete edition brings."""

import shutil
from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.training.run.folder import has_run
from . import ids
from .common import package, polled, reporting, scene_settings
from .import_capture import bring_in

BUNDLED = Path(__file__).parents[1] / "demo_capture"
"""In the complete edition; the others have none."""
MINUTES = 1.0


class OpenDemo(bpy.types.Operator):
    """Open a small capture of a generated person, to try training in a minute"""

    bl_idname = ids.OPEN_DEMO
    bl_label = "Open Demo Capture"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        return polled(
            cls, BUNDLED.is_dir(), "Only the complete edition of the add-on brings the demo capture"
        )

    @reporting
    def execute(self, context: Any) -> set[str]:
        bring_in(self, context, _own_copy(), set_up_scene=True)
        settings = scene_settings(context)
        settings.run_folder = str(_free_run_folder(Path.home() / "STGA Demo"))
        settings.minutes = MINUTES
        return {"FINISHED"}


def _own_copy() -> Path:
    """The capture in Blender's folder for user files, where an update of the add-on leaves it in
    place."""
    folder = Path(bpy.utils.extension_path_user(package(), path="demo", create=True)) / "capture"
    try:
        shutil.copytree(BUNDLED, folder, dirs_exist_ok=True)
    except (OSError, shutil.Error) as error:
        raise StgaError(
            f"{folder}: cannot be written ({getattr(error, 'strerror', None) or error})"
        ) from error
    return folder


def _free_run_folder(folder: Path) -> Path:
    """A folder for a run that holds none yet, in a folder that the user finds again."""
    names = ("run", *(f"run {number}" for number in range(2, 1000)))
    return next(folder / name for name in names if not has_run(folder / name))
