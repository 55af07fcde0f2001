"""When a run evaluates, and when it stops by itself."""

import re
from itertools import count

import numpy as np
import pytest

from stga_addon.avatar.file import read_avatar
from stga_addon.training import schedule
from stga_addon.training.evaluate import evaluator
from stga_addon.training.evaluate.evaluator import EVALUATION_FRACTION
from stga_addon.training.evaluate.forecast import checked_forecasts
from stga_addon.training.evaluate.metrics import Quality
from stga_addon.training.run import session
from stga_addon.training.run.checkpoint import read_checkpoint
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.run.session import train_run

from .toys import run_of


def scores(values):
    return lambda *args, **kwargs: Quality(next(values), 0.5)


class Clock:
    """A clock that only training and evaluation move, by fixed amounts."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    """Steps take a second, evaluations three."""
    clock = Clock()
    step = session.Trainer.step

    def slow_step(*arguments):
        clock.now += 1
        return step(*arguments)

    def slow_evaluate(*arguments, **named):
        clock.now += 3
        return Quality(20 + np.log(clock.now), 0.5)

    monkeypatch.setattr(session, "perf_counter", clock)
    monkeypatch.setattr(session.Trainer, "step", slow_step)
    monkeypatch.setattr(evaluator, "evaluate", slow_evaluate)
    return clock


def test_evaluation_keeps_to_its_fraction_of_the_time(toy, tmp_path, clock):
    """Catches evaluations that eat the budget, are counted as training, or hardly ever come."""
    train_run(toy, tmp_path, run_of(toy, lattice=0, iterations=None, seconds=400.0))
    lines = read_metrics(tmp_path)
    assert read_checkpoint(tmp_path).elapsed_s == 400 == read_checkpoint(tmp_path).iteration
    assert [line["evaluation_s"] for line in lines] == [3.0] * len(lines)
    assert EVALUATION_FRACTION - 0.01 < 3.0 * (len(lines) - 1) / 400 <= EVALUATION_FRACTION
    assert lines[-1]["wall_s"] == 400 + 3 * len(lines)
    assert {"peak_memory_mb", "iteration", "seconds", "splats", "psnr"} <= set(lines[-1])


def test_forecasts_are_noted_and_told(toy, tmp_path, clock):
    """Catches forecasts that cannot be checked afterwards, or that nobody sees."""
    told = []
    run = run_of(toy, lattice=0, iterations=200)
    train_run(toy, tmp_path, run, report=lambda progress: bool(told.append(progress)))
    lines = read_metrics(tmp_path)
    foretold = [line["iteration"] for line in lines if "forecast" in line]
    assert foretold == [80, 100, 120, 140, 160, 180]
    hit, checked = checked_forecasts(lines)
    assert 0 < hit <= checked == 6
    assert any("another" in progress.detail for progress in told)


def test_a_reached_target_ends_the_run(toy, tmp_path, monkeypatch):
    """Catches a target that is passed by or forgotten, or whose avatar an earlier one replaces."""
    values = iter([25.0, 29.0, 30.5, 30.5])
    monkeypatch.setattr(evaluator, "evaluate", scores(values))
    run = run_of(toy, lattice=0, target_psnr=30.0)
    train_run(toy, tmp_path, run)
    assert read_checkpoint(tmp_path).iteration == 30
    train_run(toy, tmp_path, run, resume=True)
    assert read_checkpoint(tmp_path).iteration == 30
    assert next(values, None) is None
    blurred = Quality(30.5, 0.5, detail_difference=0.2)
    found = iter([Quality(25.0, 0.5, detail_difference=0.1), blurred, blurred])
    monkeypatch.setattr(evaluator, "evaluate", lambda *arguments, **named: next(found))
    path = train_run(toy, tmp_path / "sharper", run).path
    end = read_checkpoint(tmp_path / "sharper")
    assert end.iteration == 20
    np.testing.assert_array_equal(read_avatar(path).splats.xyz, end.state.average.xyz)


@pytest.mark.parametrize("stop", [True, False])
def test_a_run_that_no_longer_improves(toy, tmp_path, monkeypatch, clock, stop):
    """Catches overfitting that nobody is told about, and a stop that nobody asked for."""
    falling = (30 - n / 10 for n in count())
    monkeypatch.setattr(evaluator, "evaluate", scores(falling))
    told = []
    run = run_of(toy, lattice=0, iterations=None, seconds=200.0, stop_when_flat=stop)
    train_run(toy, tmp_path, run, report=lambda progress: bool(told.append(progress.detail)))
    assert (read_checkpoint(tmp_path).iteration < 200) == stop
    if not stop:
        assert any(
            re.fullmatch(r"no gain since \d+ s: more time no longer helps", forecast_text)
            for forecast_text in told
        )


def test_images_grow_where_settings_say_so(toy, tmp_path, monkeypatch):
    """Catches coarse training that never ends, or whose camera does not fit its image."""
    seen = []
    step = session.Trainer.step

    def note(trainer, view, target, *rest):
        assert target.shape == (view.camera.height, view.camera.width, 3)
        seen.append(target.shape[:2])
        return step(trainer, view, target, *rest)

    monkeypatch.setattr(session.Trainer, "step", note)
    settings = {"iterations": 20, "scale": 0.5, "coarse_share": 0.25}
    train_run(toy, tmp_path / "small", run_of(toy, lattice=0, **settings))
    assert seen == [(30, 20)] * 20  # half of so few pixels shows too little
    seen.clear()
    monkeypatch.setattr(schedule, "MIN_COARSE_SIDE_PX", 10)
    train_run(toy, tmp_path / "large", run_of(toy, lattice=0, **settings))
    assert seen == [(15, 10)] * 5 + [(30, 20)] * 15
