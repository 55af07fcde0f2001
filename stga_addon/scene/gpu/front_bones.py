"""Where bones *In Front* are in a viewport: there, splats are drawn below Blender's overlays."""

from collections.abc import Iterator
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

NO_BONES = np.zeros((0, 2, 4), np.float32)
MAX_SHAPES = 256
"""Bones looked for in each pixel; those of a larger rig are covered by splats."""
WIDTH_SHARE, MARGIN_PX = 0.15, 6.0
"""Half the width of a bone as a share of its length, and what is added for outlines."""


def front_bones(space: Any, region: Any, width: int, height: int) -> np.ndarray:
    """(M, 2, 4) float32: for each bone two ends in pixels (x0, y0, x1, y1), and a radius beside three zeros.

    space, region: the SpaceView3D and RegionView3D, drawn with width × height pixels, from the bottom left.
    """
    overlay = space.overlay
    if not (overlay.show_overlays and overlay.show_bones):
        return NO_BONES
    rigs = [
        rig
        for rig in bpy.context.view_layer.objects
        if rig.type == "ARMATURE" and rig.show_in_front and rig.visible_get(viewport=space)
    ]
    spheres = [ends for rig in rigs for ends in _bone_ends(rig)][:MAX_SHAPES]
    if not spheres:
        return NO_BONES
    ends = np.array([[(*point, 1.0) for point in pair[:2]] for pair in spheres])
    radius = np.array([pair[2] for pair in spheres])
    clip = ends @ np.array(region.perspective_matrix, np.float64).T
    before = (clip[..., 3] > 0).all(1)  # the camera; a bone with an end behind it is left out
    clip, radius = clip[before], radius[before]
    half = np.array([width, height]) / 2
    shapes = np.zeros((len(clip), 2, 4), np.float32)
    shapes[:, 0] = ((clip[..., :2] / clip[..., 3:] + 1) * half).reshape(-1, 4)
    scale = np.abs(np.array(region.window_matrix[1][1])) * half[1] / clip[..., 3].min(1)
    shapes[:, 1, 0] = radius * scale + MARGIN_PX
    return shapes


def _bone_ends(rig: Any) -> Iterator[tuple[Any, Any, float]]:
    """Head, tail and half the width, in the world, of each visible bone; of one with a shape, a sphere around that."""
    matrix = rig.matrix_world
    size = matrix.median_scale
    for bone in rig.pose.bones:
        if bone.bone.hide or getattr(bone, "hide", False):
            continue
        shape = bone.custom_shape if rig.data.show_bone_custom_shapes else None
        if shape is None:
            yield matrix @ bone.head, matrix @ bone.tail, size * bone.length * WIDTH_SHARE
            continue
        owner = bone.custom_shape_transform or bone
        center = matrix @ owner.matrix @ bone.custom_shape_translation
        reach = max(Vector(corner).length for corner in shape.bound_box) * max(map(abs, bone.custom_shape_scale_xyz))
        yield center, center, size * reach * (bone.length if bone.use_custom_shape_bone_size else 1.0)
