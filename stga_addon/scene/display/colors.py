"""sRGB, in which splats are trained, and scene-linear light, in which Blender computes (IEC 61966-2-1)."""

import numpy as np


def srgb_to_linear(srgb: np.ndarray) -> np.ndarray:
    """Display values to light, both 0…1."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """Light to display values, both 0…1."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)
