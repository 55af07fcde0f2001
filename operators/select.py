"""Selects the moving triangles of each frame as vertex groups, and counts and colors them."""

from dataclasses import replace
from typing import Any

import bpy
import numpy as np

from ..stga_addon.capture.open import open_capture
from ..stga_addon.capture.selection import KEY_REGIONS, SelectionOptions, select_capture
from ..stga_addon.errors import StgaError
from ..stga_addon.scene import tags
from ..stga_addon.scene import vertex_groups as groups
from ..stga_addon.scene.avatar_scene import viewports
from ..stga_addon.scene.objects import show_progress
from ..stga_addon.training.run.folder import read_residuals
from ..stga_addon.training.settings import TrainingSettings
from . import options
from .common import Edit, capture_source, file_path, head_of, needs_editable_head, needs_head
from .options import ONCE

LARGEST_RESIDUAL_QUANTILE = 0.98
"""Triangles with residuals from here up are shown alike, so that a few at the border do not make
all others blue."""


class Select(Edit, bpy.types.Operator):
    """Select the triangles that move from the neutral face in each frame, as one vertex group for
    each frame"""

    bl_label = "Select Moving Triangles"
    needs = (needs_editable_head,)

    threshold: options.field(
        SelectionOptions, "threshold", soft_max=0.05, step=0.1, precision=4, unit="LENGTH"
    )
    zero_pose: options.field(
        SelectionOptions, "zero_pose", "Ignore", labels={"head": "Head Motion", "all": "Whole Pose"}
    )
    regions: options.text(
        "Key Regions",
        "Regions or vertex groups that are selected as a whole, separated by commas; empty: those "
        "chosen in the panel",
        options=ONCE,
    )

    def run(self, context: Any) -> None:
        head = head_of(context)
        given = [name.strip() for name in self.regions.split(",") if name.strip()]
        names = given or key_regions(head)
        capture = open_capture(*capture_source(head))
        # a painted group replaces a region of the same name
        painted = groups.read_regions(head, [name for name in names if name in head.vertex_groups])
        for name in names:
            if name not in painted and name not in capture.regions:
                raise StgaError(f"{head.name}: has no region and no vertex group '{name}'")
            if name in painted and not painted[name].any():
                problem = f"no triangle has all its corners in the vertex group '{name}'"
                raise StgaError(f"{head.name}: {problem}")
        capture = replace(capture, regions={**capture.regions, **painted})
        show_progress(0.3)
        rule = SelectionOptions(self.threshold, self.zero_pose, tuple(names))
        selection = select_capture(capture, rule)
        show_progress(0.6)
        groups.write_selection(head, selection)
        head[tags.KEY_REGIONS] = "\n".join(names)
        count_selected(context.scene, head)
        if groups.has_heat_map(head) and not groups.shows_residuals(head):
            groups.show_heat_map(head, _fractions(head))
        moving = [faces.mean() for faces in selection.values() if faces.any()]
        fraction = 100 * sum(moving) / len(moving) if moving else 0.0
        counted = f"{len(moving)} of {len(selection)} frames select triangles"
        self.inform(f"{counted}, {fraction:.0f} % of the head on average")


class ToggleRegion(Edit, bpy.types.Operator):
    """Select this region as a whole, or triangle by triangle, when triangles are selected next"""

    bl_label = "Key Region"
    bl_options = Edit.bl_options | {"INTERNAL"}
    needs = (needs_editable_head,)

    name: options.text("Name", "A region of the capture, or a vertex group of the head")

    def run(self, context: Any) -> None:
        head = head_of(context)
        if self.name not in possible_regions(head):
            raise StgaError(f"{head.name}: has no region and no vertex group '{self.name}'")
        names = key_regions(head)
        others = [name for name in names if name != self.name]
        head[tags.KEY_REGIONS] = "\n".join(others if self.name in names else [*names, self.name])


class CountSelected(Edit, bpy.types.Operator):
    """Update the number of triangles and splats that each frame trains, after painting vertex
    groups"""

    bl_label = "Update Counts"
    needs = (needs_head,)

    def run(self, context: Any) -> None:
        count_selected(context.scene, head_of(context))


