"""Preset timing."""

from dataclasses import replace

import pytest
from refusal import refusal

from stga_addon.training import preset_timing, schedule
from stga_addon.training.optimize.trainer import Trainer
from stga_addon.training.preset_timing import (
    WARM_UP_ITERATIONS,
    seconds_per_iteration,
    time_presets,
)
from stga_addon.training.settings import PRESETS, Preset, make_settings

from .toys import one_camera


class Stopwatch:
    """A clock that only steps of training move: by 0.01 s a thousand pixels."""

    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def shares(monkeypatch):
    """Fractions of the budget that the steps were made at."""
    watch = Stopwatch()
    seen = []

    class Trainer:
        """Its state is the number of its splats, of which a turn adds 500, up to 2,000."""

        state = 1000
        once_s = 0.0

        def __init__(self, *_, **__):
            self.hooks = {}

        def prepare_hooks(self):
            watch.now += self.once_s

        def step(self, view, image, share, mask, mesh):
            assert not image.flags.writeable
            assert image.shape[:2] == mask.shape == (view.camera.height, view.camera.width)
            watch.now += 0.01 * image.shape[0] * image.shape[1] / 1000 * self.state / 1000
            if self.hooks["density"].interval == 1:
                watch.now += 0.5
                self.state = min(2000, self.state + 500)
            else:
                seen.append(share)

    monkeypatch.setattr(preset_timing, "perf_counter", watch)
    monkeypatch.setattr(preset_timing, "Trainer", Trainer)
    monkeypatch.setattr(schedule, "MIN_COARSE_SIDE_PX", 0)
    return seen


def test_the_mean_over_the_whole_course(toy, shares):
    """Catches a calibration of the cheap beginning only, with images of half the size."""
    settings = make_settings(iterations=100, coarse_share=1 / 3)
    pace = seconds_per_iteration(toy, settings, 100, 2.4)
    assert pace == pytest.approx(0.006 / 3 + 0.024 * 2 / 3, rel=0.05)
    assert shares[: WARM_UP_ITERATIONS + 1] == [0.0] * (WARM_UP_ITERATIONS + 1)
    assert shares == sorted(shares)
    assert 0.97 < shares[-1] < 1


def test_splats_grow_as_in_the_whole_run(toy, shares):
    """Catches a pace of the first, few splats (a half of the real one), and one that counts each
    split of the short run as the whole run has it more seldom."""
    settings = make_settings(
        iterations=1000, coarse_share=0, density_interval=100, density_span=(0.1, 0.6)
    )
    pace = seconds_per_iteration(toy, settings, 1000, 6.0)
    # 1000, from 0.1 on 1500, from 0.2 on 2000
    steps = 0.024 * (0.1 * 1 + 0.1 * 1.5 + 0.8 * 2)
    assert pace == pytest.approx(steps + 5 / 1000 * 0.5, rel=0.05)


def test_timings_of_all_presets(toy, shares):
    """Catches presets out of order, a capture's length ignored, and a wait for no views."""
    timings = [*time_presets(toy, seconds=0.1)]
    assert [timing.preset for timing in timings] == list(PRESETS)
    assert [timing.seconds for timing in timings] == sorted(timing.seconds for timing in timings)
    pace = 0.35 * 0.006 + 0.65 * 0.024  # 35 % at half size
    few = PRESETS["standard"].iterations * pace  # splats twice as many as at first, ten splits
    assert few < timings[1].seconds < 1.1 * (2 * few + 10 * 0.5)
    with refusal("has no training views"):
        next(time_presets(replace(toy, views={})))


def test_iterations_grow_with_the_capture():
    """Catches a thousand frames that are never seen, and a preset of no settings."""
    preset = Preset("", 1000, 0.5, {})
    assert (preset.iterations_for(10), preset.iterations_for(5001)) == (1000, 2501)
    for name in PRESETS:
        changed = make_settings(preset=name, seconds=1.0, lattice=3)
        assert (changed.preset, changed.lattice) == (name, 3)


def test_what_is_done_once_is_no_step(toy, shares, monkeypatch):
    """Catches the search for outlines and unseen sides, which comes before, in an iteration, and
    presets without the time in which the avatar tracks its head."""
    settings = make_settings(iterations=1000, coarse_share=0, density_interval=0)
    before = seconds_per_iteration(toy, settings, 1000, 2.4)
    monkeypatch.setattr(preset_timing.Trainer, "once_s", 5.0)
    assert seconds_per_iteration(toy, settings, 1000, 2.4) == pytest.approx(before)
    asked = []

    def track(*arguments):
        some = arguments[2]
        note = arguments[4]
        for number in range(len(some)):
            note(number, len(some))
            preset_timing.perf_counter.now += 0.3 if number else 0.1
        asked.append(len(some))

    trainer = preset_timing.Trainer
    monkeypatch.setattr(trainer, "capture", toy, raising=False)
    monkeypatch.setattr(trainer, "avatar", lambda *_: None, raising=False)
    monkeypatch.setattr(preset_timing, "track_by_avatar", track)
    tracked = seconds_per_iteration(toy, replace(settings, tracking=True), 1000, 2.4)
    # three timesteps to train on, and one that is not
    assert tracked == pytest.approx(before + 4 * 0.3 / 1000)
    assert asked == [3]
    timed = replace(settings, tracking=True, iterations=None, seconds=60.0)
    assert seconds_per_iteration(toy, timed, 1000, 2.4) == pytest.approx(before)


def test_one_phones_sides_are_found_before_they_are_timed(toy):
    """Catches one-off work that a trainer would still do in a step."""
    settings = make_settings(iterations=1, hull_points=False, lattice=0)
    trainer = Trainer(one_camera(toy), settings, {})
    trainer.prepare_hooks()
    assert "outlines" in vars(trainer.hooks["outlines"])
    assert "sides" in vars(trainer.frames)
