"""Self-test: whether a device renders and differentiates correctly, checked before training on it."""

import math

import numpy as np
import warp as wp

from ...avatar.embedding import WORLD
from ...capture.camera import Camera
from ..cpu.layout import Parameters
from ..cpu.rasterize import frames_in_camera
from . import blend, embed, image_loss, optimizer, project, tiles
from .rasterize import PARAMETER_TYPES, DeviceFrames, Rasterizer, device_camera

MODULES = (embed, project, tiles, blend, image_loss, optimizer)


def compile_kernels(device: str) -> None:
    """Compile every kernel for the device, or load it from the cache."""
    for module in MODULES:
        wp.load_module(module, device=device, block_dim=blend.PIXELS)


def passes(device: str) -> bool:
    """Render one gray splat over several tiles, and image_loss_gradient the sum of the image.

    Both are known: the middle pixel is gray times opacity, and the gradient with respect to the opacity's logit is
    (1 − opacity) times the sum. The latter comes out right only if no thread's part is lost or counted twice.
    """
    size, logit = 40, 2.0
    camera = Camera(size, size, 40.0, 40.0, size / 2 + 0.5, size / 2 + 0.5, np.eye(4))
    splat = [[[0, 0, 1]], [[1, 0, 0, 0]], [[-2, -2, -2]], [logit], np.zeros((1, 1, 3)), np.zeros((1, 0, 3))]
    parameters, gradients = (
        Parameters(
            *(
                wp.array(factor * np.array(value, np.float32), dtype=kind, device=device)
                for value, kind in zip(splat, PARAMETER_TYPES, strict=True)
            )
        )
        for factor in (1, 0)
    )
    camera_frames = frames_in_camera(WORLD, camera)
    frames = DeviceFrames(
        wp.array(camera_frames.origin, dtype=wp.vec3, device=device),
        wp.array(camera_frames.matrix, dtype=wp.mat33, device=device),
        wp.array(camera_frames.strain, dtype=wp.float32, device=device),
        device_camera(camera, 0, 0),
    )
    rasterizer, face = Rasterizer(device), wp.zeros(1, wp.int32, device=device)
    rendering = rasterizer.forward(parameters, face, frames)
    rasterizer.backward(rendering, parameters, face, wp.full((3, size, size), 1.0, device=device), gradients)
    image, opacity = rendering.image.numpy(), 1 / (1 + math.exp(-logit))
    middle, gradient = image[:, size // 2, size // 2], gradients.opacity.numpy()[0]
    return bool(
        np.allclose(middle, 0.5 * opacity, rtol=1e-5) and np.isclose(gradient, (1 - opacity) * image.sum(), rtol=1e-4)
    )
