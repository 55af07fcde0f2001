"""The Motion step: applying the motion of others, and sliders for expression and identity."""

from collections.abc import Callable
from typing import Any, ClassVar

import bpy

from ..operators import ids
from ..operators.common import is_head, rig_or_none, scene_settings
from ..stga_addon.driving.performance import ARKIT_SHAPES
from ..stga_addon.scene.rig.arkit import has_controls
from ..stga_addon.scene.rig.keyframes import IDENTITY_KEY, is_expression_key, property_path
from ..stga_addon.scene.rig.motion import outside_now, stored_range
from .sidebar import SidebarPanel

MAX_SLIDERS = 10  # the first components vary most


class MotionPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_motion"
    bl_label = "5 Motion"

    def draw(self, context: Any) -> None:
        layout, settings = self.layout, scene_settings(context)
        layout.operator(ids.APPLY_MOTION, text="Apply Motion from File", icon="IMPORT")
        row = layout.row(align=True)
        row.prop(settings, "motion_source")
        if settings.motion_source is not None:
            row.operator(
                ids.APPLY_MOTION, text="", icon="CHECKMARK"
            ).source = settings.motion_source.name


class ArkitPanel(SidebarPanel, bpy.types.Panel):
    bl_idname = "STGA_PT_arkit"
    bl_label = "ARKit Controls"
    bl_parent_id = MotionPanel.bl_idname
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}

    def draw(self, context: Any) -> None:
        head = scene_settings(context).head
        rig = rig_or_none(head)
        if rig is None or not has_controls(rig):
            self.layout.operator(ids.ADD_ARKIT_CONTROLS, icon="ADD")
            return
        column = self.layout.column(align=True)
        for name in ARKIT_SHAPES:
            column.prop(rig, property_path(name), text=name, slider=True)
        self.layout.operator(ids.REMOVE_ARKIT_CONTROLS, icon="X")


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


class _Sliders(SidebarPanel):
    bl_parent_id = MotionPanel.bl_idname
    bl_options: ClassVar[set[str]] = {"DEFAULT_CLOSED"}
    belongs: ClassVar[Any]

    @classmethod
    def poll(cls, context: Any) -> bool:
        return bool(_sliders(context, cls.belongs))

    def draw(self, context: Any) -> None:
        column = self.layout.column(align=True)
        for key in _sliders(context, self.belongs)[:MAX_SLIDERS]:
            column.prop(key, "value", text=key.name, slider=True)


class ExpressionPanel(_Sliders, bpy.types.Panel):
    bl_idname = "STGA_PT_expression"
    bl_label = "Expression"
    belongs = staticmethod(is_expression_key)


class IdentityPanel(_Sliders, bpy.types.Panel):
    bl_idname = "STGA_PT_identity"
    bl_label = "Identity"
    belongs = staticmethod(lambda name: name.startswith(IDENTITY_KEY))


def _sliders(context: Any, belongs: Callable[[str], bool]) -> list[Any]:
    head = scene_settings(context).head
    if not is_head(head) or head.data.shape_keys is None:
        return []
    return [key for key in head.data.shape_keys.key_blocks if belongs(key.name)]
