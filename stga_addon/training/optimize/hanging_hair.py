"""The outline of long hair that hangs beside and behind the neck."""

from dataclasses import dataclass

import numpy as np

from .semantic_regions import EYES_TO_MIDDLE, HeadCoordinates
from .surface import WIDTHS, Surface

LOWEST_LEVEL = -1.6
"""Height over the eyes above which all that masks show beside the head is hair; shoulders are
lower."""
HIGHEST_LEVEL = 0.4
"""Height over the eyes at which hair begins to hang."""
LEVEL_STEP = 0.2
"""Distance between heights at which hair is measured."""
BLENDED_LEVELS = 0.4
"""Height over which hair turns from growing to hanging."""
EDGE_INSET = 0.2
"""Distance of hair's layer from the masks' edge: strands nearer to it would be trained, and fray
it."""
WIDEST = 1.7
"""Largest distance of that layer from the middle plane; locks farther out are free splats."""


@dataclass(frozen=True)
class HangingHair:
    """Horizontal sections of hair behind the ears, each half an ellipse; lengths in distances of
    the eyes from the mouth.

    levels  (L,) heights over the eyes, rising
    widths  (2, L) distance from the middle plane at the right and at the left ear
    depths  (L,) of the back behind the ears
    """

    at: HeadCoordinates
    levels: np.ndarray
    widths: np.ndarray
    depths: np.ndarray

    def around(self, places: np.ndarray) -> np.ndarray:
        """Places (N, 3) on the neutral head: those behind the ears that lie within the sections are
        moved out to these, away from the vertical line between the ears."""
        across, up, ahead = self.at.axes
        away = (places - self.at.eyes) / self.at.unit
        x = away @ across
        level = away @ up
        behind = -(away @ ahead) - EYES_TO_MIDDLE
        right, left, depth = (
            np.interp(level, self.levels, each) for each in (*self.widths, self.depths)
        )
        width = np.where(x < 0, right, left)
        size = np.maximum(np.hypot(x / width, behind / depth), 1e-9)  # 1 on the ellipse
        begun = np.clip((HIGHEST_LEVEL - level) / BLENDED_LEVELS, 0, 1)
        farther = begun * np.maximum(1 / size - 1, 0) * (behind > 0) * self.at.unit
        return places + farther[:, None] * (np.outer(x, across) - np.outer(behind, ahead))


def hanging_hair(surface: Surface, at: HeadCoordinates, layer: np.ndarray) -> HangingHair:
    """The outline of a head's long hair: it is as wide as masks show it, and falls straight down
    from where its layer, points (N, 3) above the neutral head's scalp, reaches farthest back."""
    levels = np.arange(LOWEST_LEVEL, HIGHEST_LEVEL + LEVEL_STEP / 2, LEVEL_STEP)
    widths = np.clip(surface.widths(levels) - EDGE_INSET, WIDTHS[0], WIDEST)
    _, up, ahead = at.axes
    away = (layer - at.eyes) / at.unit
    level = away @ up
    behind = -(away @ ahead) - EYES_TO_MIDDLE
    depths = [behind[level > low - LEVEL_STEP].max(initial=WIDTHS[0]) for low in levels]
    return HangingHair(at, levels, widths, np.array(depths))
