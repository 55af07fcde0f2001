"""Selects the moving triangles of each frame as vertex groups, and counts and colors them."""

from dataclasses import replace
from typing import Any, ClassVar

import bpy
import numpy as np

from ..stga_addon.capture.model import Capture
from ..stga_addon.errors import StgaError
from ..stga_addon.scene import tags
from ..stga_addon.scene.vertex_groups import (
    RESIDUAL,
    has_heat_map,
    hide_heat_map,
    read_regions,
    read_selection,
    show_heat_map,
    shows_residuals,
    splats_per_face,
    write_selection,
)
from ..stga_addon.selection import KEY_REGIONS, SelectionOptions, select_capture
from ..stga_addon.training.run.folder import read_residuals
from ..stga_addon.training.settings import TrainingSettings
from . import ids
from .common import (
    capture_of,
    file_path,
    head_of,
    needs_head,
    needs_own_head,
    path_property,
    reporting,
    scene_settings,
)
from .options import option_property

LARGEST_RESIDUAL_QUANTILE = 0.98
"""Triangles with residuals from here up are shown alike, so that a few at the border do not make
all others blue."""


class Select(bpy.types.Operator):
    """Select the triangles that move from the neutral face in each frame, as one vertex group for
    each frame"""

    bl_idname = ids.SELECT
    bl_label = "Select Moving Triangles"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    threshold: option_property(
        SelectionOptions, "threshold", soft_max=0.05, step=0.1, precision=4, unit="LENGTH"
    )
    zero_pose: option_property(
        SelectionOptions, "zero_pose", "Ignore", labels={"head": "Head Motion", "all": "Whole Pose"}
    )
    regions: bpy.props.StringProperty(
        name="Key Regions",
        description="Regions or vertex groups that are selected as a whole, separated by commas; "
        "empty: those chosen in the panel",
        options={"SKIP_SAVE"},
    )

    poll = classmethod(needs_own_head)

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = head_of(context)
        names = [name.strip() for name in self.regions.split(",") if name.strip()] or key_regions(
            head
        )
        capture = _with_painted(capture_of(head), head, names)
        selection = select_capture(
            capture, SelectionOptions(self.threshold, self.zero_pose, tuple(names))
        )
        write_selection(head, selection)
        head[tags.KEY_REGIONS] = "\n".join(names)
        count_selected(context.scene, head)
        if has_heat_map(head) and not shows_residuals(head):
            show_heat_map(head, _shares(head))
        moving = [faces.mean() for faces in selection.values() if faces.any()]
        share = 100 * sum(moving) / len(moving) if moving else 0.0
        self.report(
            {"INFO"},
            f"{len(moving)} of {len(selection)} frames select triangles, {share:.0f} % of the head "
            "on average",
        )
        return {"FINISHED"}


class ToggleRegion(bpy.types.Operator):
    """Select this region as a whole, or triangle by triangle, when triangles are selected next"""

    bl_idname = ids.TOGGLE_REGION
    bl_label = "Key Region"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO", "INTERNAL"}

    name: bpy.props.StringProperty(
        name="Name", description="A region of the capture, or a vertex group of the head"
    )

    poll = classmethod(needs_own_head)

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = head_of(context)
        if self.name not in possible_regions(head):
            raise StgaError(f"{head.name}: has no region and no vertex group '{self.name}'")
        names = key_regions(head)
        names = (
            [name for name in names if name != self.name]
            if self.name in names
            else [*names, self.name]
        )
        head[tags.KEY_REGIONS] = "\n".join(names)
        return {"FINISHED"}


class CountSelected(bpy.types.Operator):
    """Update the number of triangles and splats that each frame trains, after painting vertex
    groups"""

    bl_idname = ids.COUNT_SELECTED
    bl_label = "Update Counts"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    poll = classmethod(needs_head)

    @reporting
    def execute(self, context: Any) -> set[str]:
        count_selected(context.scene, head_of(context))
        return {"FINISHED"}


