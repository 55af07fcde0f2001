"""One iteration: render a view, compare, and step the splats. Who computes it, the CPU or a GPU, is one object."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ...capture.model import View
from .state import TrainState


@dataclass(frozen=True)
class Batch:
    """What one iteration trains, and how.

    target      (H, W, 3) uint8 over the settings' background
    mask        (H, W) uint8 coverage where the background behind the target is to be exchanged for `background`
    background  (3,) float32 behind the splats
    degree      of spherical harmonics in use
    selected    (F,) bool triangles whose splats alone are trained; None trains all
    rates       learning rate by parameter name, and "sh_rest"
    refine      share of the full rates by which FLAME's parameters of the timestep are stepped, 0 for not at all
    """

    view: View
    target: np.ndarray
    mask: np.ndarray | None
    background: np.ndarray
    degree: int
    selected: np.ndarray | None
    rates: Mapping[str, float]
    refine: float = 0.0


class Backend(Protocol):
    """Holds the splats in training and computes with them.

    state  as a `TrainState` in the host's memory; what is changed there counts once it is assigned
    """

    state: TrainState

    def __len__(self) -> int:
        """How many splats there are."""

    def train(self, batch: Batch) -> float | None:
        """Make one step. Returns the image loss of the latest global iteration that is known and not yet told."""

    def render(self, view: View, background: np.ndarray, degree: int) -> np.ndarray:
        """The view as the splats show it now: a new (3, H, W) float32 image."""
