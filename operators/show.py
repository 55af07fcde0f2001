"""Avatar file → splats that follow the head."""

from typing import Any, ClassVar

import bpy

from ..stga_addon.avatar.file import read_avatar
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.scene.materials import view_transform_hint
from ..stga_addon.scene.splats import show_avatar
from . import ids
from .common import file_path, head_of, needs_head, reporting, settings


class ShowAvatar(bpy.types.Operator):
    """Show a trained avatar: splats that follow the animated head"""

    bl_idname = ids.SHOW_AVATAR
    bl_label = "Show Avatar"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    filepath: bpy.props.StringProperty(
        name="Avatar", description="Avatar file (.npz)", subtype="FILE_PATH", options=PATH_OPTIONS
    )
    hide_head: bpy.props.BoolProperty(
        name="Hide Head",
        description="Hide the head's own mesh, which covers the splats; it still moves them",
        default=True,
    )
    filter_glob: bpy.props.StringProperty(default="*.npz", options={"HIDDEN"})

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_head(cls, context)

    def invoke(self, context: Any, event: Any) -> set[str]:
        if self.filepath:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @reporting
    def execute(self, context: Any) -> set[str]:
        path, head = file_path(self.filepath, "avatar"), head_of(context)
        avatar = read_avatar(path)
        shown = show_avatar(avatar, head, f"{head.name} {path.stem}")
        if self.hide_head:
            head.hide_render = True
            if context.view_layer.objects.get(head.name) is head:
                head.hide_set(True)
        settings(context).avatar, settings(context).splats = self.filepath, shown
        hint = view_transform_hint(context.scene)
        self.report({"WARNING" if hint else "INFO"}, f"{len(avatar.splats)} splats" + (f". {hint}" if hint else ""))
        return {"FINISHED"}


class StandardView(bpy.types.Operator):
    """Show colours as they were trained: set the scene's view transform to Standard"""

    bl_idname = ids.STANDARD_VIEW
    bl_label = "Use Standard View Transform"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    def execute(self, context: Any) -> set[str]:
        context.scene.view_settings.view_transform = "Standard"
        context.scene.view_settings.look = "None"
        return {"FINISHED"}
