"""Tracked head → one vertex group a frame."""

from typing import Any, ClassVar

import bpy

from ..stga_addon.scene.groups import write_selection
from ..stga_addon.selection import SelectionOptions, select_capture
from . import ids
from .common import capture_of, head_of, needs_head, reporting


class Select(bpy.types.Operator):
    """Select, for every frame, the triangles that really moved; write them as one vertex group a frame"""

    bl_idname = ids.SELECT
    bl_label = "Select Moving Triangles"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    threshold: bpy.props.FloatProperty(
        name="Threshold",
        description="How far a triangle moves from the neutral face before it is trained in a frame of its own",
        default=SelectionOptions.threshold,
        min=0.0,
        soft_max=0.05,
        step=0.1,
        precision=4,
        unit="LENGTH",
    )
    zero_pose: bpy.props.EnumProperty(
        name="Ignore",
        description="Which pose is no expression",
        items=(
            ("head", "Head Motion", "Head rotation, translation and neck; jaw and eyes are expression"),
            ("all", "Whole Pose", "Head motion, jaw and eyes"),
        ),
    )

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_head(cls, context)

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = head_of(context)
        chosen = select_capture(capture_of(head), SelectionOptions(self.threshold, self.zero_pose))
        write_selection(head, chosen)
        moving = [faces.mean() for faces in chosen.values() if faces.any()]
        share = 100 * sum(moving) / len(moving) if moving else 0.0
        self.report(
            {"INFO"}, f"{len(moving)} of {len(chosen)} frames select triangles, {share:.0f} % of the head on average"
        )
        return {"FINISHED"}
