"""The fused image loss against its formula in float64 torch, and the rectangles it works in."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from raster.reference import image_loss

from stga_addon.raster.cpu.image_loss import LOSS_REACH_PX
from stga_addon.raster.cpu.layout import TILE
from stga_addon.training.optimize.image_loss import (
    image_gradient,
    mean_ssim,
    tile_rectangles,
    whole_image,
)

# float32 variances (differences of blurred squares) over C2 = 9e-4: about 1e-7 / 9e-4, times a few.
TOLERANCE = 5e-4
SIZES = [(1, 1), (1, 9), (9, 1), (2, 3), (5, 5), (11, 11), (16, 17), (23, 40), (64, 31)]


def random_pair(height, width, seed=0):
    """A smooth image with noise, and a target like it, so that SSIM lies between 0 and 1."""
    rng = np.random.default_rng([seed, height, width])
    rows, columns = np.mgrid[:height, :width]
    base = 0.5 + 0.4 * np.sin(rows / 3 + np.arange(3)[:, None, None]) * np.cos(columns / 4)
    image = (base + rng.normal(0, 0.1, base.shape)).astype(np.float32)
    target = np.clip(255 * (base + rng.normal(0, 0.05, base.shape)), 0, 255).astype(np.uint8)
    return image, np.ascontiguousarray(target.transpose(1, 2, 0))


def reference(image, target, weight):
    """Gradient (3, H, W), |difference| and SSIM maps, in float64 by autograd."""
    x = torch.tensor(image, dtype=torch.float64, requires_grad=True)
    # The 8-bit value as the float32 it is compared as, so that equal pixels are equal here too.
    y = torch.tensor(target * np.float32(1 / 255), dtype=torch.float64).permute(2, 0, 1)
    absolute, ssim = image_loss(x, y)
    ((1 - weight) * absolute.mean() + weight * (1 - ssim.mean())).backward()
    return x.grad.numpy(), absolute.detach(), ssim.detach()


def assert_same_gradient(gradient, expected):
    assert np.abs(gradient - expected).max() <= TOLERANCE * np.abs(expected).max()


@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_gradient_and_values(height, width, weight):
    """Catches a wrong window, padding, constant or derivative, lost rows, small images."""
    image, target = random_pair(height, width)
    out = np.full_like(image, np.nan)
    l1, ssim = image_gradient(image, target, whole_image(height, width), weight, out)
    expected, absolute, similar = reference(image, target, weight)
    assert_same_gradient(out, expected)
    assert l1 == pytest.approx(float(absolute.mean()), rel=1e-5)
    assert ssim == pytest.approx(float(similar.mean()), abs=1e-4)
    assert mean_ssim(image, target) == pytest.approx(ssim, abs=1e-7)


@pytest.mark.parametrize("value", [0, 128, 255])
def test_constant_images(value):
    """Catches 0/0 and a negative variance, and a sign for pixels that already agree."""
    target = np.full((20, 25, 3), value, np.uint8)
    same = np.full((3, 20, 25), np.float32(value) * np.float32(1 / 255), np.float32)
    out = np.empty_like(same)
    l1, ssim = image_gradient(same, target, whole_image(20, 25), 0.2, out)
    assert l1 == 0
    assert ssim == pytest.approx(1, abs=1e-4)
    assert np.abs(out).max() <= 1e-6
    other = np.full_like(same, 0.3)
    image_gradient(other, target, whole_image(20, 25), 0.2, out)
    assert_same_gradient(out, reference(other, target, 0.2)[0])


RECTANGLES = {
    "inner": [[30, 25, 47, 40]],
    "corners": [[0, 0, 16, 16], [64, 48, 71, 59]],
    "one pixel": [[35, 30, 36, 31]],
    "overlapping": [[10, 10, 40, 30], [20, 20, 50, 45]],
    "left edge and a column": [[0, 20, 8, 59], [40, 0, 41, 59]],
}


@pytest.mark.parametrize("name", RECTANGLES)
def test_rectangles_have_the_whole_images_gradient(name):
    """Catches pixels read beyond LOSS_REACH_PX (they are NaN), and written outside."""
    image, target = random_pair(59, 71, seed=1)
    rectangles = np.array(RECTANGLES[name], np.int64)
    expected, absolute, ssim = reference(image, target, 0.2)
    inside = np.zeros((59, 71), bool)
    near = np.zeros((59, 71), bool)
    for x0, y0, x1, y1 in rectangles:
        inside[y0:y1, x0:x1] = True
        near[
            max(0, y0 - LOSS_REACH_PX) : y1 + LOSS_REACH_PX,
            max(0, x0 - LOSS_REACH_PX) : x1 + LOSS_REACH_PX,
        ] = True
    assert not near.all()
    partial = np.where(near, image, np.float32(np.nan))
    out = np.full_like(image, 7.0)
    l1, similar = image_gradient(partial, target, rectangles, 0.2, out)
    assert np.abs(out - expected)[:, inside].max() <= TOLERANCE * np.abs(expected).max()
    assert_array_equal(out[:, ~inside], 7.0)
    sums = [(absolute[:, b:d, a:c].sum(), ssim[:, b:d, a:c].sum()) for a, b, c, d in rectangles]
    assert_allclose([l1, similar], np.sum(sums, axis=0) / image.size, rtol=1e-4)


def test_bands_do_not_change_a_bit():
    """Catches a run that goes another way on another number of threads, and so bands, a pixel that
    two bands or none cover, and an empty band."""
    image, target = random_pair(75, 110, seed=2)
    whole = np.empty_like(image)
    cut = np.empty_like(image)
    losses = image_gradient(image, target, whole_image(75, 110, 1), 0.2, whole)
    assert len(whole_image(75, 110, 100)) == 75
    for bands in (2, 5, 16, 100):
        assert image_gradient(image, target, whole_image(75, 110, bands), 0.2, cut) == losses
        assert_array_equal(cut, whole)


def test_sums_are_added_up_in_one_order():
    """Catches a sum whose order LLVM chooses: it was another after another compilation, and where
    LLVM feared that arrays overlap, with other addresses."""
    image, target = random_pair(37, 802, seed=3)
    rows = np.abs(image - np.moveaxis(target, 2, 0) * np.float32(1 / 255))
    while rows.shape[2] > 1:
        half = -(-rows.shape[2] // 2)
        rows[:, :, : rows.shape[2] - half] += rows[:, :, half:]
        rows = rows[:, :, :half]
    l1, _ = image_gradient(image, target, whole_image(37, 802), 0.2, np.empty_like(image))
    assert l1 == np.add.accumulate(rows.ravel(), dtype=np.float64)[-1] * (1 / image.size)


@pytest.mark.parametrize("share", [0.02, 0.2, 0.6, 1.0])
@pytest.mark.parametrize("seed", range(5))
def test_tile_rectangles_cover_the_marked_tiles(share, seed):
    """Catches tiles left out, swapped axes, and rectangles that reach over the image's edge."""
    rng = np.random.default_rng(seed)
    height, width = rng.integers(1, 120, 2) if seed < 3 else rng.integers(300, 600, 2)
    tiles = rng.random((-(-height // TILE), -(-width // TILE))) < share
    pixels = np.repeat(np.repeat(tiles, TILE, 0), TILE, 1)[:height, :width]
    covered = np.zeros((height, width), bool)
    rectangles = tile_rectangles(tiles, height, width)
    assert rectangles.shape == (len(rectangles), 4)
    for x0, y0, x1, y1 in rectangles:
        assert 0 <= x0 < x1 <= width
        assert 0 <= y0 < y1 <= height
        assert pixels[y0:y1, x0:x1].any()
        covered[y0:y1, x0:x1] = True
    assert covered[pixels].all()


def test_separate_tiles_get_separate_rectangles():
    """Catches one box around everything, which costs the whole image; touching tiles split."""
    tiles = np.zeros((6, 8), bool)
    tiles[0, 0] = tiles[1, 1] = tiles[5, 7] = True
    found = {tuple(r) for r in tile_rectangles(tiles, 90, 125).tolist()}
    assert found == {(0, 0, 32, 32), (112, 80, 125, 90)}
    assert tile_rectangles(np.zeros((6, 8), bool), 90, 125).shape == (0, 4)
