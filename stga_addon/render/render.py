"""Render splats or an avatar with a camera.

`cpu.autograd.render_differentiable` renders torch tensors that require gradients.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..avatar.embedding import NO_COLUMNS, WORLD, FaceFrames
from ..avatar.file import Avatar
from ..avatar.splats import SH_C0, Splats
from ..capture.camera import Camera
from ..raster.cpu.layout import Parameters
from ..raster.cpu.rasterize import frames_in_camera, render_forward
from ..raster.posed_splats import PosedSplats
from .composer import Composer

WHITE = (1.0, 1.0, 1.0)


def render(
    splats: Splats,
    camera: Camera,
    background: tuple[float, float, float] = WHITE,
    frames: FaceFrames = WORLD,
    antialiased: bool = False,
) -> np.ndarray:
    """Render N splats: (3, H, W) float32, display values (sRGB) in 0…1, rows from the top.

    splats: raw values as `Splats` documents them (opacity as a logit, scale as a logarithm, SH
    coefficients); positions in the frames of their triangles (`avatar.embedding.face_frames`), or
    in world meters with `WORLD`.
    camera: pose and intrinsics with OpenCV axes. background: sRGB in 0…1. antialiased: whether
    splats narrower than a pixel lose opacity (Mip-Splatting's 2D filter); an avatar says how it was
    trained.
    """
    values = (np.ascontiguousarray(getattr(splats, name)) for name in Parameters._fields)
    parameters = Parameters(*values)
    output = render_forward(
        parameters,
        splats.face,
        frames_in_camera(frames, camera),
        splats.sh_degree,
        np.array(background, np.float32),
        antialiased=antialiased,
    )
    return np.clip(output.image, 0, 1)


def render_avatar(
    avatar: Avatar,
    mesh: np.ndarray,
    camera: Camera,
    background: tuple[float, float, float] = WHITE,
) -> np.ndarray:
    """`render` of an avatar that follows a mesh (V, 3) in world meters."""
    return render(avatar.splats, camera, background, avatar.frames(mesh), avatar.antialiased)


def render_layers(
    layers: Sequence[PosedSplats],
    camera: Camera,
    background: tuple[float, float, float] = WHITE,
    composer: Composer | None = None,
) -> np.ndarray:
    """`render` of several sets of splats together; composer: chooses the device, the CPU without
    one. A set that is alone, in the world, is on the CPU exactly as `render` has it."""
    composer = composer or Composer("cpu")
    first = layers[0]
    is_alone = len(layers) == 1 and np.array_equal(first.to_world, np.eye(4))
    if is_alone and composer.choose() == "cpu":
        return render(first.splats, camera, background, first.frames, first.antialiased)
    composed = composer.compose(list(layers), camera)
    rest = (1 - composed.alpha) * np.array(background, np.float32)[:, None, None]
    return np.clip(composed.rgb + rest, 0, 1)


def posed_avatar(avatar: Avatar, mesh: np.ndarray, colors: np.ndarray | None = None) -> PosedSplats:
    """A layer: the avatar on a mesh (V, 3), with sRGB colors (N, 3), as `light.relight` finds them,
    or its own."""
    frames = avatar.frames(mesh)
    splats = avatar.splats
    if colors is not None:
        frames = replace(frames, color=NO_COLUMNS)
        sh = ((colors[:, None] - 0.5) / SH_C0).astype(np.float32)
        splats = replace(splats, sh=sh)
    return PosedSplats(splats, frames, antialiased=avatar.antialiased)


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Rendered image (3, H, W) in 0…1 as pixels (H, W, 3) uint8, as image files hold them."""
    return np.asarray(np.rint(np.clip(image, 0, 1).transpose(1, 2, 0) * 255), np.uint8)
