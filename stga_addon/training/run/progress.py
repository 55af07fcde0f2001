"""Progress of a training run, and the figures of it that people read."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...avatar.file import Avatar


@dataclass(frozen=True)
class Progress:
    """The state of training after an iteration.

    share       of the budget that is spent, 0…1
    per_second  iterations
    loss        mean of the last global iterations
    psnr        of the last evaluation, dB; None before the first
    left_s      seconds of training until the budget is spent
    message     the current stage
    forecast_text  what more training is expected to bring
    avatar      makes the avatar in its present state; None before there is one
    psnr_unmatched  `psnr` without fitting the exposure of views; None where none was fitted
    """

    share: float = 0.0
    iteration: int = 0
    per_second: float = 0.0
    loss: float = np.nan
    psnr: float | None = None
    splats: int = 0
    left_s: float = np.nan
    message: str = ""
    forecast_text: str = ""
    avatar: Callable[[], Avatar] | None = None
    psnr_unmatched: float | None = None

    def figures(self) -> dict[str, float]:
        """The figures that are known, by name; NaN where one has no value yet."""
        from ..evaluate.metrics import peak_memory_mb

        names = ("iteration", "per_second", "left_s", "loss", "psnr", "psnr_unmatched", "splats")
        values = {name: getattr(self, name) for name in names} | {"memory_mb": peak_memory_mb()}
        return {name: float(value) for name, value in values.items() if value is not None}


Report = Callable[[Progress], bool]
"""Called after every iteration; returns True to stop early and keep what is trained."""
