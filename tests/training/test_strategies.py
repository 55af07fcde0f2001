"""Strategies: which triangles an iteration trains."""

import numpy as np
import pytest

from stga_addon.training.optimize.strategies import SelectiveStrategy, make_strategy
from stga_addon.training.settings import TrainingSettings

MOUTH = np.array([True, False])


def selective(**changes: object) -> SelectiveStrategy:
    """Selects in timesteps 0 to 19; nothing in timestep 20."""
    selection = {**dict.fromkeys(range(20), MOUTH), 20: ~MOUTH & MOUTH}
    return SelectiveStrategy(TrainingSettings(strategy="selective", **changes), selection)  # type: ignore[arg-type]


@pytest.mark.parametrize("interval", [1, 2, 20])
def test_global_iteration_after_every_so_many_local_ones(interval: int) -> None:
    """Catches an off-by-one: `interval` local iterations, then a global one, from the first
    iteration on."""
    strategy = selective(global_interval=interval, global_unit="iteration", warm_up_share=0.0)
    kinds = [strategy.triangles(n, 0, 0, 0.5) is None for n in range(3 * (interval + 1))]
    assert kinds == ([False] * interval + [True]) * 3


def test_global_visit_after_every_so_many_frames() -> None:
    """Catches the unit being ignored: with frames, the count of iterations must not matter."""
    strategy = selective(global_interval=3, global_unit="frame", warm_up_share=0.0)
    for visit in range(12):
        kinds = {strategy.triangles(n, visit, 0, 0.5) is None for n in range(10)}
        assert kinds == {visit % 4 == 3}


def test_warm_up_and_empty_selections_are_global() -> None:
    """Catches local iterations before the head has taken shape, and iterations that train
    nothing."""
    strategy = selective(warm_up_share=0.3)
    assert all(strategy.triangles(n, n, 0, 0.29) is None for n in range(6))
    assert strategy.triangles(0, 0, 0, 0.3) is MOUTH
    for timestep in (20, 21):  # selected nothing, and not in the selection
        assert strategy.triangles(0, 0, timestep, 0.3) is None


@pytest.mark.parametrize("name", ["global", "gaussian-avatars"])
def test_other_strategies_are_global(name: str) -> None:
    """Catches local iterations in a run that should have none."""
    strategy = make_strategy(TrainingSettings(strategy=name, warm_up_share=0.0), {0: MOUTH})
    assert all(strategy.triangles(n, n, 0, 0.9) is None for n in range(6))
