"""A click on an avatar: selects what G then moves, of which Blender itself draws nothing there."""

from functools import partial
from typing import Any

import bpy
import numpy as np
from bpy_extras.view3d_utils import region_2d_to_origin_3d, region_2d_to_vector_3d

from ..stga_addon.scene import tags
from ..stga_addon.scene.arrays import evaluated_vertices
from ..stga_addon.scene.display.splat_attributes import XYZ, read_attribute
from ..stga_addon.scene.display.splat_object import followed_head
from ..stga_addon.scene.objects import Identity, mover_of
from ..stga_addon.scene.tags import is_head
from . import options
from .windows import push_undo

NEAR_PX = 12.0
"""Largest distance from the vertices of a head, or the splats of a file, that is a hit."""
PARTS = (tags.HEAD, tags.SPLATS)


class PickAvatar(bpy.types.Operator):
    """Select the avatar that is clicked on, so that G, R and S move it"""

    bl_idname = "stga.pick_avatar"
    bl_label = "Select Avatar"
    bl_options = frozenset({"INTERNAL"})

    extend: options.boolean("Extend", "Keep what is selected")

    @classmethod
    def poll(cls, context: Any) -> bool:
        return context.mode == "OBJECT" and context.region_data is not None

    def invoke(self, context: Any, event: Any) -> set[str]:
        at = np.array((event.mouse_region_x, event.mouse_region_y))
        mover = avatar_at(context, at)
        if mover is not None:  # after Blender's own selection of this click
            later = partial(_select, Identity(mover), self.extend)
            bpy.app.timers.register(later, first_interval=0.0)
        return {"PASS_THROUGH"}


def avatar_at(context: Any, at: np.ndarray) -> Any:
    """What moves the nearest avatar that is shown at a point of the region, pixels; None where
    there is none, or a mesh in front of it."""
    layer = context.view_layer
    visible = [
        each for each in layer.objects if each.get(tags.KIND) in PARTS and each.visible_get()
    ]
    origin = region_2d_to_origin_3d(context.region, context.region_data, at)
    ray = region_2d_to_vector_3d(context.region, context.region_data, at)
    found: list[tuple[float, Any]] = []
    for part in visible:
        distance = _distance(context, part, at, origin)
        if distance is not None:
            found.append((distance, mover_of(part)))
    if not found:
        return None
    depsgraph = context.evaluated_depsgraph_get()
    is_hit, place, _, _, front, _ = context.scene.ray_cast(depsgraph, origin, ray)
    nearest, mover = min(found, key=lambda each: each[0])
    is_other = is_hit and front.get(tags.KIND) not in PARTS
    return None if is_other and (place - origin).length < nearest else mover


def _distance(context: Any, part: Any, at: np.ndarray, origin: Any) -> float | None:
    """From the eye to a head or splats at a point of the region; None where they are not there."""
    shape = part
    if tags.CONVENTION in part:
        shape = followed_head(part)
        if shape is None:
            return None
    is_world = tags.is_splats(shape)
    vertices = read_attribute(shape.data, XYZ) if is_world else evaluated_vertices(shape)
    world = np.array(shape.matrix_world)
    points = vertices @ world[:3, :3].T + world[:3, 3]
    window = np.array(context.region_data.perspective_matrix)
    clip = points @ window[:, :3].T + window[:, 3]
    size = np.array((context.region.width, context.region.height))
    with np.errstate(divide="ignore", invalid="ignore"):
        on_screen = (clip[:, :2] / clip[:, 3:] + 1) / 2 * size
    near = (np.abs(on_screen - at).max(axis=1) < NEAR_PX) & (clip[:, 3] > 0)
    if not near.any():
        return None
    return float(np.linalg.norm(points[near] - np.array(origin), axis=1).min())


def _select(identity: Any, extend: bool) -> None:
    mover = identity.find()
    layer = bpy.context.view_layer
    if mover is None or layer.objects.get(mover.name) is not mover or mover.select_get():
        return
    others = [each for each in layer.objects.selected if each.get(tags.KIND) not in PARTS]
    if others and not extend:  # what Blender has found there: a bone, a camera, …
        return
    for part in layer.objects.selected:
        if tags.is_splats(part):
            part.select_set(False)
    mover.select_set(True)
    if not (is_head(layer.objects.active) and layer.objects.active.select_get()):
        layer.objects.active = mover  # a head that was clicked on can be edited
    push_undo("Select")
