"""Views of one camera in which something covers the head for a while."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image

from stga_addon.avatar.file import read_avatar
from stga_addon.training.effects.plan import plan_effects
from stga_addon.training.run.folder import Run
from stga_addon.training.run.session import train_run
from stga_addon.training.settings import make_settings

from .scenes import SIZE, Scene, photograph

TIMESTEPS = 60
COVERED = range(20, 31)
"""Timesteps at which a hand is before the head: some between the 48 that are sampled."""
TURNED = np.radians(15) * np.sin(np.arange(TIMESTEPS) / 6)
DRIFT = 1 + 0.1 * np.sin(np.arange(TIMESTEPS)[:, None] / 5 + [0.0, 0.5, 2.0])


def with_hand(capture, timesteps, side=26):
    """The same after a square of skin, with a pattern, was put before the head's right half."""
    rng = np.random.default_rng(0)
    hand = np.clip(rng.normal((205, 150, 120), 12, (side, side, 3)), 0, 255).astype(np.uint8)
    at = slice(SIZE // 2 - side, SIZE // 2)
    for view in capture.views["train"]:
        if view.timestep in timesteps:
            image = np.array(Image.open(view.image))
            image[at, at] = hand
            Image.fromarray(image).save(view.image)
    return capture


def planned(capture, **choices):
    choices = {"strain-color": "off", "strain-position": "off", **choices}
    settings, plan = plan_effects(capture, make_settings(iterations=1, effects=choices))
    return settings, {decision.effect: decision for decision in plan}


@pytest.fixture(scope="module")
def turning():
    """Scene of a head that turns beside a window, before a camera whose exposure drifts."""
    return Scene(
        cameras=1, timesteps=TIMESTEPS, deformed=0.3, turned=TURNED, window=0.3, drift=DRIFT
    )


@pytest.fixture(scope="module")
def covered(turning, tmp_path_factory):
    return with_hand(photograph(tmp_path_factory.mktemp("hand"), turning), COVERED)


def test_views_with_a_hand_are_left_out(covered):
    """Catches views with a hand that are trained, also between the sampled ones; and views that
    are left out for nothing, beyond one on either side."""
    settings, plan = planned(covered)
    left_out = {timestep for _, timestep in settings.covered}
    assert plan["occlusions"].on
    assert left_out >= set(COVERED)
    assert left_out <= set(range(COVERED.start - 1, COVERED.stop + 1))
    assert f"{len(left_out)} of {TIMESTEPS} training views" in plan["occlusions"].reason
    assert planned(covered, occlusions="off")[0].covered == ()


def test_what_is_part_of_the_recording_stays(turning, tmp_path):
    """Catches views that are left out because the head turns in the light, the exposure drifts, or
    something small is on it."""
    capture = photograph(tmp_path, turning)
    assert not planned(capture)[1]["occlusions"].on
    assert not planned(with_hand(capture, COVERED, side=5))[1]["occlusions"].on


def test_other_effects_do_not_see_the_hand(covered):
    """Catches effects that are decided by views that are left out, such as an exposure that is
    fitted to a hand."""
    settings, plan = planned(covered)
    assert plan["exposure"].on
    fitted = {(int(row[0]), int(row[-1])) for row in settings.exposure}
    assert len(fitted) > 20
    assert not fitted & set(settings.covered)


def test_a_run_trains_without_them(covered, tmp_path):
    """Catches views that the plan leaves out and the training uses: it is the training of a capture
    that never had them."""
    settings = replace(planned(covered)[0], effects=None, iterations=40)
    rows = set(settings.covered)
    views = [v for v in covered.views["train"] if (v.camera_index, v.timestep) not in rows]
    without = replace(covered, views={"train": tuple(views)})
    splats = []
    for name, capture, left_out in (("all", covered, settings.covered), ("fewer", without, ())):
        run = Run(covered.root, None, "vhap", replace(settings, covered=left_out))
        splats.append(read_avatar(train_run(capture, tmp_path / name, run).path).splats)
    for name, values in vars(splats[0]).items():
        assert_array_equal(values, getattr(splats[1], name))
