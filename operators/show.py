"""Shows an avatar file as splats that follow the head."""

import os
from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.avatar.file import Avatar, read_avatar
from ..stga_addon.scene.avatar_scene import show_world
from ..stga_addon.scene.display.splat_attributes import SplatAttributes
from ..stga_addon.scene.display.splat_object import hide_object, show_avatar
from ..stga_addon.training.run.folder import has_run
from . import ids
from .common import (
    FileImport,
    file_filter,
    file_path,
    head_of,
    needs_head,
    reporting,
    scene_settings,
    tell,
)


class ShowAvatar(bpy.types.Operator, FileImport):
    """Show a trained avatar: splats that follow the animated head"""

    bl_idname = ids.SHOW_AVATAR
    bl_label = "Show Avatar"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    filename_ext = ".npz"
    hide_head: bpy.props.BoolProperty(
        name="Hide Head",
        description="Hide the head's mesh, which covers the splats; it still deforms them",
        default=True,
    )
    filter_glob: file_filter(".npz")

    poll = classmethod(needs_head)

    @reporting
    def execute(self, context: Any) -> set[str]:
        path, head = file_path(self.filepath, "avatar"), head_of(context)
        avatar = read_avatar(path)
        show(context.scene, avatar, head, f"{head.name} {path.stem}", self.hide_head)
        show_world(path, head)
        settings = scene_settings(context)
        settings.avatar = self.filepath
        settings.run_folder = run_of(self.filepath) or settings.run_folder
        if self.hide_head and head.library is not None:
            sentence = (
                f"{head.name}: is linked, and covers the splats in renders; hide it in its file"
            )
            tell(self, "WARNING", sentence)
        self.report({"INFO"}, f"{len(avatar.splats)} splats")
        return {"FINISHED"}


def run_of(avatar: str) -> str:
    """The folder of the run that an avatar's path, which may begin with "//", lies in; or ""."""
    folder = os.path.dirname(avatar)
    return folder if has_run(Path(bpy.path.abspath(folder))) else ""


def show(
    scene: Any,
    avatar: Avatar,
    head: Any,
    name: str,
    hide_head: bool = True,
    attributes: SplatAttributes | None = None,
) -> Any:
    """Show the avatar on the head, and make the splat object the one that the panel works on.

    attributes: those of the avatar, where they are computed already.
    """
    shown = show_avatar(avatar, head, name, attributes)
    if hide_head:
        hide_object(head, scene)
    getattr(scene, ids.SETTINGS).splats = shown
    return shown


class StandardView(bpy.types.Operator):
    """Show colors as trained: set the scene's view transform to Standard"""

    bl_idname = ids.STANDARD_VIEW
    bl_label = "Use Standard View"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    def execute(self, context: Any) -> set[str]:
        context.scene.view_settings.view_transform = "Standard"
        context.scene.view_settings.look = "None"
        return {"FINISHED"}
