"""Views whose matte or image failed: left out of a training, and named."""

from dataclasses import replace
from functools import partial

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


def with_mask(view, is_failed, lit=0, suffix=".png"):
    mask = np.asarray(Image.open(view.mask)).copy()
    if is_failed:
        mask[:] = 0
        mask[:1, :lit] = 255
    path = view.mask.with_suffix(suffix)
    Image.fromarray(mask).save(path)
    return replace(view, mask=path)


def with_other(view, is_failed, change):
    mask = np.asarray(Image.open(view.mask)).copy()
    path = view.mask.with_suffix(".other.png")
    Image.fromarray(change(mask) if is_failed else mask).save(path)
    return replace(view, mask=path)


def half(mask):
    mask[:] = 0
    mask[:, : mask.shape[1] // 2] = 255
    return mask


def noise(high, seed=0):
    """A mask of 0 and `high` at random."""
    return lambda mask: np.random.default_rng(seed).integers(0, 2, mask.shape, np.uint8) * high


def with_transparency(view, is_failed, level=None):
    """Transparency as the mask: empty where it has failed, or behind an image of one level."""
    pixels = np.asarray(Image.open(view.image).convert("RGB")).copy()
    matte = np.asarray(Image.open(view.mask)).copy()
    matte[:, :1] = 200  # a soft edge
    if is_failed and level is None:
        matte[:] = 0
    elif is_failed:
        pixels[:] = level
    Image.fromarray(np.dstack([pixels, matte])).save(view.image)
    return replace(view, mask=None)


def with_level(view, is_failed, level, noise=0, suffix=".png"):
    pixels = np.asarray(Image.open(view.image))
    if is_failed:
        added = np.random.default_rng(view.camera_index).integers(0, noise + 1, (*SHAPE, 1))
        pixels = np.broadcast_to(level + added, (*SHAPE, 3)).astype(np.uint8)
    path = view.image.with_suffix(suffix)
    Image.fromarray(pixels).save(path)
    return replace(view, image=path)


EMPTY = "have an empty mask"
NOISE = "have a mask of noise"
FULL = "have a full or inverted mask"
PLAIN = "are of one color"
FAILURES = {
    "empty mask": (with_mask, EMPTY),
    "speck": (partial(with_mask, lit=1), EMPTY),
    "uncompressed mask": (partial(with_mask, suffix=".bmp"), EMPTY),
    "transparent": (with_transparency, EMPTY),
    "noise of labels": (partial(with_other, change=noise(np.uint8(1))), NOISE),
    "noise of a matte": (partial(with_other, change=noise(np.uint8(255))), NOISE),
    "half transparent": (
        partial(with_other, change=lambda mask: 0 * mask + 128 + mask // 255),
        NOISE,
    ),
    "full": (partial(with_other, change=lambda mask: 0 * mask + 255), FULL),
    "inverted": (partial(with_other, change=lambda mask: 255 - mask), FULL),
    "half": (partial(with_other, change=half), FULL),
    "black": (partial(with_level, level=0), PLAIN),
    "noise": (partial(with_level, level=0, noise=4), PLAIN),
    "gray": (partial(with_level, level=99), PLAIN),
    "uncompressed": (partial(with_level, level=0, suffix=".bmp"), PLAIN),
    "black in its matte": (partial(with_transparency, level=0), PLAIN),
}


def failed(root, name, timesteps):
    """The capture, its views of some timesteps having failed."""
    capture = open_capture(root)
    change = FAILURES[name][0]
    views = {
        split: tuple(change(view, view.timestep in timesteps) for view in own)
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
        monkeypatch.setattr(usable_views, "SAMPLED_VIEWS", 1)
    usable, told = with_usable_views(failed(root, name, {1}))
    assert {view.timestep for view in usable.all_views} == {0, 3, 4}
    assert len(usable.all_views) == 9
    assert len(told) == 1
    assert f"3 of 12 images {FAILURES[name][1]} (timestep 1)" in told[0]


def test_what_shows_the_head_stays(root):
    """Catches views that are left out although nothing is wrong with them."""
    capture = open_capture(root)
    assert with_usable_views(capture) == (capture, ())


@pytest.mark.parametrize("name", [name for name in FAILURES if FAILURES[name][1] != FULL])
def test_nothing_to_train_on_is_refused(name, root, tmp_path):
    """Catches a training on empty masks or black images that ends with "120 dB"."""
    capture = failed(root, name, {0, 1, 3, 4})
    with refusal("shows nobody in its training views"):
        train_run(capture, tmp_path / "run", run_of(capture))
    assert not (tmp_path / "run" / "run.json").exists()
