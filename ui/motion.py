"""The Motion step: applying the motion of others, and sliders of the face."""

from typing import Any, ClassVar

import bpy

from ..operators import ids
from ..operators.arkit_controls import needs_sliders, preparing
from ..operators.common import is_head, rig_or_none, scene_settings
from ..stga_addon.driving.performance import ARKIT_SHAPES
from ..stga_addon.scene.rig.keyframes import EXPRESSION_KEY, IDENTITY_KEY
from ..stga_addon.scene.rig.motion import outside_now, stored_range
from .sidebar import SidebarPanel

MAX_SLIDERS = 10  # the first components vary most


class MotionPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_motion"
    bl_label = "5 Motion"

    def draw(self, context: Any) -> None:
        layout, settings = self.layout, scene_settings(context)
        layout.operator(ids.APPLY_MOTION, text="Apply Motion…", icon="IMPORT")
        row = layout.row(align=True)
        row.prop(settings, "motion_source")
        if settings.motion_source is not None:
            row.operator(
                ids.APPLY_MOTION, text="", icon="CHECKMARK"
            ).source = settings.motion_source.name


class FacePanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_face"
    bl_label = "Face"
    bl_parent_id = MotionPanel.bl_idname

    @classmethod
    def poll(cls, context: Any) -> bool:
        return rig_or_none(scene_settings(context).head) is not None

    def draw(self, context: Any) -> None:
        head = scene_settings(context).head
        if head.name in preparing:
            self.layout.label(text="Sliders follow in a moment", icon="TIME")
            return
        if needs_sliders(head):
            self.layout.operator(ids.ADD_ARKIT_CONTROLS, icon="ADD")
            return
        column, keys = self.layout.column(align=True), head.data.shape_keys.key_blocks
        for name in [name for name in ARKIT_SHAPES if name in keys]:
            column.prop(keys[name], "value", text=name, slider=True)


class TrainedPanel(SidebarPanel, bpy.types.Panel):
    """Meters of how far outside the trained range the head is posed in this frame."""

    bl_idname = "STGA_PT_trained"
    bl_label = "Trained Range"
    bl_parent_id = MotionPanel.bl_idname
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    def draw(self, context: Any) -> None:
        head = scene_settings(context).head
        rig = rig_or_none(head)
        trained = stored_range(head) if rig is not None else None
        if trained is None:
            self.layout.operator(ids.MEASURE_RANGE, icon="DRIVER_DISTANCE")
            return
        for part, beyond in outside_now(head, rig, trained).items():
            text = (
                f"{part.capitalize()}: {beyond:.1f} half widths outside"
                if beyond
                else f"{part.capitalize()}: inside"
            )
            self.layout.progress(factor=min(beyond, 1.0), text=text)


class CoefficientsPanel(SidebarPanel, bpy.types.Panel):
    """Sliders of a FLAME head without names: of expression, and of other persons."""

    bl_idname = "STGA_PT_coefficients"
    bl_label = "Coefficients"
    bl_parent_id = MotionPanel.bl_idname
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        return bool(_coefficients(context))

    def draw(self, context: Any) -> None:
        for keys in _coefficients(context):
            column = self.layout.column(align=True)
            for key in keys[:MAX_SLIDERS]:
                column.prop(key, "value", text=key.name, slider=True)


def _coefficients(context: Any) -> list[list[Any]]:
    head = scene_settings(context).head
    if not is_head(head) or head.data.shape_keys is None:
        return []
    keys = head.data.shape_keys.key_blocks
    found = [
        [key for key in keys if key.name.startswith(prefix)]
        for prefix in (EXPRESSION_KEY, IDENTITY_KEY)
    ]
    return [part for part in found if part]
