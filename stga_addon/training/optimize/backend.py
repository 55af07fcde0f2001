"""Interface between the trainer and the backends, which compute an iteration on a device."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ...capture.model import View
from .state import TrainState


@dataclass(frozen=True)
class Batch:
    """Input of one iteration: one view.

    target      (H, W, 3) uint8 over the settings' background
    mask        (H, W) uint8 coverage if the target's background is to be replaced by `background`,
                else None
    background  (3,) float32 behind the splats
    sh_degree   degree of spherical harmonics in use
    selected    (F,) bool triangles whose splats are trained; None trains all
    rates       learning rate by parameter name, and "sh_rest"
    accumulate  whether screen gradients are summed for density control
    """

    view: View
    target: np.ndarray
    mask: np.ndarray | None
    background: np.ndarray
    sh_degree: int
    selected: np.ndarray | None
    rates: Mapping[str, float]
    accumulate: bool = True


class Backend(Protocol):
    """Holds the splats in training and computes iterations.

    state  as a `TrainState` in host memory; changes take effect when it is assigned
    """

    state: TrainState

    def __len__(self) -> int:
        """How many splats there are."""

    def step(self, batch: Batch) -> float | None:
        """Forward, backward and optimizer step. Returns the latest image loss that has become
        available, if any."""

    def render(self, view: View, background: np.ndarray, sh_degree: int) -> np.ndarray:
        """The view with the splats' exponential moving average: a new (3, H, W) float32 image over
        background (3,)."""
