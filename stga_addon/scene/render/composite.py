"""Splats over the scene's background, in Blender's scene-linear colors."""

from typing import Any

import numpy as np

from ...capture.color import linear_to_srgb, srgb_to_linear
from .view_transform import InverseView
from .viewport_display import world_color


def combined(
    rgb: np.ndarray, alpha: np.ndarray, background: tuple[float, ...] | None, view: InverseView | None = None
) -> np.ndarray:
    """(H, W, 4) scene-linear RGBA, premultiplied, of splats rendered on black: sRGB rgb (3, H, W), alpha (H, W).

    Splats are blended in sRGB. So `background`, scene-linear (3,), is added as the sRGB that it is shown as, before the
    conversion. Where it is None the image stays transparent, and the color is converted as if it covered its pixel.
    view: the inverse of the view transform, None where that shows sRGB as it is.
    """
    to_linear = srgb_to_linear if view is None else view.to_linear
    image, covered = np.zeros((*alpha.shape, 4), np.float32), alpha > 0
    color, share = rgb[:, covered].T, alpha[covered][:, None]
    if background is None:
        image[covered, :3], image[..., 3] = to_linear(color / share) * share, alpha
    else:
        linear = np.array(background, np.float32)
        behind = linear_to_srgb(np.clip(linear, 0, 1)) if view is None else view.show(linear)
        image[...] = *background, 1
        image[covered, :3] = to_linear(np.clip(color + (1 - share) * behind, 0, 1))
    return image


def srgb_background(scene: Any) -> tuple[float, float, float] | None:
    """Color behind the splats as in `scene_background`, in sRGB 0…1."""
    linear = scene_background(scene)
    if linear is None:
        return None
    red, green, blue = linear_to_srgb(np.clip(np.array(linear, np.float64), 0, 1)).tolist()
    return red, green, blue


def scene_background(scene: Any) -> tuple[float, ...] | None:
    """Scene-linear color behind the splats, None where the film is transparent.

    From the world's Background node if its inputs are constants, else its viewport color; black without a world.
    """
    if scene.render.film_transparent:
        return None
    color = world_color(scene)
    return tuple(scene.world.color) if color is None else color
