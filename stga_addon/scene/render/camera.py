"""Blender's view of the world as a calibrated camera."""

from dataclasses import replace
from typing import Any

import numpy as np

from ...capture.camera import Camera, camera_from_gl
from ...errors import StgaError

FAR = 1000.0  # an orthographic view is drawn as one from this many times its own width away


def render_camera(thing: Any, depsgraph: Any, width: int, height: int, border: tuple[int, int, int, int]) -> Camera:
    """The scene's camera for a final image of width × height pixels.

    thing: the evaluated camera object. border: x, y, width and height in pixels of what is drawn, from the bottom left.
    Raises StgaError unless it is a perspective camera.
    """
    if thing is None or thing.type != "CAMERA":
        raise StgaError("the scene has no camera to render through")
    if thing.data.type != "PERSP":
        raise StgaError(f"{thing.name}: is no perspective camera, and STGA Splats draws through no other")
    render = depsgraph.scene.render
    projection = thing.calc_matrix_camera(
        depsgraph, x=width, y=height, scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y
    )
    camera = camera_of(np.array(thing.matrix_world.normalized(), np.float64), projection, width, height)
    return _cropped(camera, border)


def viewport_camera(region: Any, width: int, height: int) -> Camera:
    """What a 3D viewport (a RegionView3D) looks through, for a picture of width × height pixels."""
    pose = np.array(region.view_matrix.inverted(), np.float64)
    projection = np.array(region.window_matrix, np.float64)
    if not region.is_perspective:
        projection, distance = _from_afar(projection)
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


def _from_afar(projection: np.ndarray) -> tuple[np.ndarray, float]:
    """A perspective projection that shows nearly what an orthographic one does, and how far to step back for it."""
    distance = FAR * 2 / projection[0, 0]
    afar = np.zeros((4, 4))
    afar[0, 0], afar[1, 1] = projection[0, 0] * distance, projection[1, 1] * distance
    afar[0, 2], afar[1, 2] = -projection[0, 3], -projection[1, 3]
    return afar, distance


def _cropped(camera: Camera, border: tuple[int, int, int, int]) -> Camera:
    x, y, width, height = border
    top = camera.height - y - height
    return replace(camera, width=width, height=height, cx=camera.cx - x, cy=camera.cy - top)
