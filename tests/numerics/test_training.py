"""Losses and the optimizer at the edge of float32, against their formulas in float64."""

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from training.test_losses import reference as loss_reference
from training.toys import random_splats

from stga_addon.raster.cpu.layout import Parameters
from stga_addon.raster.cpu.optimizer import scale_limit
from stga_addon.training.optimize import adam
from stga_addon.training.optimize.image_loss import image_gradient, whole_image
from stga_addon.training.optimize.state import new_state

HEIGHT = 30
WIDTH = 33
RATE = dict.fromkeys((*Parameters._fields, "sh_rest"), 1e-3)


def image_of(kind, value):
    rng = default_rng(0)
    noise = rng.random((3, HEIGHT, WIDTH))
    if kind == "constant":
        noise = np.ones_like(noise)
    if kind == "nearly constant":
        noise = 1 + 1e-3 * noise
    if kind == "sparks":
        noise = (noise < 0.01).astype(float)
    return (value * noise).astype(np.float32)


def loss_of(image, target):
    """Gradient and SSIM, and those of the float64 reference."""
    out = np.full_like(image, np.nan)
    _, ssim = image_gradient(image, target, whole_image(HEIGHT, WIDTH), 0.2, out)
    assert np.isfinite(out).all()
    gradient, _, similar = loss_reference(image, target, 0.2)
    return out, ssim, gradient, float(similar.mean())


EXTREMES = [(kind, value) for kind in ("noise", "sparks") for value in (0.0, 1.0, 10.0, 1e4, 1e8)]
EXTREMES += [("constant", value) for value in (0.0, 1.0, 10.0)]


@pytest.mark.parametrize(("kind", "value"), EXTREMES)
def test_loss_of_extreme_images(kind, value):
    """Catches overflow of the product of two variances, and 0/0 where image or target does not
    vary.

    Harmonics of 1e4 do make images of 1e4. The target is noise: where both are constant SSIM is
    flat, and what is left of its gradient is rounding
    (`training/test_losses.py::test_constant_images`).
    """
    target = default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    found, ssim, expected, similar = loss_of(image_of(kind, value), target)
    assert np.abs(found - expected).max() < 5e-4 * np.abs(expected).max()
    assert abs(ssim - similar) < 1e-4


@pytest.mark.parametrize("value", [1.0, 2.0, 10.0, 100.0, 1e4, 1e8, 1e15, 1e18])
@pytest.mark.parametrize("kind", ["constant", "nearly constant", "noise", "sparks"])
def test_loss_never_runs_away(kind, value):
    """Catches a variance that rounding makes negative, which turns SSIM's gradient round and
    inflates it, and NaN.

    An image is training's to change, so what counts is that every pixel is pulled towards the
    target no harder than the loss can: by about one per pixel from L1 and a few more from SSIM.
    """
    image = image_of(kind, value)
    target = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    found, ssim, expected, _ = loss_of(image, target)
    assert -1 <= ssim <= 1 + 1e-5
    assert np.abs(found).max() < 3 * max(1 / image.size, np.abs(expected).max())


def test_limit_of_one_enormous_splat():
    """Catches squares that overflow: the other rows' gradients must stay what the formula says."""
    log_scale = np.log(np.float32([[1, 1, 1], [2, 2, 2], [1e15, 1, 1]]))
    rows = np.arange(3, dtype=np.int32)
    face = np.zeros(3, np.int32)
    unbound = np.zeros(3, bool)
    gradient = np.zeros((3, 3), np.float32)
    norm = scale_limit(rows, log_scale, face, unbound, np.float32([[0.5], [0.5]]), 1.0, gradient)
    scale = np.exp(log_scale.astype(np.float64))
    expected = np.linalg.norm(scale - 0.5)
    assert norm == pytest.approx(expected, rel=1e-6)
    assert_allclose(gradient, (scale - 0.5) / expected * scale, rtol=1e-5)


def float64_adam(gradients, steps=0):
    """Total movement, in units of the rate, after each gradient of one entry's history."""
    mean = square = moved = 0.0
    path = []
    for n, g in enumerate(gradients.astype(np.float64), steps + 1):
        mean = 0.9 * mean + 0.1 * g
        square = 0.999 * square + 0.001 * g * g
        moved -= (mean / (1 - 0.9**n)) / (np.sqrt(square / (1 - 0.999**n)) + 1e-15)
        path.append(moved)
    return np.array(path)


def adam_path(gradients, steps=0):
    """The same for the opacity of one of three rows, by the kernel; the other two have gradients of
    one."""
    state = new_state(random_splats(3, 3))
    state.steps[1] = steps
    state.parameters.opacity[:] = 0
    for array in state.gradients:
        array.fill(1)
    path = []
    for g in gradients:
        state.gradients.opacity[1] = float(g)
        adam.step(state, np.arange(3, dtype=np.int32), RATE | {"opacity": 1.0})
        path.append(float(state.parameters.opacity[1]))
    for name, value in state.parameters._asdict().items():
        assert np.isfinite(value).all(), name
    return np.array(path)


def histories():
    """Gradients, steps before them, and a tolerance in units of the rate."""
    noise = default_rng(2).normal(size=40)
    # Where squares are subnormal, only their order of magnitude is left, beside an ε that outweighs
    # them.
    sizes = (1e-8, 1e-12, 1e-15, 1e-17, 1e-20, 1e-25, 1e-38, 0.0)
    found = {f"size {size}": (size * noise, 0, 1e-3 if size == 1e-20 else 1e-4) for size in sizes}
    for spike in (1e8, 1e15, 1e17):
        found[f"spike of {spike}"] = np.where(np.arange(40) == 10, spike, noise), 0, 1e-4
    for steps in (0, 1, 10_000, 10_000_000, 2**31 - 50):
        found[f"after {steps} steps"] = noise, steps, 1e-4
    return found


@pytest.mark.parametrize("history", histories())
def test_adam_is_float64s(history):
    """Catches 0/0 once the square underflows (below 1e-19 it is zero), and an ε in the wrong place
    (second moments of 1e-30 and less: there ε = 1e-15 decides, and the step tends to nothing); a
    spike that overflows the second moment (it moves by a few rates and is forgotten); and 1 − β^n
    that cancels at the first steps or overflows a count at the last."""
    gradients, steps, tolerance = histories()[history]
    found = adam_path(gradients, steps)
    expected = float64_adam(gradients, steps)
    assert_allclose(found, expected, atol=tolerance, rtol=1e-5 if steps else 1e-7)


@pytest.mark.parametrize("spike", [1e20, 1e30, -3e38])
def test_adam_after_a_spike_whose_square_overflows(spike):
    """Catches a second moment of infinity: from that step on the row is NaN.

    Such a gradient counts as broken, like NaN: the row keeps its value and moments for that step.
    """
    gradients = default_rng(3).normal(size=40)
    gradients[10] = spike
    path = adam_path(gradients)
    assert path[10] == path[9]
    assert np.abs(np.diff(path[10:])).min() > 1e-4
