"""Continues a trained avatar: refines a region of it, or extends it by a further take of the same
head."""

from typing import Any, ClassVar

import bpy
import numpy as np

from ..stga_addon.capture.meshes import SELECTED_WEIGHT
from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.train import Extend as ExtendRequest
from ..stga_addon.jobs.train import Refine as RefineRequest
from ..stga_addon.scene import tags
from ..stga_addon.scene.vertex_groups import read_triangle_weights, selected_triangles
from ..stga_addon.training.run.folder import AVATAR, next_folder
from . import ids
from .common import capture_source, file_path, head_of, path_property, reporting, scene_settings
from .options import option_property
from .train import DeviceOptions, TrainingOperator, device_of, start_training


class RefineOptions:
    """What is refined, and for how long: of the operator, and of the panel that calls it."""

    group: bpy.props.StringProperty(
        name="Vertex Group",
        description="Vertex group whose triangles are refined; empty: the active one. In Edit "
        "Mode, the selected triangles are refined instead",
    )
    seconds: option_property(
        RefineRequest, "seconds", description="Training time", default=20.0, min=0.1
    )
    growth: option_property(RefineRequest, "growth", "More Splats", soft_max=2.0, subtype="FACTOR")


class ExtendOptions:
    """What a run is extended by, and for how long: of the operator, and of the panel that calls
    it."""

    take: path_property("Take", "Folder of a further capture of the same head", "DIR_PATH")
    seconds: option_property(
        ExtendRequest, "seconds", description="Training time", default=60.0, min=0.1
    )


class Refine(TrainingOperator, RefineOptions, DeviceOptions, bpy.types.Operator):
    """Train one region of the avatar further; all other splats stay as they are. In Edit Mode the
    region is the selected triangles, otherwise a vertex group"""

    bl_idname = ids.REFINE
    bl_label = "Refine"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    directory: path_property("Run Folder", "Folder of the run to refine", "DIR_PATH")
    region: bpy.props.StringProperty(
        name="Region",
        description="Region of the capture, such as mouth, to refine instead of a vertex group",
        options={"SKIP_SAVE"},
    )
    first: bpy.props.IntProperty(
        name="First Frame", description="First frame to train on", default=-1, min=-1,
        options={"SKIP_SAVE"},
    )  # fmt: skip
    last: bpy.props.IntProperty(
        name="Last Frame", description="Last frame to train on; -1: all frames", default=-1, min=-1,
        options={"SKIP_SAVE"},
    )  # fmt: skip

    @reporting
    def execute(self, context: Any) -> set[str]:
        head, parent = head_of(context), file_path(self.directory, "run folder").resolve()
        run = next_folder(parent)
        weights = None if self.region else _painted_region(head, self.group)
        frames = None if self.last < 0 else (max(self.first, 0), self.last)
        request = RefineRequest(
            run, parent, self.region, weights, frames, growth=self.growth, **_common(self, head)
        )
        return _start(self, context, request)


class Extend(TrainingOperator, ExtendOptions, DeviceOptions, bpy.types.Operator):
    """Train a further take of the same head into the avatar, which keeps what it has learned"""

    bl_idname = ids.EXTEND
    bl_label = "Extend with Take"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    directory: path_property("Run Folder", "Folder of the run to extend", "DIR_PATH")

    @reporting
    def execute(self, context: Any) -> set[str]:
        parent = file_path(self.directory, "run folder").resolve()
        take = file_path(self.take, "take").resolve()
        if not take.is_dir():
            raise StgaError(f"{take}: is not a folder; expected a further capture of the same head")
        request = ExtendRequest(
            next_folder(parent), parent, (take,), **_common(self, head_of(context))
        )
        return _start(self, context, request)


def _common(operator: Any, head: Any) -> dict[str, Any]:
    """What both requests have: budget, FLAME model and device."""
    budget = (
        {"iterations": operator.iterations}
        if operator.iterations
        else {"seconds": operator.seconds}
    )
    _, flame, _ = capture_source(head)
    return {**budget, "flame": flame, "device": device_of(operator)}


def _painted_region(head: Any, group: str) -> np.ndarray:
    """(F,) weights of the triangles selected in Edit Mode, or of a vertex group. Raises StgaError
    for none."""
    if head.mode == "EDIT":
        weights = selected_triangles(head).astype(np.float32)
        where = "no triangle is selected in Edit Mode"
    else:
        found = head.vertex_groups.get(group) if group else head.vertex_groups.active
        if found is None:
            raise StgaError(
                f"{head.name}: has no vertex group '{group}' to refine; paint one, or select in "
                "Edit Mode"
            )
        weights = read_triangle_weights(head, found.name)
        where = f"no triangle has all its corners in the vertex group '{found.name}'"
    if not (weights >= SELECTED_WEIGHT).any():
        raise StgaError(f"{head.name}: {where}")
    return weights


def _start(operator: Any, context: Any, request: RefineRequest | ExtendRequest) -> set[str]:
    """Start the worker; the splats that show the run before show the new one, so that its preview
    changes them."""
    settings = scene_settings(context)
    if not (request.parent / AVATAR).is_file():
        raise StgaError(f"{request.parent}: holds no trained avatar; train one first")
    result = start_training(operator, context, request)
    shown = [thing for thing in context.scene.objects if thing.get(tags.RUN) == str(request.parent)]
    if not shown and settings.splats is not None:
        shown = [settings.splats]
    for thing in shown:
        thing[tags.RUN] = str(request.run)
    settings.run_folder = str(request.run)
    return result
