"""Pruning of floaters: unbound splats in the air that fill next to nothing of any image."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ...capture.model import Capture, evenly_spread
from .backend import Backend
from .step_hook import Schedule

MIN_WEIGHT_PX = 0.5
"""An unbound splat that fills less than this in every view serves the rays of a few pixels, and
floats in the air for all other cameras."""
MIN_WEIGHT_FRACTION = 0.4
"""The same limit as a fraction of the median of unbound splats, which fill much after a short
training."""
PRUNING_TIMES = (0.6, 0.8)
"""Fractions of the budget at which splats are measured; what is trained afterwards fills in."""
MAX_WEIGHED_VIEWS = 40
"""Training views, spread over all, in which splats are measured, at most."""
WEIGHED_FRACTION = 0.03
"""Views that are measured, as a fraction of all iterations, which take longer."""


@dataclass(frozen=True)
class FloaterPruning:
    """Prunes unbound splats by what they do: the largest sum of a splat's blend weights in any one
    view. Neither opacity nor density distinguishes floaters from the faint rim of hair."""

    capture: Capture
    interval: ClassVar[int] = 1  # it goes by the fraction of the budget

    def prepare(self) -> None:
        """Nothing is found out once."""

    def apply(self, backend: Backend, schedule: Schedule) -> None:
        if not any(map(schedule.passes, PRUNING_TIMES)):
            return
        columns = backend.columns(("face", "unbound"))
        weighed = columns["unbound"]
        if schedule.region is not None:
            weighed = weighed & schedule.region[columns["face"]]
        if not weighed.any():
            return
        iterations = schedule.iteration / schedule.progress
        count = min(MAX_WEIGHED_VIEWS, max(1, round(WEIGHED_FRACTION * iterations)))
        views = evenly_spread(self.capture.views["train"], count)
        weight = np.max([backend.blend_weights(view) for view in views], axis=0)
        median = np.median(weight[columns["unbound"]])
        floaters = weighed & (weight < max(MIN_WEIGHT_PX, MIN_WEIGHT_FRACTION * median))
        if floaters.any():
            backend.keep(~floaters)
