"""Views whose matte or image failed: left out of a training, and named."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from refusal import refusal
from training.toys import run_of

from stga_addon.capture import usable_views
from stga_addon.capture.open import open_capture
from stga_addon.capture.usable_views import with_usable_views
from stga_addon.training.run.session import train_run

from . import factory

SHAPE = factory.HEIGHT, factory.WIDTH


def with_mask(view, lit):
    mask = np.zeros(SHAPE, np.uint8)
    mask[:1, :lit] = 255
    Image.fromarray(mask).save(view.mask)
    return view


def with_transparency(view):
    """What is seen is as it was, but its transparency, which is the mask, is empty."""
    image = Image.open(view.image).convert("RGB")
    image.putalpha(0)
    image.save(view.image)
    return replace(view, mask=None)


def with_level(view, level):
    Image.fromarray(np.full((*SHAPE, 3), level, np.uint8)).save(view.image)
    return view


FAILURES = {
    "empty mask": (lambda view: with_mask(view, 0), "have an empty mask"),
    "speck": (lambda view: with_mask(view, 1), "have an empty mask"),
    "transparent": (with_transparency, "have an empty mask"),
    "black": (lambda view: with_level(view, 0), "are of one color"),
    "gray": (lambda view: with_level(view, 99), "are of one color"),
}


def failed(root, name, timesteps):
    """The capture, its views of some timesteps having failed."""
    capture = open_capture(root)
    views = {
        split: tuple(
            FAILURES[name][0](view) if view.timestep in timesteps else view for view in own
        )
        for split, own in capture.views.items()
    }
    return replace(capture, views=views)


@pytest.fixture
def root(tmp_path):
    return factory.write_mesh_capture(tmp_path / "capture", timesteps=(0, 1, 3, 4))


@pytest.mark.parametrize("is_long", [False, True])
@pytest.mark.parametrize("name", FAILURES)
def test_failed_views_are_left_out_and_named(name, is_long, root, monkeypatch):
    """Catches a head that is trained on, tracked by and scored against what shows nobody; also
    where only a few of many views are read."""
    if is_long:
        monkeypatch.setattr(usable_views, "MAX_VIEWS_READ", 4)
        monkeypatch.setattr(usable_views, "SAMPLED_VIEWS", 2)
    usable, told = with_usable_views(failed(root, name, {1}))
    assert {view.timestep for view in usable.all_views} == {0, 3, 4}
    assert len(usable.all_views) == 9
    assert len(told) == 1
    assert f"3 of 12 images {FAILURES[name][1]} (timestep 1)" in told[0]


def test_what_shows_the_head_stays(root):
    """Catches views that are left out although nothing is wrong with them."""
    capture = open_capture(root)
    assert with_usable_views(capture) == (capture, ())


@pytest.mark.parametrize("name", FAILURES)
def test_nothing_to_train_on_is_refused(name, root, tmp_path):
    """Catches a training on empty masks or black images that ends with "120 dB"."""
    capture = failed(root, name, {0, 1, 3, 4})
    with refusal("shows nobody in its training views"):
        train_run(capture, tmp_path / "run", run_of(capture))
    assert not (tmp_path / "run" / "run.json").exists()
