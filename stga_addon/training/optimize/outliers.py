"""Outlier resets: splats far from their triangle are put back (STGA, training)."""

from dataclasses import dataclass

import numpy as np

from .backend import Backend
from .step_hook import Schedule


@dataclass(frozen=True)
class OutlierReset:
    """Moves bound splats farther than a limit from their triangle's origin to a fraction of it.

    The paper moves them onto the origin: fraction = 0. Adam's first moment of the position is
    reset. The second moment is kept: with it at zero and the step count of the row, which all its
    parameters share, in the thousands, the bias correction would make the next step 3.2 times as
    long as the learning rate (0.1 / √0.001).

    interval  iterations between calls; 0: never
    limit     (F,) float32 in local units
    fraction  0…1
    """

    interval: int
    limit: np.ndarray
    fraction: float

    def prepare(self) -> None:
        """Nothing is found out once."""

    def apply(self, backend: Backend, schedule: Schedule) -> None:
        limit = self.limit
        if schedule.region is not None:
            limit = np.where(schedule.region, limit, np.inf).astype(limit.dtype)
        columns = backend.columns(("parameters/xyz", "face", "unbound"))
        xyz = columns["parameters/xyz"]
        distance = np.linalg.norm(xyz, axis=1)
        allowed = limit[columns["face"]]
        outliers = np.flatnonzero(~columns["unbound"] & (distance > allowed))
        # Rounding must not leave them just beyond the limit, or they would be outliers again.
        factor = (self.fraction * (1 - 1e-6) * allowed[outliers] / distance[outliers])[:, None]
        near = np.where(factor > 0, factor * xyz[outliers], 0)
        backend.assign(outliers, {"parameters/xyz": near, "average/xyz": near, "first/xyz": 0.0})
