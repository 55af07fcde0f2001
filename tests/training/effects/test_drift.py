"""Exposure of a camera that drifts while it records, as a phone's does."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.avatar.file import read_avatar
from stga_addon.training.effects.evidence import fit_turning_light
from stga_addon.training.effects.plan import plan_effects
from stga_addon.training.evaluate.metrics import evaluate_avatar
from stga_addon.training.optimize.image_preparation import view_exposure
from stga_addon.training.run.folder import Run
from stga_addon.training.run.session import train_run
from stga_addon.training.settings import make_settings

from .scenes import Scene, photograph

TIMESTEPS = 24
LEFT_OUT = (3, 8, 14, 19)
PHASES = np.array([0.0, 0.5, 2.0])
DRIFT = 1 + 0.12 * np.sin(np.arange(TIMESTEPS)[:, None] / 5 + PHASES)


def recorded(folder, drift, **scene):
    """One camera; some timesteps are left out of the training."""
    capture = photograph(folder, Scene(cameras=1, timesteps=TIMESTEPS, drift=drift, **scene))
    views = {"train": [], "val": []}
    for view in capture.views["train"]:
        views["val" if view.timestep in LEFT_OUT else "train"].append(view)
    return replace(capture, views=views)


def planned(capture, iterations=1, **choices):
    settings, plan = plan_effects(capture, make_settings(iterations=iterations, effects=choices))
    return settings, next(decision for decision in plan if decision.effect == "exposure")


@pytest.fixture(scope="module")
def drifting(tmp_path_factory):
    return recorded(tmp_path_factory.mktemp("drift"), DRIFT)


def test_drift_is_found(drifting):
    """Catches drift that is not seen, or wrong at the timesteps in between by more than 1 %."""
    settings, decision = planned(drifting)
    assert decision.on
    assert "over time" in decision.reason
    exposure = view_exposure(settings.exposure)
    views = [*drifting.views["train"], *drifting.views["val"]]
    found = np.array([exposure(view)[0] for view in views])
    truth = DRIFT[[view.timestep for view in views]]
    assert_allclose(found / found.mean(0), truth / truth.mean(0), atol=0.012)
    assert (exposure(replace(views[0], timestep=-5)) == exposure(views[0])).all()
    assert exposure(replace(views[0], camera_index=1)) is None


def test_images_in_no_order_do_not_drift(tmp_path_factory):
    """Catches gains interpolated between images that have nothing to do with each other."""
    shuffled = np.random.default_rng(1).permutation(DRIFT)
    for drift in (shuffled, None):
        decision = planned(recorded(tmp_path_factory.mktemp("no_drift"), drift))[1]
        assert not decision.on, decision.reason


def test_a_head_that_turns_in_window_light_does_not_drift(tmp_path):
    """Catches the light on a head that turns by 25° taken for the camera's exposure, and a drift
    that is no longer found, or wrong by more than the light's, where the head turns as well."""
    turned = np.radians(25) * np.sin(np.arange(TIMESTEPS) / 3)
    lit = {"turned": turned, "window": 0.3, "deformed": 0.3}
    decision = planned(recorded(tmp_path, None, **lit))[1]
    assert not decision.on, decision.reason
    capture = recorded(tmp_path, DRIFT, **lit)
    settings, decision = planned(capture)
    assert decision.on, decision.reason
    exposure = view_exposure(settings.exposure)
    found = np.array([exposure(view)[0] for view in capture.views["train"]])
    truth = DRIFT[[view.timestep for view in capture.views["train"]]]
    assert_allclose(found / found.mean(0), truth / truth.mean(0), atol=0.09)


def test_timesteps_that_are_left_out_look_like_the_recording(drifting, tmp_path):
    """Catches drift averaged into the avatar, or not given to renderings of other timesteps."""
    psnr = {}
    for choice in ("on", "off"):
        settings, _ = planned(drifting, iterations=60, exposure=choice)
        run = Run(drifting.root, None, "vhap", replace(settings, effects=None))
        avatar = train_run(drifting, tmp_path / choice, run).path
        quality = evaluate_avatar(read_avatar(avatar), drifting, "val")
        assert quality.psnr_unmatched is None
        psnr[choice] = quality.psnr
    assert psnr["on"] > psnr["off"] + 1.5


def test_light_of_a_head_that_is_never_seen_twice():
    """Catches a warning, or a light that is not a number, where nothing can be compared."""
    rest = np.tile([0.0, 0.0, 1.0], (5, 1))
    color = np.full((3, 5, 3), np.nan)
    samples = SimpleNamespace(signals={"normal": np.zeros((3, 5, 3), np.float32)})
    for shown in (color, np.where(np.eye(3, 5)[..., None] > 0, 100.0, color)):
        with np.errstate(all="raise"):
            assert_array_equal(fit_turning_light(samples, shown, rest), 1.0)
