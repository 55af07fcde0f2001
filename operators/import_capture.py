"""Imports a capture: the tracked head and the cameras."""

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.capture.model import Capture
from ..stga_addon.capture.open import OWN_MODELS, open_capture
from ..stga_addon.capture.transforms import DEFAULT_PRINCIPAL_POINT
from ..stga_addon.errors import StgaError
from ..stga_addon.scene import tags
from ..stga_addon.scene.avatar_scene import frame_head
from ..stga_addon.scene.cameras import central, configure_scene, import_cameras
from ..stga_addon.scene.objects import COLLECTIONS, capture_root, leave_edit_mode, show_kind
from ..stga_addon.scene.rig.head import import_head
from ..stga_addon.tracking.folder import is_tracked
from . import ids
from .common import (
    FileImport,
    file_filter,
    file_path,
    flame_model_path,
    flame_property,
    is_head,
    path_property,
    reporting,
    scene_settings,
)
from .prepare import begin_preparing


class ImportCapture(bpy.types.Operator, FileImport):
    """Import a multi-view capture: the tracked head, animated over its frames, and its cameras with
    images"""

    bl_idname = ids.IMPORT_CAPTURE
    bl_label = "Import Capture"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    filepath: path_property(
        "File",
        "Transforms file of the capture, such as transforms_train.json; or its folder",
        options={"SKIP_SAVE"},
    )
    directory: path_property(
        "Capture",
        "Folder of the capture, with its transforms files or meshes; not needed where a file is given",
        "DIR_PATH",
        options={"SKIP_SAVE"},
    )
    flame: flame_property()
    principal_point: bpy.props.EnumProperty(
        name="Principal Point",
        description="Meaning of cx and cy in the transforms files",
        items=(
            (
                "vhap",
                "VHAP",
                "cy is counted from the bottom of the image, as VHAP's exporter writes it",
            ),
            ("opencv", "OpenCV", "cx and cy are counted from the top left corner of the image"),
            ("center", "Image Center", "cx and cy are ignored, as GaussianAvatars does"),
        ),
        options={"SKIP_SAVE"},
    )
    correctives: bpy.props.EnumProperty(
        name="Correctives",
        description="FLAME joints that get pose correctives: shape keys, with drivers, that correct the mesh",
        items=(
            ("all", "All Joints", "Every bone can be posed by hand and gives FLAME's exact mesh"),
            (
                "moving",
                "Moving Joints",
                "Joints that move in this capture only: fewer shape keys and drivers",
            ),
        ),
    )
    set_up_scene: bpy.props.BoolProperty(
        name="Set Up Scene",
        description="Set the scene's resolution, camera and frame rate to those of the capture, and its view transform "
        "to Standard, which the splats' colors are trained for",
        default=True,
    )
    filter_glob: file_filter(".json")

    @reporting
    def execute(self, context: Any) -> set[str]:
        folder = _capture_folder(file_path(self.filepath or self.directory, "capture"))
        bring_in(
            self,
            context,
            folder,
            self.flame,
            self.principal_point,
            self.set_up_scene,
            self.correctives,
        )
        return {"FINISHED"}


def _capture_folder(path: Path) -> Path:
    """The folder of a capture that is given by its folder or a transforms file. Raises StgaError
    for another file."""
    if not path.is_file():
        return path
    if path.suffix.lower() == ".json" and path.name.startswith("transforms"):
        return path.parent
    raise StgaError(
        f"{path}: is not a transforms file; choose a capture's transforms_train.json, or its folder"
    )


def bring_in(
    operator: Any,
    context: Any,
    source: Path,
    flame: str = "",
    principal_point: str = DEFAULT_PRINCIPAL_POINT,
    set_up_scene: bool = False,
    correctives: str = "all",
) -> None:
    """Import what `open_capture` reads from `source`, and make it the scene's head. Raises
    StgaError."""

    def warn(sentence: str) -> None:
        operator.report({"WARNING"}, sentence)

    capture = _open(context, source, flame, principal_point)
    is_first = not any(is_head(thing) for thing in context.scene.objects)
    head = import_head(capture, warn=warn, correctives=correctives)
    cameras = import_cameras(capture, capture_root(capture.root), warn=warn)
    head[tags.FLAME_MODEL] = str(capture.flame_file or "")
    head[tags.PRINCIPAL_POINT] = principal_point
    head[tags.TRACKED] = is_tracked(capture.root)
    scene_settings(context).head = head
    _show_first_frame(context.scene, capture)
    _select_only(context, head)
    if is_first:  # later on, a cube that is shown was shown by the user
        _hide_start_up_cube(context)
    middle = central(cameras)
    for kind in COLLECTIONS:
        show_kind(head.parent, kind, context.view_layer, False)
    if context.window is not None and not bpy.app.background:
        frame_head(head, middle, [context.window.screen])
    if set_up_scene and cameras:
        configure_scene(context.scene, capture, middle, warn=warn)
    for sentence in capture.warnings:
        warn(sentence)
    counts = f"{len(capture.timesteps)} timesteps, {len(capture.faces)} triangles, {len(cameras)} cameras"
    operator.report({"INFO"}, counts)
    begin_preparing(context)


def _open(context: Any, source: Path, flame: str, principal_point: str) -> Capture:
    """The capture, with the FLAME model that is given, else its own, else that of the preferences.
    Raises StgaError."""
    has_model = not flame and any((source / name).is_file() for name in OWN_MODELS)
    model = None if has_model else flame_model_path(context, flame)
    return open_capture(source, flame=model, principal_point=principal_point)


def _show_first_frame(scene: Any, capture: Capture) -> None:
    scene.frame_start, scene.frame_end = capture.timesteps[0], capture.timesteps[-1]
    scene.frame_set(capture.timesteps[0])


def _hide_start_up_cube(context: Any) -> None:
    """Hide the cube of Blender's start-up scene where it is as it came: 2 m wide, it would enclose
    the head."""
    cube = context.view_layer.objects.get("Cube")
    if cube is None or cube.library or cube.type != "MESH" or len(cube.data.vertices) != 8:
        return
    if cube.modifiers or cube.animation_data:
        return
    if cube.matrix_world.is_identity and tuple(cube.dimensions) == (2.0, 2.0, 2.0):
        cube.hide_set(True)
        cube.hide_render = True


def _select_only(context: Any, head: Any) -> None:
    """Select the head and nothing else, as Blender's importers do."""
    leave_edit_mode()
    for thing in context.view_layer.objects.selected:
        thing.select_set(False)
    if context.view_layer.objects.get(head.name) is head:
        head.select_set(True)
        context.view_layer.objects.active = head
