"""The seam between the trainer and what holds the splats."""

import numpy as np
import pytest

from stga_addon.capture.images import read_image, read_mask
from stga_addon.training.optimize import make_backend, trainer
from stga_addon.training.optimize.backend import Backend
from stga_addon.training.optimize.trainer import Trainer

from .toys import bits, one_camera, quick_settings

METHODS = {name for name in vars(Backend) if name == "__len__" or not name.startswith("_")}


class Far:
    """A backend whose splats are elsewhere: what the seam has no method for is not there, columns
    are copies, and reading everything is forbidden."""

    def __init__(self, real):
        self.real = real

    def __getattr__(self, name):
        if name not in METHODS - {"state"}:
            raise AssertionError(f"{name} is asked for")
        return getattr(self.real, name)

    def __len__(self):
        return len(self.real)

    def columns(self, names, rows=None):
        found = {name: array.copy() for name, array in self.real.columns(names, rows).items()}
        for array in found.values():
            array.setflags(write=False)
        return found


def trained(capture):
    """Trained until every change of the splats had its turn."""
    changes = {"density_interval": 3, "density_span": (0.0, 1.0), "stray_reset_interval": 2}
    settings = quick_settings("global", lattice=1, stray_limit=0.05, growth=0.6, **changes)
    made = Trainer(capture, settings, {})
    assert set(made.hooks) == {"outliers", "density", "floaters", "outlines", "unseen sides"}
    made.iteration = 194
    for view in capture.views["train"] * 2:
        made.step(view, read_image(view), 0.5, read_mask(view))
    assert made.iteration >= 200
    return made


def test_a_training_needs_no_more_than_the_seam(toy, monkeypatch):
    """Catches a change of the splats that copies all of them to the host, writes to a column in
    place, or reaches past the seam, and so does nothing where splats are on a device."""
    capture = one_camera(toy)
    near = trained(capture)

    def far(*given):
        return Far(make_backend.make_backend(*given))

    monkeypatch.setattr(trainer, "make_backend", far)
    other = trained(capture)
    assert len(other) > 320
    np.testing.assert_equal(bits(near.state), bits(other._backend.real.state))
    with pytest.raises(AssertionError, match="state is asked for"):
        _ = other.state
