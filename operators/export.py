"""Exports an avatar to the files of other viewers."""

from typing import Any, ClassVar

import bpy
from bpy_extras.io_utils import ExportHelper

from ..stga_addon.avatar.export import export_avatar
from ..stga_addon.avatar.file import read_avatar
from ..stga_addon.scene.arrays import evaluated_vertices
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.scene.display.splat_object import check_head
from ..stga_addon.scene.rig.motion import sample_motion
from ..stga_addon.scene.timeline import iterate_frames
from . import ids
from .common import capture_of, file_path, flame_of, head_of, needs_head, reporting, scene_settings


class ExportAvatar(bpy.types.Operator, ExportHelper):
    """Export a trained avatar, posed as the head in the scene, for other viewers of Gaussian splats"""

    bl_idname = ids.EXPORT_AVATAR
    bl_label = "Export Avatar"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    filepath: bpy.props.StringProperty(
        name="File or Folder",
        description="A file for the format PLY, a folder for the others",
        subtype="FILE_PATH",
        options=PATH_OPTIONS | {"SKIP_SAVE"},
    )
    avatar: bpy.props.StringProperty(
        name="Avatar",
        description="Avatar file (.npz); empty: the one shown",
        subtype="FILE_PATH",
        options=PATH_OPTIONS | {"SKIP_SAVE"},
    )
    format: bpy.props.EnumProperty(
        name="Format",
        description="File format",
        items=(
            ("ply", "PLY", "The current frame in world space, for any 3D Gaussian Splatting viewer"),
            ("ply-sequence", "PLY Sequence", "One PLY in world space for each frame of the scene"),
            (
                "gaussian-avatars",
                "GaussianAvatars",
                "The frames of the scene as point_cloud.ply and flame_param.npz; FLAME heads",
            ),
        ),
    )

    filter_glob: bpy.props.StringProperty(default="*.ply", options={"HIDDEN"})

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_head(cls, context)

    @property
    def filename_ext(self) -> str:
        """What ExportHelper appends to the path."""
        return ".ply" if self.format == "ply" else ""

    def check(self, context: Any) -> bool:
        """Keep the path's extension in step with the format; whether it changed."""
        path = self.filepath.removesuffix(".ply")
        if self.format == "ply":
            path = bpy.path.ensure_ext(path, ".ply")
        changed, self.filepath = path != self.filepath, path
        return changed

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = head_of(context)
        path = file_path(self.filepath, "export")
        source = file_path(self.avatar or scene_settings(context).avatar, "avatar")
        avatar = read_avatar(source)
        check_head(avatar, head)
        if self.format == "ply" and not path.suffix:
            path = path.with_suffix(".ply")
        motion = None
        if self.format == "gaussian-avatars":
            own = flame_of(capture_of(head), head.name)
            motion = sample_motion(head, own, _frames(context), self._warn)
        frames = iterate_frames(_frames(context)) if self.format == "ply-sequence" else (context.scene.frame_current,)
        export_avatar(path, avatar, self.format, ((frame, evaluated_vertices(head)) for frame in frames), motion)
        self.report({"INFO"}, f"Exported {len(avatar.splats)} splats to {path}")
        return {"FINISHED"}

    def _warn(self, sentence: str) -> None:
        self.report({"WARNING"}, sentence)


def _frames(context: Any) -> range:
    return range(context.scene.frame_start, context.scene.frame_end + 1)
