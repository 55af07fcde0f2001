"""Copies the report of a failed worker to the clipboard."""

import platform
from typing import Any, ClassVar

import bpy

from ..stga_addon import __version__
from ..stga_addon.jobs.table import Kind
from ..stga_addon.worker.status import failure_report
from . import ids, monitor
from .common import file_path, reporting


class CopyReport(bpy.types.Operator):
    """Copy the error message, traceback and log of a worker to the clipboard"""

    bl_idname = ids.COPY_REPORT
    bl_label = "Copy Report"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    directory: bpy.props.StringProperty(
        name="Folder",
        description="Status folder of the worker; empty: that of the scene's training",
        subtype="DIR_PATH", options={"SKIP_SAVE"},
    )  # fmt: skip

    @reporting
    def execute(self, context: Any) -> set[str]:
        training = monitor.state_of(context.scene, Kind.TRAINING).folder
        folder = (
            training if training and not self.directory else file_path(self.directory, "folder")
        )
        versions = f"STGA {__version__}, Blender {bpy.app.version_string}, {platform.platform()}"
        context.window_manager.clipboard = (
            f"{versions}\n{failure_report(folder, monitor.inspect_status(folder))}"
        )
        self.report({"INFO"}, "Copied to the clipboard")
        return {"FINISHED"}
