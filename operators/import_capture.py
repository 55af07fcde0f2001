"""Imports a capture: the tracked head and the cameras."""

from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.capture.open import OWN_MODELS, open_capture
from ..stga_addon.capture.transforms import DEFAULT_PRINCIPAL_POINT, has_transforms
from ..stga_addon.errors import StgaError
from ..stga_addon.scene import tags
from ..stga_addon.scene.avatar_scene import frame_head
from ..stga_addon.scene.cameras import central, configure_scene, import_cameras
from ..stga_addon.scene.objects import COLLECTIONS, capture_root, leave_edit_mode, show_kind
from ..stga_addon.scene.rig.head import import_head
from ..stga_addon.tracking.folder import is_tracked
from . import ids, monitor
from .arkit_controls import begin_sliders
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
    tell,
)
from .prepare import begin_preparing

FOLDERS_ABOVE_FILE = 3
"""In which the capture of an image, mask, mesh or parameter file is looked for."""


class ImportCapture(bpy.types.Operator, FileImport):
    """Import a multi-view capture: the tracked head, animated over its frames, and its cameras with
    images"""

    bl_idname = ids.IMPORT_CAPTURE
    bl_label = "Import Capture"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    filepath: path_property(
        "File", "Folder of the capture, or any file in it", options={"SKIP_SAVE"}
    )
    directory: path_property(
        "Capture",
        "Folder of the capture, with its transforms files or meshes; not needed where a file is "
        "given",
        "DIR_PATH", options={"SKIP_SAVE"},
    )  # fmt: skip
    flame: flame_property()
    principal_point: bpy.props.EnumProperty(
        name="Principal Point", description="Meaning of cx and cy in the transforms files",
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
    )  # fmt: skip
    correctives: bpy.props.EnumProperty(
        name="Correctives",
        description="FLAME joints that get pose correctives: shape keys, with drivers, that "
        "correct the mesh",
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
        description="Set the scene's resolution, camera and frame rate to those of the capture, "
        "and its view transform to Standard, which the splats' colors are trained for",
        default=True,
    )
    filter_glob: file_filter("")

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
    """The folder of a capture that is given by its folder or by any file in it. Raises StgaError
    for another file."""
    inside = [] if path.is_dir() else path.parents[:FOLDERS_ABOVE_FILE]
    folder = next((parent for parent in inside if has_transforms(parent)), path)
    if folder.is_file():
        raise StgaError(f"{path}: is in no capture; choose a capture's folder, or a file in it")
    return folder


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
    warn = partial(tell, operator, "WARNING")
    has_model = not flame and any((source / name).is_file() for name in OWN_MODELS)
    model = None if has_model else flame_model_path(context, flame)
    capture = open_capture(source, flame=model, principal_point=principal_point)
    is_first = not any(is_head(thing) for thing in context.scene.objects)
    head = import_head(capture, warn=warn, correctives=correctives)
    cameras = import_cameras(capture, capture_root(capture.root), warn=warn)
    head[tags.FLAME_MODEL] = str(capture.flame_file or "")
    head[tags.PRINCIPAL_POINT] = principal_point
    head[tags.TRACKED] = is_tracked(capture.root)
    scene_settings(context).head = head
    scene, objects = context.scene, context.view_layer.objects
    scene.frame_start, scene.frame_end = capture.timesteps[0], capture.timesteps[-1]
    scene.frame_set(capture.timesteps[0])
    leave_edit_mode()
    for thing in objects.selected:
        thing.select_set(False)
    if objects.get(head.name) is head:
        head.select_set(True)
        objects.active = head
    if is_first:  # later on, a cube that is shown was shown by the user
        _hide_start_up_cube(context)
    middle = central(cameras)
    for kind in COLLECTIONS:
        show_kind(head.parent, kind, context.view_layer, False)
    if context.window is not None and not bpy.app.background:
        frame_head(head, middle, [context.window.screen])
    if set_up_scene and cameras:
        configure_scene(scene, capture, middle, warn=warn)
    for sentence in capture.warnings:
        warn(sentence)
    counted = {"timesteps": capture.timesteps, "triangles": capture.faces, "cameras": cameras}
    operator.report({"INFO"}, ", ".join(f"{len(all_)} {name}" for name, all_ in counted.items()))
    begin_sliders(head)
    monitor.show_panel()
    begin_preparing(context)


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
