"""Files dropped into the 3D viewport: video, capture, avatar or FLAME motion, face performance,
Gaussian splats."""

import zipfile
from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.flame.sequence import FIELD_ALIASES, FRAME_FIELDS
from ..stga_addon.tracking.footage.sources import VIDEO_SUFFIXES
from . import ids
from .apply_motion import ApplyMotion
from .common import file_path, is_head, path_property, reporting, scene_settings

MOTION_FIELDS = {*FRAME_FIELDS, *FIELD_ALIASES, "pose"}


class OpenNpz(bpy.types.Operator):
    """Open an .npz file by its content: show an avatar, apply a FLAME motion to the head, or import
    it as a new one"""

    bl_idname = ids.OPEN_NPZ
    bl_label = "Open Avatar or Motion"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO", "INTERNAL"}

    filepath: path_property("File", "Avatar file or FLAME parameters (.npz)", options={"SKIP_SAVE"})

    @reporting
    def execute(self, context: Any) -> set[str]:
        path = file_path(self.filepath, "avatar or motion")
        if npz_kind(path) == "avatar":
            if not is_head(scene_settings(context).head):
                raise StgaError(f"{path}: is an avatar, which needs a head; import a capture first")
            operator = bpy.ops.stga.show_avatar
        else:
            operator = (
                bpy.ops.stga.apply_motion
                if ApplyMotion.poll(context)
                else bpy.ops.stga.import_motion
            )
        try:
            result: set[str] = operator(filepath=str(path))
        except RuntimeError as error:
            raise StgaError(str(error).strip().removeprefix("Error: ")) from error
        return result


def npz_kind(path: Path) -> str:
    """ "avatar" or "motion". Raises StgaError for any other file."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = {name.removesuffix(".npy") for name in archive.namelist()}
    except (OSError, zipfile.BadZipFile) as error:
        raise StgaError(
            f"{path}: cannot be read as an .npz file ({getattr(error, 'strerror', None) or error})"
        ) from error
    if {"header", "xyz"} <= names:
        return "avatar"
    if names & MOTION_FIELDS:
        return "motion"
    raise StgaError(
        f"{path}: is neither an avatar (no header) nor a FLAME motion (none of "
        f"{', '.join(FRAME_FIELDS)})"
    )


class _ViewportDrop:
    """Mixin of file handlers: files are accepted by the 3D viewport."""

    @classmethod
    def poll_drop(cls, context: Any) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"


class VideoDrop(_ViewportDrop, bpy.types.FileHandler):
    bl_idname = "STGA_FH_video"
    bl_label = "Avatar from Video (STGA)"
    bl_import_operator = ids.AVATAR_FROM_VIDEO
    bl_file_extensions = ";".join(VIDEO_SUFFIXES)


class CaptureDrop(_ViewportDrop, bpy.types.FileHandler):
    bl_idname = "STGA_FH_capture"
    bl_label = "Head Capture (STGA)"
    bl_import_operator = ids.IMPORT_CAPTURE
    bl_file_extensions = ".json"


class AvatarDrop(_ViewportDrop, bpy.types.FileHandler):
    bl_idname = "STGA_FH_npz"
    bl_label = "Avatar or FLAME Motion (STGA)"
    bl_import_operator = ids.OPEN_NPZ
    bl_file_extensions = ".npz"


class PlyDrop(_ViewportDrop, bpy.types.FileHandler):
    bl_idname = "STGA_FH_ply"
    bl_label = "Gaussian Splats (STGA)"
    bl_import_operator = ids.IMPORT_PLY
    bl_file_extensions = ".ply"


class PerformanceDrop(_ViewportDrop, bpy.types.FileHandler):
    """Blender asks which handler to use for .json files, which captures have too."""

    bl_idname = "STGA_FH_performance"
    bl_label = "Face Performance (STGA)"
    bl_import_operator = ids.APPLY_MOTION
    bl_file_extensions = ".csv;.json;.txt"
