"""Files dropped into the 3D viewport: video, capture, avatar or FLAME motion, face performance,
Gaussian splats."""

import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.flame.sequence import FIELD_ALIASES, FRAME_FIELDS
from ..stga_addon.tracking.footage.sources import VIDEO_SUFFIXES
from . import options
from .apply_motion import ApplyMotion
from .common import Edit, call, file_path, is_head
from .options import ONCE

MOTION_FIELDS = {*FRAME_FIELDS, *FIELD_ALIASES, "pose"}


class OpenNpz(Edit, bpy.types.Operator):
    """Open an .npz file by its content: show an avatar, apply a FLAME motion to the head, or import
    it as a new one"""

    bl_label = "Open Avatar or Motion"
    bl_options = Edit.bl_options | {"INTERNAL"}

    filepath: options.path("File", "Avatar file or FLAME parameters (.npz)", options=ONCE)

    def run(self, context: Any) -> set[str]:
        path = file_path(self.filepath, "avatar or motion")
        is_avatar = npz_kind(path) == "avatar"
        if is_avatar and not is_head(context.scene.stga.head):
            raise StgaError(f"{path}: is an avatar, which needs a head; import a capture first")
        applies = not is_avatar and ApplyMotion.poll(context)
        motion = bpy.ops.stga.apply_motion if applies else bpy.ops.stga.import_motion
        return call(bpy.ops.stga.show_avatar if is_avatar else motion, filepath=str(path))


def npz_kind(path: Path) -> str:
    """ "avatar" or "motion". Raises StgaError for any other file."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = {name.removesuffix(".npy") for name in archive.namelist()}
    except (OSError, zipfile.BadZipFile) as error:
        problem = getattr(error, "strerror", None) or error
        raise StgaError(f"{path}: cannot be read as an .npz file ({problem})") from error
    if {"header", "xyz"} <= names:
        return "avatar"
    if names & MOTION_FIELDS:
        return "motion"
    fields = ", ".join(FRAME_FIELDS)
    raise StgaError(
        f"{path}: is neither an avatar (no header) nor a FLAME motion (none of {fields})"
    )


class _ViewportDrop:
    """Mixin of file handlers: files are accepted by the 3D viewport."""

    @classmethod
    def poll_drop(cls, context: Any) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"


def _handler(name: str, label: str, operator: str, suffixes: Iterable[str]) -> type:
    """A file handler that gives dropped files to an operator."""
    about = {"bl_idname": f"STGA_FH_{name}", "bl_label": f"{label} (STGA)"}
    about |= {"bl_import_operator": operator, "bl_file_extensions": ";".join(suffixes)}
    kinds = (_ViewportDrop, bpy.types.FileHandler)
    return type(f"{name.title()}Drop", kinds, about | {"__module__": __name__})


VideoDrop = _handler("video", "Avatar from Video", "stga.avatar_from_video", VIDEO_SUFFIXES)
CaptureDrop = _handler("capture", "Head Capture", "stga.import_capture", [".json"])
NpzDrop = _handler("npz", "Avatar or FLAME Motion", "stga.open_npz", [".npz"])
PlyDrop = _handler("ply", "Gaussian Splats", "stga.import_ply", [".ply"])
# Blender asks which handler to use for .json files, which captures have too.
PERFORMANCES = (".csv", ".json", ".txt")
PerformanceDrop = _handler("performance", "Face Performance", "stga.apply_motion", PERFORMANCES)
