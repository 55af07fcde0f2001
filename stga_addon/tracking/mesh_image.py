"""Shaded pictures of a mesh in NumPy, for landmark detectors and contact sheets."""

import numpy as np

from ..capture.camera import Camera
from ..capture.mesh_geometry import rasterize, vertex_normals

SKIN_RGB = np.array([0.78, 0.58, 0.48])
BACKGROUND = 0.45
KEY_LIGHT = np.array([0.35, 0.55, 0.75])
"""Direction towards the light in camera axes: x right, y up, z towards the camera."""
AMBIENT = 0.38


def shaded_image(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, colors: np.ndarray | None = None
) -> np.ndarray:
    """The mesh in soft light on gray: (H, W, 3) uint8. colors (V, 3), 0 to 1; None: skin's."""
    triangle, weights = rasterize(vertices, faces, camera)
    seen = triangle >= 0
    corners, inside = faces[triangle[seen]], weights[seen][..., None]
    axes = camera.world_to_camera[:3, :3]
    normal = (vertex_normals(vertices, faces)[corners] * inside).sum(1) @ axes.T * [1, -1, -1]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    light = KEY_LIGHT / np.linalg.norm(KEY_LIGHT)
    lit = (1 - AMBIENT) * np.clip(normal @ light, 0, 1)
    brightness = AMBIENT * (0.75 + 0.25 * normal[:, 1]) + lit
    color = SKIN_RGB if colors is None else (colors[corners] * inside).sum(1)
    image = np.full((camera.height, camera.width, 3), BACKGROUND)
    image[seen] = np.clip(brightness[:, None], 0, 1) * color * 1.15
    return np.asarray(255 * np.clip(image, 0, 1) ** (1 / 1.8) + 0.5, np.uint8)
