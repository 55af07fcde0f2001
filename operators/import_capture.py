"""Capture folder → head and cameras."""

from typing import Any, ClassVar

import bpy

from ..stga_addon.capture.open import open_capture
from ..stga_addon.scene import tags
from ..stga_addon.scene.cameras import configure_scene, import_cameras
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.scene.head import import_head
from ..stga_addon.scene.hierarchy import capture_root
from . import ids
from .common import file_path, reporting, settings


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
    flame: bpy.props.StringProperty(
        name="FLAME Model",
        description="Your own FLAME model file (.pkl or .npz), for captures tracked with FLAME; "
        "empty: the one in the preferences",
        subtype="FILE_PATH",
        options=PATH_OPTIONS,
    )
    principal_point: bpy.props.EnumProperty(
        name="Principal Point",
        description="What cx and cy in the transforms files mean",
        items=(
            ("vhap", "VHAP", "cy is counted from the bottom of the image, as VHAP's exporter writes it"),
            ("opencv", "OpenCV", "cx and cy are counted from the top left corner of the image"),
            ("centre", "Image Centre", "cx and cy are ignored, as GaussianAvatars does"),
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
        model = self.flame or _preferred_model(context)
        flame = file_path(model, "FLAME model") if model else None
        capture = open_capture(folder, flame=flame, principal_point=self.principal_point)
        head = import_head(capture, warn=self._warn)
        cameras = import_cameras(capture, capture_root(capture.root), warn=self._warn)
        head[tags.FLAME_MODEL] = str(flame) if flame else ""
        head[tags.PRINCIPAL_POINT] = self.principal_point
        settings(context).head = head
        scene = context.scene
        scene.frame_start, scene.frame_end = capture.timesteps[0], capture.timesteps[-1]
        scene.frame_set(capture.timesteps[0])
        if self.set_up_scene and cameras:
            configure_scene(scene, capture, cameras[0], warn=self._warn)
        for sentence in capture.warnings:
            self._warn(sentence)
        self.report(
            {"INFO"}, f"{len(capture.timesteps)} timesteps, {len(capture.faces)} triangles, {len(cameras)} cameras"
        )
        return {"FINISHED"}

    def _warn(self, sentence: str) -> None:
        self.report({"WARNING"}, sentence)


def _preferred_model(context: Any) -> str:
    # The preferences know an extension by its root package; it has none while it runs from a checkout.
    addon = context.preferences.addons.get(__package__.rpartition(".")[0])
    return addon.preferences.flame_model if addon else ""
