"""Selects, frame by frame, the triangles that extending a run by this take would train, before anything is trained."""

from typing import Any, ClassVar

import bpy
import numpy as np

from ..stga_addon.errors import StgaError
from ..stga_addon.requests.results import Selected
from ..stga_addon.requests.values import SelectForTake
from ..stga_addon.scene import tags
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.scene.vertex_groups import write_selection
from . import background, ids, monitor
from .background import BackgroundRequest
from .common import capture_source, file_path, head_of, is_head, needs_own_head, reporting
from .select import count_selected


class SelectExtension(bpy.types.Operator):
    """Select the triangles that extending the run by this head's take would train in each frame: those that move, and
    those that look different than in the run's images"""

    bl_idname = ids.SELECT_EXTENSION
    bl_label = "Select What Extend Trains"
    bl_options: ClassVar[set[str]] = {"REGISTER"}  # the selection, which comes later, is the step to undo

    directory: bpy.props.StringProperty(
        name="Run Folder", description="Folder of the run to extend", subtype="DIR_PATH", options=PATH_OPTIONS
    )

    @classmethod
    def poll(cls, context: Any) -> bool:
        return background.needs_idle(cls, context) and needs_own_head(cls, context)

    @reporting
    def execute(self, context: Any) -> set[str]:
        head, run = head_of(context), file_path(self.directory, "run folder")
        take, flame, _ = capture_source(head)

        def show(scene: Any, found: Selected) -> None:
            _show(scene, str(take), dict(found.selection))

        request = SelectForTake(run, take, flame)
        background.start(context, BackgroundRequest(request, show, "extension_error", changes_head=True))
        return {"FINISHED"}


def _show(scene: Any, take: str, selection: dict[int, np.ndarray]) -> None:
    head = getattr(scene, ids.SETTINGS).head
    if not is_head(head) or head[tags.CAPTURE] != take:
        raise StgaError(f"{take}: its head is no longer that of the scene")
    write_selection(head, selection)
    count_selected(scene, head)
    if monitor.has_timer() and bpy.ops.ed.undo_push.poll():
        bpy.ops.ed.undo_push(message=SelectExtension.bl_label)
