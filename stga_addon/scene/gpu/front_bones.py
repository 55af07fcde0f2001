"""Bones that a viewport draws in front of everything, as shapes that splats leave free."""

from typing import Any

import bpy
import numpy as np
from mathutils import Vector

NO_BONES = np.zeros((0, 2, 4), np.float32)
"""What `front_bones` returns where no bone is in front."""
MAX_SHAPES = 256
"""Bones looked for in each pixel; splats cover those of a larger rig."""
WIDTH_FRACTION = 0.15
"""Half the width of a bone as a fraction of its length."""
MARGIN_PX = 6.0
"""Margin around a bone's half width for outlines."""


def front_bones(space: Any, region: Any, width: int, height: int) -> np.ndarray:
    """(M, 2, 4) float32: two ends of each bone in pixels (x0, y0, x1, y1), from the bottom left,
    and a radius beside three zeros. space, region: the SpaceView3D and its RegionView3D."""
    overlay = space.overlay
    if not (overlay.show_overlays and overlay.show_bones):
        return NO_BONES
    armatures = [each for each in bpy.context.view_layer.objects if each.type == "ARMATURE"]
    rigs = [each for each in armatures if each.show_in_front and each.visible_get(viewport=space)]
    found = list[tuple[Any, Any, float]]()  # head and tail in the world, half the width
    for rig, bone in ((each, bone) for each in rigs for bone in each.pose.bones):
        if bone.bone.hide or getattr(bone, "hide", False):
            continue
        matrix = rig.matrix_world
        size = rig.matrix_world.median_scale
        shape = bone.custom_shape if rig.data.show_bone_custom_shapes else None
        if shape is None:
            radius = size * bone.length * WIDTH_FRACTION
            found.append((matrix @ bone.head, matrix @ bone.tail, radius))
            continue
        owner = bone.custom_shape_transform or bone  # a sphere around the shape
        center = matrix @ owner.matrix @ bone.custom_shape_translation
        reach = size * max(Vector(corner).length for corner in shape.bound_box)
        reach *= max(map(abs, bone.custom_shape_scale_xyz))
        reach *= bone.length if bone.use_custom_shape_bone_size else 1.0
        found.append((center, center, reach))
    if not found:
        return NO_BONES
    ends = np.array([[(*point, 1.0) for point in bone[:2]] for bone in found[:MAX_SHAPES]])
    radius = np.array([bone[2] for bone in found[:MAX_SHAPES]])
    clip = ends @ np.array(region.perspective_matrix, np.float64).T
    before = (clip[..., 3] > 0).all(1)  # the camera; a bone with an end behind it is left out
    clip = clip[before]
    radius = radius[before]
    half = np.array([width, height]) / 2
    shapes = np.zeros((len(clip), 2, 4), np.float32)
    shapes[:, 0] = ((clip[..., :2] / clip[..., 3:] + 1) * half).reshape(-1, 4)
    scale = np.abs(np.array(region.window_matrix[1][1])) * half[1] / clip[..., 3].min(1)
    shapes[:, 1, 0] = radius * scale + MARGIN_PX
    return shapes
