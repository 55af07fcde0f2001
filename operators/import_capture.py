"""Capture folder → head and cameras."""

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.capture.model import Capture
from ..stga_addon.capture.open import open_capture
from ..stga_addon.scene import tags
from ..stga_addon.scene.cameras import configure_scene, import_cameras
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.scene.objects import capture_root, leave_edit_mode
from ..stga_addon.scene.rig.head import import_head
from . import ids
from .common import file_path, flame_model_path, flame_property, reporting, scene_settings


class ImportCapture(bpy.types.Operator):
    """Import a multi-view capture: the tracked head, animated over its frames, and the cameras with their images"""

    bl_idname = ids.IMPORT_CAPTURE
    bl_label = "Import Capture"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    directory: bpy.props.StringProperty(
        name="Capture",
        description="Folder that holds the capture's transforms files or meshes",
        subtype="DIR_PATH",
        options=PATH_OPTIONS,
    )
    flame: flame_property()
    principal_point: bpy.props.EnumProperty(
        name="Principal Point",
        description="What cx and cy in the transforms files mean",
        items=(
            ("vhap", "VHAP", "cy is counted from the bottom of the image, as VHAP's exporter writes it"),
            ("opencv", "OpenCV", "cx and cy are counted from the top left corner of the image"),
            ("center", "Image Center", "cx and cy are ignored, as GaussianAvatars does"),
        ),
    )
    correctives: bpy.props.EnumProperty(
        name="Correctives",
        description="Which of FLAME's joints get pose correctives: shape keys and drivers that correct the mesh",
        items=(
            ("all", "Every Joint", "Any bone posed by hand gives FLAME's own mesh"),
            ("moving", "Joints That Move", "Only what this capture turns: fewer shape keys and drivers"),
        ),
    )
    set_up_scene: bpy.props.BoolProperty(
        name="Set Up Scene",
        description="Give the scene the capture's resolution, its first camera and the Standard view "
        "transform, in which the splats' colours are trained",
        default=True,
    )
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})

    def invoke(self, context: Any, event: Any) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @reporting
    def execute(self, context: Any) -> set[str]:
        folder = file_path(self.directory, "capture")
        bring_in(self, context, folder, self.flame, self.principal_point, self.set_up_scene, self.correctives)
        return {"FINISHED"}


def bring_in(
    operator: Any,
    context: Any,
    source: Path,
    flame: str = "",
    principal_point: str = "vhap",
    set_up_scene: bool = False,
    correctives: str = "all",
) -> None:
    """Import what `open_capture` makes of `source` and work on it from here on. Raises StgaError."""

    def warn(sentence: str) -> None:
        operator.report({"WARNING"}, sentence)

    model = flame_model_path(context, flame)
    capture = open_capture(source, flame=model, principal_point=principal_point)
    head = import_head(capture, warn=warn, correctives=correctives)
    cameras = import_cameras(capture, capture_root(capture.root), warn=warn)
    head[tags.FLAME_MODEL] = str(model or "")
    head[tags.PRINCIPAL_POINT] = principal_point
    scene_settings(context).head = head
    _show_first_frame(context.scene, capture)
    _select_only(context, head)
    _frame_in_viewports(context, head)
    if set_up_scene and cameras:
        configure_scene(context.scene, capture, cameras[0], warn=warn)
    for sentence in capture.warnings:
        warn(sentence)
    counts = f"{len(capture.timesteps)} timesteps, {len(capture.faces)} triangles, {len(cameras)} cameras"
    operator.report({"INFO"}, counts)


def _show_first_frame(scene: Any, capture: Capture) -> None:
    scene.frame_start, scene.frame_end = capture.timesteps[0], capture.timesteps[-1]
    scene.frame_set(capture.timesteps[0])


def _select_only(context: Any, head: Any) -> None:
    """As Blender's importers leave what they bring in."""
    leave_edit_mode()
    for thing in context.view_layer.objects.selected:
        thing.select_set(False)
    if context.view_layer.objects.get(head.name) is head:
        head.select_set(True)
        context.view_layer.objects.active = head


def _frame_in_viewports(context: Any, head: Any) -> None:
    """Look at the head, which is small beside Blender's usual scenes; a view through a camera stays."""
    if bpy.app.background or context.window is None or not head.visible_get(view_layer=context.view_layer):
        return
    for area in context.window.screen.areas:
        if area.type == "VIEW_3D" and area.spaces.active.region_3d.view_perspective != "CAMERA":
            region = next(region for region in area.regions if region.type == "WINDOW")
            with context.temp_override(area=area, region=region):
                bpy.ops.view3d.view_selected()
