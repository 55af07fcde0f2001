"""Changes of the splats between steps: what they are told, and what they have in common."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .backend import Backend


@dataclass(frozen=True)
class Turn:
    """When a change is made.

    iteration      steps made so far
    progress       share of the budget spent, 0…1
    initial_count  splats of the whole lattice and hull points
    region         (F,) bool: the triangles whose splats may change; None for all
    before         progress at the step before
    """

    iteration: int
    progress: float
    initial_count: int
    region: np.ndarray | None = None
    before: float = 0.0

    def passes(self, share: float) -> bool:
        """Whether this is the first step at which that share of the budget is spent."""
        return self.before < share <= self.progress


class Change(Protocol):
    """Edits the rows of a backend every so many steps.

    interval  iterations between turns; 0: never
    """

    @property
    def interval(self) -> int: ...

    def prepare(self) -> None:
        """Find out now what the first turn would find out once."""
        ...

    def apply(self, backend: Backend, turn: Turn) -> None:
        """Decide on the host, by the columns that this needs, and edit the rows."""
        ...


def is_turn_of(change: Change, turn: Turn) -> bool:
    return change.interval > 0 and turn.iteration % change.interval == 0
