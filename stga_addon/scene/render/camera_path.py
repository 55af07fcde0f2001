"""Frames and cameras of a video of the scene: its animation, or a turntable."""

from typing import Any

import numpy as np

from ...capture.camera import Camera, camera_from_gl, covered_angles, turntable
from .. import tags
from ..arrays import evaluated_vertices, mesh_vertices
from .camera import image_size, render_camera

UP = (0.0, 0.0, 1.0)
"""Blender's scenes are z-up."""


def scene_camera(depsgraph: Any) -> Camera:
    """The scene's camera at the depsgraph's frame, for a whole image. Raises StgaError unless it is perspective."""
    scene = depsgraph.scene
    width, height = image_size(scene.render)
    camera = scene.camera.evaluated_get(depsgraph) if scene.camera else None
    return render_camera(camera, depsgraph, width, height, (0, 0, width, height))


def turntable_cameras(subject: Any, depsgraph: Any, count: int, angle: float) -> list[Camera]:
    """`count` cameras that start as the scene's and orbit the object `subject`, a head or splats.

    angle: radians; 0: the sides that the cameras of the head's capture saw, a full turn where there are none.
    """
    start, matrix = scene_camera(depsgraph), np.array(subject.matrix_world, np.float64)
    if subject.get(tags.KIND) == tags.SPLATS:  # in world space, some of them far away
        middle = np.median(mesh_vertices(subject.data), axis=0)
    else:
        vertices = evaluated_vertices(subject)
        middle = (vertices.min(0) + vertices.max(0)) / 2
    center = matrix[:3, :3] @ middle + matrix[:3, 3]
    angles = (-angle / 2, angle / 2) if angle else (-np.pi, np.pi)
    cameras = _capture_cameras(subject)
    if not angle and cameras:
        angles = covered_angles(cameras, start, center, UP)
    return turntable(start, center, count, angles, UP)


def _capture_cameras(subject: Any) -> list[Camera]:
    """The cameras of the capture that `subject` belongs to, for their positions."""
    root = subject.parent
    children = () if root is None else root.children_recursive
    found = [child for child in children if child.get(tags.KIND) == tags.CAMERA]
    return [camera_from_gl(np.array(camera.matrix_world, np.float64), 1, 1, 1, 1, 0, 0) for camera in found]
