"""Pictures of a finished avatar: what `render` and `eval` show."""

import numpy as np

from ..avatar.embedding import WORLD, FaceFrames
from ..avatar.file import Avatar
from ..avatar.splats import Splats
from ..capture.camera import Camera
from .cpu.rasterize import Parameters, camera_frames, render_forward


def render_avatar(
    avatar: Avatar, mesh: np.ndarray, camera: Camera, background: tuple[float, float, float]
) -> np.ndarray:
    """The avatar driven by a mesh (V, 3) in world metres: (3, H, W) float32 sRGB in 0…1."""
    return render_splats(avatar.splats, camera, background, avatar.frames(mesh), avatar.antialiased)


def render_splats(
    splats: Splats,
    camera: Camera,
    background: tuple[float, float, float],
    frames: FaceFrames = WORLD,
    antialiased: bool = False,
) -> np.ndarray:
    """Splats in the frames of their triangles (or in world space): (3, H, W) float32 sRGB in 0…1."""
    arrays = Parameters(*(np.ascontiguousarray(getattr(splats, name)) for name in Parameters._fields))
    seen = camera_frames(frames, camera)
    colour = np.array(background, np.float32)
    rendering = render_forward(arrays, splats.face, seen, splats.sh_degree, colour, antialiased=antialiased)
    return np.clip(rendering.image, 0, 1)
