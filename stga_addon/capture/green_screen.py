"""The light that a green or blue screen throws on the person in front."""

import numpy as np

SPILL_REACH_FRACTION = 0.15
"""Distance from a person's outline at which no light of the screen is taken away any more, as a
fraction of the image's height; it is taken away wholly up to half of that."""
SCREEN_STEP_PX = 8
"""Distance of the pixels by which a screen is recognized."""
MIN_SCREEN_PIXELS = 50
"""Least number of these pixels that show the backdrop."""
SCREEN_LEVELS = 50
"""Largest difference of a pixel's channels from the screen's color, of 255."""
MIN_SCREEN_FRACTION = 0.6
"""Fraction of the backdrop's pixels that have the screen's color at least; others show its edges,
or bars beside the picture."""
MIN_SCREEN_LEVELS = 40
"""Least difference of the screen's brightest channel from its second, of 255; a sky has 30."""


def without_spill(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Image (H, W, 3) uint8 without the light of a green or blue screen on the person in front,
    (H, W) uint8 coverage, near the outline; pixels that show some of the screen stay."""
    import cv2

    key = screen_channel(image, mask)
    if key is None:
        return image
    whole = cv2.inRange(mask, 255, 255)
    distance = cv2.distanceTransform(whole, cv2.DIST_L2, 3)
    fraction = np.clip(2 - 2 / (SPILL_REACH_FRACTION * len(image)) * distance, 0, 1)
    channels = list(cv2.split(image))
    others = [channel for number, channel in enumerate(channels) if number != key]
    excess = cv2.bitwise_and(cv2.subtract(channels[key], cv2.max(*others)), whole)
    channels[key] = cv2.subtract(channels[key], (fraction * excess).astype(np.uint8))
    return np.asarray(cv2.merge(channels))


def screen_channel(image: np.ndarray, mask: np.ndarray) -> int | None:
    """The channel of the one color of a backdrop that is a green or blue screen; None of others."""
    clear = image[::SCREEN_STEP_PX, ::SCREEN_STEP_PX][mask[::SCREEN_STEP_PX, ::SCREEN_STEP_PX] == 0]
    if len(clear) < MIN_SCREEN_PIXELS:
        return None
    color = np.median(clear, axis=0)
    key = int(color.argmax())
    even = np.abs(clear - color).max(axis=1) < SCREEN_LEVELS
    is_screen = key > 0 and color[key] - np.delete(color, key).max() > MIN_SCREEN_LEVELS
    return key if is_screen and even.mean() > MIN_SCREEN_FRACTION else None


def limited_channel(colors: np.ndarray, key: int) -> np.ndarray:
    """Colors (N, 3) whose channel `key` is at most as bright as the brighter of the others."""
    limited = colors.copy()
    limited[:, key] = np.minimum(colors[:, key], np.delete(colors, key, axis=1).max(axis=1))
    return limited
