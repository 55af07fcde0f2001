"""Hooks that edit the splats between steps, and the schedule that they are called with."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .backend import Backend


@dataclass(frozen=True)
class Schedule:
    """When a hook is called.

    iteration      steps made so far
    progress       fraction of the budget spent, 0…1
    initial_count  splats of the whole lattice and visual-hull points
    region         (F,) bool: the triangles whose splats may change; None for all
    before         progress at the step before
    """

    iteration: int
    progress: float
    initial_count: int
    region: np.ndarray | None = None
    before: float = 0.0

    def passes(self, fraction: float) -> bool:
        """Whether this is the first step at which that fraction of the budget is spent."""
        return self.before < fraction <= self.progress


class StepHook(Protocol):
    """Edits the rows of a backend every so many steps.

    interval  iterations between calls; 0: never
    """

    @property
    def interval(self) -> int: ...

    def prepare(self) -> None:
        """Find out now what the first call would find out once."""
        ...

    def apply(self, backend: Backend, schedule: Schedule) -> None:
        """Decide on the host, by the columns that this needs, and edit the rows."""
        ...


def is_due(hook: StepHook, schedule: Schedule) -> bool:
    return hook.interval > 0 and schedule.iteration % hook.interval == 0