class HeatMap(Edit, bpy.types.Operator):
    """Color the head's triangles, in the viewport and in renders: by how often each is selected, or
    by the error of the trained avatar there"""

    needs = (needs_editable_head,)

    show: options.boolean("Show", "Off: restore the head's own colors", default=True, options=ONCE)
    of: options.choice(
        "Of",
        "What the colors show",
        ("SELECTION", "Selection", "How often each triangle is selected"),
        (
            "RESIDUAL",
            "Residual",
            "Mean error of the run's avatar on each triangle over all views: where to refine",
        ),
        options=ONCE,
    )
    directory: options.path(
        "Run Folder", "Folder of the run whose residuals are shown", "DIR_PATH", options=ONCE
    )

    def run(self, context: Any) -> None:
        head = head_of(context)
        splats = context.scene.stga.splats
        if not self.show:
            groups.hide_heat_map(head)
        elif self.of == "RESIDUAL":
            folder = file_path(self.directory, "run folder")
            residual = np.nan_to_num(read_residuals(folder, len(head.data.polygons)))
            errors = residual[residual > 0]
            largest = float(np.quantile(errors, LARGEST_RESIDUAL_QUANTILE)) if errors.size else 1.0
            groups.show_heat_map(head, residual, groups.RESIDUAL, largest)
            self.inform(f"Red: a mean error of {100 * largest:.1f} % of full brightness or more")
        else:
            fraction = _fractions(head)
            if not fraction.any():
                problem = "no frame selects a triangle yet; select moving triangles first"
                raise StgaError(f"{head.name}: {problem}")
            groups.show_heat_map(head, fraction)
            often = f"{fraction.max():.0%} of the frames"
            self.inform(f"The most selected triangle is selected in {often}")
        in_view = context.view_layer.objects
        if splats is not None and all(in_view.get(each.name) is each for each in (splats, head)):
            # Only one of the two: each covers the other.
            splats.hide_set(self.show)
            head.hide_viewport = not self.show
            head.hide_set(False)
        for area in viewports([context.screen] if context.screen else ()):
            area.spaces.active.shading.color_type = "VERTEX" if self.show else "MATERIAL"


def possible_regions(head: Any) -> list[str]:
    """What can be selected as a whole: regions of the capture, and vertex groups of neither
    selection nor rig."""
    names = [name for name in head.data.attributes.keys() if name.startswith(tags.REGION_PREFIX)]  # noqa: SIM118
    rigs = [each.object for each in head.modifiers if each.type == "ARMATURE" and each.object]
    bones = {bone.name for rig in rigs for bone in rig.data.bones}
    found = [name.removeprefix(tags.REGION_PREFIX) for name in names]
    for group in head.vertex_groups:
        if tags.group_timestep(group.name) is None and group.name not in bones:
            found.append(group.name)
    return list(dict.fromkeys(found))


def key_regions(head: Any) -> list[str]:
    """Regions chosen to be selected as a whole; at first eyes, mouth and nose."""
    possible = possible_regions(head)
    ticked = head[tags.KEY_REGIONS].split("\n") if tags.KEY_REGIONS in head else KEY_REGIONS
    return [name for name in ticked if name in possible]


def count_selected(scene: Any, head: Any) -> None:
    """Fill the panel's table: how many triangles each frame selects, and how many splats they have,
    or will have at the start of a training."""
    settings = scene.stga
    per_face = groups.splats_per_face(settings.splats, head)
    order = TrainingSettings().lattice_order(len(head.data.polygons))
    initial_per_face = (order + 1) * (order + 2) // 2
    settings.selected_frames.clear()
    for timestep, selected in groups.read_selection(head).items():
        row = settings.selected_frames.add()
        row.frame = timestep
        row.triangles = int(selected.sum())
        if per_face is None:
            row.splats = row.triangles * initial_per_face
        else:
            row.splats = int(per_face[selected].sum())


def _fractions(head: Any) -> np.ndarray:
    """(F,) fraction of the frames that select each triangle."""
    return np.mean(list(groups.read_selection(head).values()), axis=0)