class HeatMap(bpy.types.Operator):
    """Color the head's triangles, in the viewport and in renders: by how often each is selected, or
    by the error of the trained avatar there"""

    bl_idname = ids.HEAT_MAP
    bl_label = "Heat Map"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    show: bpy.props.BoolProperty(
        name="Show", description="Off: restore the head's own colors", default=True,
        options={"SKIP_SAVE"},
    )  # fmt: skip
    of: bpy.props.EnumProperty(
        name="Of", description="What the colors show",
        items=(
            ("SELECTION", "Selection", "How often each triangle is selected"),
            (
                "RESIDUAL",
                "Residual",
                "Mean error of the run's avatar on each triangle over all views: where to refine",
            ),
        ),
        options={"SKIP_SAVE"},
    )  # fmt: skip
    directory: path_property(
        "Run Folder", "Folder of the run whose residuals are shown", "DIR_PATH",
        options={"SKIP_SAVE"},
    )  # fmt: skip

    poll = classmethod(needs_own_head)

    @reporting
    def execute(self, context: Any) -> set[str]:
        head, splats = head_of(context), scene_settings(context).splats
        if not self.show:
            hide_heat_map(head)
        elif self.of == "RESIDUAL":
            self._show_residuals(head)
        else:
            self._show_shares(head)
        in_view = context.view_layer.objects
        if (
            splats is not None
            and in_view.get(splats.name) is splats
            and in_view.get(head.name) is head
        ):
            # Only one of the two: each covers the other.
            splats.hide_set(self.show)
            head.hide_set(not self.show)
        _color_viewports(context, "VERTEX" if self.show else "MATERIAL")
        return {"FINISHED"}

    def _show_shares(self, head: Any) -> None:
        share = _shares(head)
        if not share.any():
            raise StgaError(
                f"{head.name}: no frame selects a triangle yet; select moving triangles first"
            )
        show_heat_map(head, share)
        self.report(
            {"INFO"}, f"The most selected triangle is selected in {share.max():.0%} of the frames"
        )

    def _show_residuals(self, head: Any) -> None:
        folder = file_path(self.directory, "run folder")
        residual = np.nan_to_num(read_residuals(folder, len(head.data.polygons)))
        largest = (
            float(np.quantile(residual[residual > 0], LARGEST_RESIDUAL_QUANTILE))
            if residual.any()
            else 1.0
        )
        show_heat_map(head, residual, RESIDUAL, largest)
        self.report(
            {"INFO"}, f"Red: a mean error of {100 * largest:.1f} % of full brightness or more"
        )


def possible_regions(head: Any) -> list[str]:
    """What can be selected as a whole: regions of the capture, and vertex groups of neither
    selection nor rig."""
    names = [name for name in head.data.attributes.keys() if name.startswith(tags.REGION_PREFIX)]  # noqa: SIM118
    rigs = [
        modifier.object
        for modifier in head.modifiers
        if modifier.type == "ARMATURE" and modifier.object
    ]
    bones = {bone.name for rig in rigs for bone in rig.data.bones}
    groups = [group.name for group in head.vertex_groups if tags.group_timestep(group.name) is None]
    painted = [name for name in groups if name not in bones]
    return list(
        dict.fromkeys([*(name.removeprefix(tags.REGION_PREFIX) for name in names), *painted])
    )


def key_regions(head: Any) -> list[str]:
    """Regions chosen to be selected as a whole; at first eyes, mouth and nose."""
    possible = possible_regions(head)
    ticked = head[tags.KEY_REGIONS].split("\n") if tags.KEY_REGIONS in head else KEY_REGIONS
    return [name for name in ticked if name in possible]


def _with_painted(capture: Capture, head: Any, names: list[str]) -> Capture:
    """The capture with the named vertex groups as regions; a painted group replaces a region of the
    same name."""
    painted = read_regions(head, [name for name in names if name in head.vertex_groups])
    for name in names:
        if name not in painted and name not in capture.regions:
            raise StgaError(f"{head.name}: has no region and no vertex group '{name}'")
        if name in painted and not painted[name].any():
            raise StgaError(
                f"{head.name}: no triangle has all its corners in the vertex group '{name}'"
            )
    return replace(capture, regions={**capture.regions, **painted})


def count_selected(scene: Any, head: Any) -> None:
    """Fill the panel's table of selected triangles."""
    settings = getattr(scene, ids.SETTINGS)
    per_face = splats_per_face(settings.splats, head)
    order = TrainingSettings().lattice_order(len(head.data.polygons))
    every = (order + 1) * (order + 2) // 2  # at the start of a training
    settings.selected_frames.clear()
    for timestep, selected in read_selection(head).items():
        row = settings.selected_frames.add()
        row.frame, row.triangles = timestep, int(selected.sum())
        row.splats = (
            int(selected.sum()) * every if per_face is None else int(per_face[selected].sum())
        )


def _shares(head: Any) -> np.ndarray:
    """(F,) share of the frames that select each triangle."""
    return np.mean(list(read_selection(head).values()), axis=0)


def _color_viewports(context: Any, kind: str) -> None:
    """Set the color type of solid mode in every viewport of the screen; without a window there is
    none."""
    for area in context.screen.areas if context.screen else ():
        if area.type == "VIEW_3D":
            area.spaces.active.shading.color_type = kind
