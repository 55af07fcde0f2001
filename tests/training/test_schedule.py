"""When what is trained."""

from collections import Counter
from itertools import groupby, islice
from pathlib import Path

import numpy as np
import pytest

from stga_addon.capture.camera import Camera
from stga_addon.capture.model import View
from stga_addon.training.schedule import learning_rates, sh_degree, take_order, view_order
from stga_addon.training.settings import Rates, TrainingSettings

CAMERA = Camera(4, 4, 4.0, 4.0, 2.0, 2.0, np.eye(4))
FRAMES = {0: 3, 2: 5, 5: 1, 6: 4}
VIEWS = [View(t, c, CAMERA, f"{t}_{c}", Path()) for t, n in FRAMES.items() for c in range(n)]
EPOCH = len(VIEWS)


def names(count, per_visit=1, seed=0, start=0):
    return [view.name for view in islice(view_order(VIEWS, per_visit, seed, start), count)]


@pytest.mark.parametrize("per_visit", [0, 1, 2, 4])
def test_every_view_once_an_epoch_and_another_order_each(per_visit):
    """Catches views skipped or favoured, an order that repeats itself or begins anew."""
    order = names(4 * EPOCH, per_visit)
    epochs = [order[n : n + EPOCH] for n in range(0, len(order), EPOCH)]
    assert all(Counter(epoch) == Counter(view.name for view in VIEWS) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 4
    assert names(EPOCH, per_visit, seed=1) != epochs[0]
    for start in (0, 1, 5, EPOCH - 1, EPOCH, EPOCH + 1, 2 * EPOCH + 7):
        assert names(EPOCH, per_visit, start=start) == order[start : start + EPOCH]


def test_takes_take_turns():
    """Catches a short take that starves beside a long one, and an order that a resumed run does not
    find again."""
    takes = [VIEWS[:2], VIEWS[2:], VIEWS[1:2]]
    order = [view.name for view in islice(take_order(takes, 1, 5), 60)]
    for turn, views in enumerate(takes):
        own = [view.name for view in islice(view_order(views, 1, 5 + turn), 20)]
        assert order[turn::3] == own
    for start in (1, 2, 3, 17):
        assert [v.name for v in islice(take_order(takes, 1, 5, start), 30)] == order[start:][:30]


def visits(per_visit):
    """Lengths of the runs of one frame's views."""
    order = islice(view_order(VIEWS, per_visit, 3), EPOCH)
    return [len(list(group)) for _, group in groupby(order, lambda view: view.timestep)]


def test_views_of_a_visit_stay_together():
    """Catches frames torn apart in the paper's batches, or kept together in full shuffling."""
    assert sorted(visits(0)) == [1, 3, 4, 5]
    assert len(visits(1)) > 6
    # Groups of two: a run is as long as the groups it is made of, of which the first of a frame are
    # full.
    order = list(islice(view_order(VIEWS, 2, 3), EPOCH))
    for _, frame in groupby(sorted(order, key=lambda v: v.timestep), lambda v: v.timestep):
        positions = [order.index(view) for view in frame]
        alone = [p for p in positions if p - 1 not in positions and p + 1 not in positions]
        assert len(alone) <= len(positions) % 2


def test_sh_degree_rises_step_by_step():
    """Catches a degree above the highest, a step skipped, and steps that never come."""
    settings = TrainingSettings(sh_degree=3, sh_steps=(0.2, 0.5, 0.8))
    degrees = [sh_degree(settings, p) for p in (0, 0.19, 0.2, 0.49, 0.5, 0.79, 0.8, 1.0)]
    assert degrees == [0, 0, 1, 1, 2, 2, 3, 3]
    assert sh_degree(TrainingSettings(sh_degree=1, sh_steps=(0.2, 0.5, 0.8)), 1.0) == 1
    assert sh_degree(TrainingSettings(sh_degree=0), 1.0) == 0


def test_rates_decay_to_their_ends():
    """Catches a rate without its own end, linear decay, and a rise past the budget."""
    rates = Rates(xyz=1e-3, sh=4e-2, sh_rest=2e-3, position_end=0.01, end=0.25)
    assert learning_rates(rates, 0.0) == {n: getattr(rates, n) for n in learning_rates(rates, 0.0)}
    half = learning_rates(rates, 0.5)
    end = learning_rates(rates, 1.0)
    assert end["xyz"] == pytest.approx(1e-5)
    assert half["xyz"] == pytest.approx(1e-4)
    for name in ("rotation", "log_scale", "opacity", "sh", "sh_rest"):
        assert end[name] == pytest.approx(0.25 * getattr(rates, name))
        assert half[name] == pytest.approx(0.5 * getattr(rates, name))
    assert learning_rates(rates, 1.7) == end
