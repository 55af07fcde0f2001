"""Clean plates: what each camera would show without the person, from all timesteps together."""

from dataclasses import dataclass

import numpy as np

from ...capture.camera import Camera
from ...capture.images import read_view
from ...capture.model import Capture, View, evenly_spread
from ..optimize.image_preparation import Correction

MAX_PLATE_VIEWS = 24
"""Views of a camera that its plate is the median of."""
MAX_PLATE_PIXELS = 500_000
"""Larger images are read smaller."""
MATTE_MARGIN_SHARE = 0.008
"""Around the person nothing is taken from a view, where a matte is uncertain; share of the image's
height."""
PERSON = 256
"""Above every level of a pixel: sorts behind them."""


@dataclass(frozen=True)
class CleanPlate:
    """A camera, and what it shows without the person.

    image  (H, W, 3) float32 in 0…1
    seen   (H, W) bool: pixels that some view shows; the others are filled from around
    """

    camera: Camera
    image: np.ndarray
    seen: np.ndarray


def clean_plates(capture: Capture, correct: Correction | None = None) -> list[CleanPlate]:
    """The plate of each camera that has masks, of the training views.

    correct: the exposure of images. Raises StgaError where a file cannot be read.
    """
    from scipy.ndimage import binary_dilation

    by_camera: dict[int, list[View]] = {}
    for view in capture.views.get("train", ()):
        if view.mask is not None:
            by_camera.setdefault(view.camera_index, []).append(view)
    plates = []
    for _, views in sorted(by_camera.items()):
        camera, stack = views[0].camera, []
        scale = min(1.0, (MAX_PLATE_PIXELS / (camera.width * camera.height)) ** 0.5)
        for full_size in evenly_spread(views, MAX_PLATE_VIEWS):
            view, image, mask = read_view(full_size, scale)
            if correct is not None:
                image = correct(view, image, None)
            assert mask is not None
            margin = max(1, round(MATTE_MARGIN_SHARE * len(mask)))
            person = binary_dilation(mask > 0, iterations=margin)
            stack.append(np.where(person[..., None], PERSON, image).astype(np.uint16))
        levels = np.sort(np.stack(stack, axis=-1), axis=-1)
        count = (levels[:, :, 0] < PERSON).sum(axis=-1)
        middle = np.maximum(count - 1, 0)[..., None, None] // 2
        middle = np.broadcast_to(middle, (*count.shape, 3, 1))
        image = np.take_along_axis(levels, middle, axis=-1)[..., 0].astype(np.float32) / 255
        plates.append(CleanPlate(view.camera, filled(image, count > 0), count > 0))
    return plates


def filled(image: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The image (H, W, 3) float32 with smooth colors where it is not `seen` (H, W) bool.

    Push and pull: pixels without a color get that of the image at half the size, whose pixels are
    the means of those that have one.
    """
    from scipy.ndimage import zoom

    if seen.all() or not seen.any():
        return image
    height, width = seen.shape
    weighted = np.zeros((height + height % 2, width + width % 2, 4), np.float32)
    weighted[:height, :width, :3], weighted[:height, :width, 3] = image * seen[..., None], seen
    half = weighted.reshape(len(weighted) // 2, 2, -1, 2, 4).mean(axis=(1, 3))
    known = half[..., 3] > 0
    smaller = filled(half[..., :3] / np.maximum(half[..., 3:], 1e-6), known)
    larger = zoom(smaller, (2, 2, 1), order=1, mode="nearest", grid_mode=True)
    return np.where(seen[..., None], image, larger[:height, :width])
