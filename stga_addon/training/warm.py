"""Compile (or load from the cache) every kernel before the clock of a training run starts."""

import numpy as np

from ..avatar.embedding import WORLD
from ..avatar.splats import Splats
from ..capture.camera import Camera
from ..raster.kernels.image_loss import change_background
from ..raster.kernels.rows import distance_limit, scale_limit
from ..raster.render import Parameters, camera_frames, render_backward, render_forward, touched_tiles
from . import adam
from .losses import image_gradient, whole_image
from .state import new_state


def compile_kernels() -> None:
    """Run each kernel once on two splats, with the argument types of real training."""
    # Two splats: a column of a one-row array counts as contiguous, which is another type to Numba.
    pair = Splats(
        xyz=np.array([[0, 0, 1], [0, 0, 2]], np.float32),
        rotation=np.array([[1, 0, 0, 0]] * 2, np.float32),
        log_scale=np.full((2, 3), -3, np.float32),
        opacity=np.zeros(2, np.float32),
        sh=np.zeros((2, 16, 3), np.float32),
        face=np.zeros(2, np.int32),
        loose=np.zeros(2, bool),
    )
    state = new_state(pair)
    camera = Camera(16, 16, 16.0, 16.0, 8.0, 8.0, np.eye(4))
    seen, face = camera_frames(WORLD, camera), state.face.numpy()
    rendering = render_forward(state.arrays(), face, seen, 3, focus=np.ones(2, bool))
    touched_tiles(rendering, np.ones(2, bool))
    gradient = np.empty_like(rendering.image)
    target = np.zeros((16, 16, 3), np.uint8)
    target.setflags(write=False)  # as the loader's are; Numba compiles for that
    mask, over = np.zeros((16, 16), np.uint8), np.empty((16, 16, 3), np.uint8)
    mask.setflags(write=False)
    change_background(target, mask, np.zeros(3, np.float32), np.ones(3, np.float32), over)
    image_gradient(rendering.image, target, whole_image(16, 16), 0.2, gradient)
    gradients = Parameters(*(g.numpy() for g in state.gradients))
    rows, _ = render_backward(rendering, state.arrays(), face, seen, gradient, gradients)
    limits = rows, state.parameters.log_scale.numpy(), face, state.loose.numpy(), np.ones(1, np.float32), 1.0
    scale_limit(*limits, gradients.log_scale)
    distance_limit(*limits, gradients.xyz)
    adam.step(state, rows, dict.fromkeys((*Parameters._fields, "sh_rest"), 1e-3))
