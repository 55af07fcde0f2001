"""Trial: whether this Blender, on this graphics driver, draws splats right: three of them, against
their formula."""

from collections.abc import Callable, Sequence

import numpy as np

from ...avatar.embedding import WORLD
from ...avatar.splats import SH_C0, in_world, logits
from ...capture.camera import Camera
from ...flame.quaternions import to_matrices
from ...raster.posed_splats import ComposedImage
from ...raster.splat_shader import LOW_PASS_PX2
from ..layers import SceneLayer
from .packing import View

CAMERA = Camera(40, 24, 30.0, 26.0, 21.0, 11.0, np.eye(4))
"""Camera of the small image in which the splats are drawn."""
POSITIONS_M = np.array([[-0.3, 0.1, 3.0], [-0.12, 0.05, 0.9], [0.1, -0.06, 1.2]])
"""Centers of the three splats in the camera's space, not in the order of their depth."""
ROTATIONS = np.array([[1.0, 0, 0, 0], [0.9, 0.1, -0.2, 0.4], [0.8, -0.3, 0.1, -0.5]])
"""Quaternions wxyz of the three, not normalized."""
DEVIATIONS_M = np.array([[0.5, 0.4, 0.3], [0.03, 0.14, 0.08], [0.15, 0.05, 0.09]])
"""Standard deviations along the axes of the three."""
OPACITIES = np.array([0.5, 0.8, 0.7])
"""Opacities of the three, 0…1."""
COLORS = np.array([[0.9, 0.5, 0.1], [0.2, 0.9, 0.4], [0.3, 0.2, 0.8]])
"""Colors of the three, sRGB in 0…1."""
HIDDEN_DEPTH_M = 2.0
"""Depth of invisible splats behind the first of the three, so that the second instance of the
shader draws the others."""
MAX_ERROR = 0.03
"""Largest error of color and alpha, and of depth in meters; up to 1/255 for each splat is cut off
on purpose."""


class WrongPicture(Exception):
    """The picture of the trial is wrong; one sentence."""


def check(draw: Callable[[Sequence[SceneLayer], View], ComposedImage], hidden: int) -> None:
    """Raise WrongPicture unless `draw` draws the three splats right. hidden: how many splats beside
    them are invisible."""
    error = _error(draw([_layer(hidden)], View(CAMERA)))
    if not error <= MAX_ERROR:  # also where it is NaN
        raise WrongPicture(f"three splats are drawn with an error of {error:.2g}")


def _layer(hidden: int) -> SceneLayer:
    count = len(POSITIONS_M) + hidden
    xyz = np.tile([0.0, 0.0, HIDDEN_DEPTH_M], (count, 1))
    rotation = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    deviation = np.full((count, 3), 0.1)
    opacity = np.full(count, 1e-6)
    color = np.ones((count, 3))
    values = (xyz, POSITIONS_M), (rotation, ROTATIONS), (deviation, DEVIATIONS_M)
    for whole, three in (*values, (opacity, OPACITIES), (color, COLORS)):
        whole[: len(three)] = three
    sh = ((color - 0.5) / SH_C0)[:, None]
    splats = in_world(xyz, rotation, np.log(deviation), logits(opacity), sh)
    return SceneLayer(splats, WORLD, np.eye(4))


def _error(image: ComposedImage) -> float:
    """Largest difference of the image from EWA splatting (Zwicker et al. 2001) in numpy."""
    x, y = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    through = np.ones_like(x)
    rgb = np.zeros((3, *x.shape))
    weighted_depth = np.zeros_like(x)
    for index in np.argsort(POSITIONS_M[:, 2]):
        px, py, pz = POSITIONS_M[index]
        axes = to_matrices(ROTATIONS[index]) * DEVIATIONS_M[index]
        u = CAMERA.fl_x / pz * (axes[0] - px / pz * axes[2])
        v = CAMERA.fl_y / pz * (axes[1] - py / pz * axes[2])
        covariance = np.array([[u @ u, u @ v], [u @ v, v @ v]]) + LOW_PASS_PX2 * np.eye(2)
        offsets = np.stack([x - CAMERA.fl_x * px / pz, y - CAMERA.fl_y * py / pz], -1)
        offsets -= CAMERA.cx, CAMERA.cy
        squared = np.einsum("hwi,ij,hwj->hw", offsets, np.linalg.inv(covariance), offsets)
        alpha = through * OPACITIES[index] * np.exp(-0.5 * squared)
        rgb += alpha * COLORS[index][:, None, None]
        weighted_depth += alpha * pz
        through -= alpha
    assert image.depth is not None
    differences = image.rgb - rgb, image.alpha - (1 - through)
    depth = (image.alpha * image.depth - weighted_depth) * (through < 0.5)
    return max(float(np.abs(each).max()) for each in (*differences, depth))
