"""Blender's cameras and views as calibrated cameras."""

from dataclasses import replace
from typing import Any

import numpy as np

from ...capture.camera import Camera, camera_from_gl
from ...errors import StgaError

ORTHOGRAPHIC_DISTANCE = 1000.0
"""An orthographic view is rendered in perspective from this many times its own width away."""


def image_size(render: Any) -> tuple[int, int]:
    """Width and height in pixels of final images by a scene's render settings."""
    share = render.resolution_percentage / 100
    return max(1, int(render.resolution_x * share)), max(1, int(render.resolution_y * share))


def render_camera(camera: Any, depsgraph: Any, width: int, height: int, border: tuple[int, int, int, int]) -> Camera:
    """The scene's camera for a final image of width × height pixels.

    camera: the evaluated camera object. border: x, y, width and height in pixels of the render region, from the bottom
    left. Raises StgaError unless it is a perspective camera.
    """
    if camera is None or camera.type != "CAMERA":
        raise StgaError("The scene has no camera to render through")
    if camera.data.type != "PERSP":
        raise StgaError(f"{camera.name}: is not a perspective camera; STGA Splats renders through no other type")
    render = depsgraph.scene.render
    projection = camera.calc_matrix_camera(
        depsgraph, x=width, y=height, scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y
    )
    whole = camera_of(np.array(camera.matrix_world.normalized(), np.float64), projection, width, height)
    return _cropped(whole, border)


def viewport_camera(region: Any, width: int, height: int) -> Camera:
    """The view of a 3D viewport (a RegionView3D) for an image of width × height pixels."""
    pose = np.array(region.view_matrix.inverted(), np.float64)
    projection = np.array(region.window_matrix, np.float64)
    if not region.is_perspective:
        projection, distance = _perspective_of_orthographic(projection)
        pose[:3, 3] += distance * pose[:3, 2]
    return camera_of(pose, projection, width, height)


def camera_of(pose: np.ndarray, projection: Any, width: int, height: int) -> Camera:
    """Camera from a camera-to-world matrix with OpenGL axes and an OpenGL perspective projection, both (4, 4)."""
    p = np.array(projection, np.float64)
    return camera_from_gl(
        pose,
        width,
        height,
        fl_x=p[0, 0] * width / 2,
        fl_y=p[1, 1] * height / 2,
        cx=(1 - p[0, 2]) * width / 2,
        cy=(1 + p[1, 2]) * height / 2,
    )


def _perspective_of_orthographic(projection: np.ndarray) -> tuple[np.ndarray, float]:
    """A perspective projection (4, 4) that nearly equals an orthographic one, and how many meters to step back."""
    distance = ORTHOGRAPHIC_DISTANCE * 2 / projection[0, 0]
    perspective = np.zeros((4, 4))
    perspective[0, 0], perspective[1, 1] = projection[0, 0] * distance, projection[1, 1] * distance
    perspective[0, 2], perspective[1, 2] = -projection[0, 3], -projection[1, 3]
    return perspective, distance


def _cropped(camera: Camera, border: tuple[int, int, int, int]) -> Camera:
    x, y, width, height = border
    top = camera.height - y - height
    return replace(camera, width=width, height=height, cx=camera.cx - x, cy=camera.cy - top)
