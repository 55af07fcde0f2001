"""Training strategies: which triangles an iteration trains."""

from collections.abc import Mapping

import numpy as np

from ..settings import CONTINUATIONS, TrainingSettings

EXTEND_LOCAL_SHARE = 0.5
"""Share of an extension's budget that trains what the new takes need, before all splats are
trained."""


class Strategy:
    """Decides which triangles each iteration trains, as `TrainingSettings.strategy` says.

    region  (F,) bool: the only triangles whose splats the run may change; None for all

    "selective" alternates local iterations, which train a frame's selected triangles, with global
    ones (STGA, training). "refine" trains the same region throughout, "extend" first what new takes
    need, in views of all takes, and then all splats. Not in turn: where some splats are frozen in
    the new views only, the others make up for them there, and drift.
    """

    def __init__(self, settings: TrainingSettings, selection: Mapping[int, np.ndarray]) -> None:
        """selection: timestep -> (F,) bool triangles; continuations train the union."""
        self._settings, self._selection = settings, selection
        continues = settings.strategy in CONTINUATIONS
        self.region = np.any(list(selection.values()), axis=0) if continues else None

    def triangles(
        self, iteration: int, visit: int, timestep: int, progress: float
    ) -> np.ndarray | None:
        """(F,) bool triangles whose splats are trained; None trains all splats.

        iteration, visit  count iterations and visits of frames (consecutive views of one timestep)
                          from 0
        progress          share of the budget spent
        """
        settings, region = self._settings, self.region
        if region is not None:
            is_local = progress < EXTEND_LOCAL_SHARE and region.any()
            return region if settings.strategy == "refine" or is_local else None
        selected = self._selection.get(timestep)
        count = iteration if settings.global_unit == "iteration" else visit
        is_global = count % (settings.global_interval + 1) == settings.global_interval
        if settings.strategy != "selective" or progress < settings.warm_up_share or is_global:
            return None
        return selected if selected is not None and selected.any() else None
