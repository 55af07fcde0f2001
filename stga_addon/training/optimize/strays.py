"""Stray resets: splats far from their triangle are put back (STGA, training)."""

from dataclasses import dataclass

import numpy as np

from .backend import Backend
from .change import Turn


@dataclass(frozen=True)
class StrayReset:
    """Moves bound splats farther than a limit from their triangle's origin back to a share of it.

    The paper moves them onto the origin: share = 0. Adam's first moment of the position is reset.
    The second moment is kept: with it at zero and the step count of the row, which all its
    parameters share, in the thousands, the bias correction would make the next step 3.2 times as
    long as the learning rate (0.1 / √0.001).

    interval  iterations between turns; 0: never
    limit     (F,) float32 in local units
    share     0…1
    """

    interval: int
    limit: np.ndarray
    share: float

    def prepare(self) -> None:
        """Nothing is found out once."""

    def apply(self, backend: Backend, turn: Turn) -> None:
        limit = self.limit
        if turn.region is not None:
            limit = np.where(turn.region, limit, np.inf).astype(limit.dtype)
        columns = backend.columns(("parameters/xyz", "face", "unbound"))
        xyz = columns["parameters/xyz"]
        distance = np.linalg.norm(xyz, axis=1)
        allowed = limit[columns["face"]]
        strays = np.flatnonzero(~columns["unbound"] & (distance > allowed))
        # Rounding must not leave them just beyond the limit, or they would be strays again.
        factor = (self.share * (1 - 1e-6) * allowed[strays] / distance[strays])[:, None]
        near = np.where(factor > 0, factor * xyz[strays], 0)
        backend.assign(strays, {"parameters/xyz": near, "average/xyz": near, "first/xyz": 0.0})
