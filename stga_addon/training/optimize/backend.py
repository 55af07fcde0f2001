"""The interface between decisions about splats, made on the host, and the backend that holds and
trains them."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ...capture.model import View
from .state import TrainState


@dataclass(frozen=True)
class RenderOptions:
    """What a picture depends on beside splats and view.

    background  (3,) float32 behind the splats, sRGB in 0…1
    sh_degree   of the spherical harmonics in use; higher coefficients do not count
    """

    background: np.ndarray
    sh_degree: int


@dataclass(frozen=True)
class Batch:
    """Input of one iteration: one view.

    target      (H, W, 3) uint8 over the settings' background
    mask        (H, W) uint8 coverage if the target's background is to be replaced by that of the
                options
    selected    (F,) bool triangles whose splats are trained; None trains all
    rates       learning rate by parameter name, and "sh_rest"
    accumulate  whether screen gradients are summed for density control
    """

    view: View
    target: np.ndarray
    mask: np.ndarray | None
    options: RenderOptions
    selected: np.ndarray | None
    rates: Mapping[str, float]
    accumulate: bool = True


class Backend(Protocol):
    """Holds N splats in training, bound to F triangles, and steps, renders and edits them.

    Splats may lie on a device. Who decides about them reads the few columns that the decision needs
    and names rows; the rows themselves stay where they are. A column has the name of `columns_of`,
    such as "parameters/xyz" (local units), "average/color", "face" or "screen_gradient", and a row
    for each splat. Rows are numbered from 0 in the order of the columns, which `keep` changes.

        columns = backend.columns(["parameters/opacity"])
        backend.keep(columns["parameters/opacity"] > -4)
    """

    def __len__(self) -> int:
        """N."""
        ...

    @property
    def state(self) -> TrainState:
        """All columns and driven offsets, after all steps: the trained arrays themselves or, of a
        device, a copy in host memory, so it is not for every iteration."""
        ...

    @state.setter
    def state(self, state: TrainState) -> None: ...

    def step(self, batch: Batch) -> float | None:
        """Forward, backward and optimizer of one view.

        Returns the image loss, (1 − w)·L1 + w·(1 − SSIM) as a mean over the image, of an iteration
        that renders the whole image; None of one with selected triangles. A device may return that
        of an earlier iteration, None before there is one.
        """
        ...

    def render(self, view: View, options: RenderOptions) -> np.ndarray:
        """The view with the splats' moving average, after all steps: a new (3, H, W) float32 image,
        sRGB in 0…1."""
        ...

    def blend_weights(self, view: View) -> np.ndarray:
        """How many of the view's pixels each splat fills: (N,), the sums of its blend weights."""
        ...

    def coefficients(self) -> dict[str, np.ndarray]:
        """Driven offset -> its latest coefficients (F, 3, 3) float32, not to be written to."""
        ...

    def columns(
        self, names: Collection[str], rows: np.ndarray | None = None
    ) -> dict[str, np.ndarray]:
        """The named columns (N, …), not to be written to; they may be copies in host memory. Of
        some rows, (M,) numbers: copies (M, …)."""
        ...

    def assign(self, rows: np.ndarray, values: Mapping[str, np.ndarray | float]) -> None:
        """Write to the rows, (M,) numbers or (N,) bool, of columns: values (M, …), or a number. No
        row is bound to another triangle."""
        ...

    def keep(self, rows: np.ndarray) -> None:
        """Remove all but these rows, (N,) bool or (M,) numbers in their new order, in which a row
        may occur several times."""
        ...
