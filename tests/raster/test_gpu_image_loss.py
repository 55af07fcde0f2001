"""The image loss on a WebGPU device against the CPU's, in value and gradient."""

import numpy as np
import pytest

from raster import gpu_device
from stga_addon.raster.cpu.image_loss import LOSS_REACH_PX, change_background
from stga_addon.raster.cpu.layout import TILE
from stga_addon.raster.cpu.rasterize import tile_grid
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.image_loss import image_loss, upload_target
from stga_addon.raster.gpu.layout import VIEW
from stga_addon.training.optimize.losses import image_gradient, tile_rectangles, whole_image

pytestmark = pytest.mark.needs("adapter")

SIZES = [(100, 70), (1, 1), (1, 40), (40, 1), (17, 33), (32, 16), (9, 11)]
SSIM_WEIGHT = 0.2


@pytest.fixture(scope="module")
def device() -> Device:
    return gpu_device.device()


def on_device(
    device: Device, image: np.ndarray, target: np.ndarray, touched: np.ndarray, **options
) -> tuple[np.ndarray, float]:
    """Gradient (3, H, W), filled with 77 before, and loss; touched (rows, columns) of tiles."""
    _, height, width = image.shape
    view = np.zeros(1, VIEW)
    view["width"], view["height"], (view["tiles_x"], view["tiles_y"]) = (
        width,
        height,
        tile_grid(width, height),
    )
    upload_target(device, target, SSIM_WEIGHT, **options)
    device.upload("v_image", np.full_like(image, 77))
    with device.record() as work:
        v_image, loss = image_loss(
            work, width, height, view=device.upload("view", view, "uniform"), image=device.upload("image", image),
            touched=device.upload("touched", touched.astype(np.uint32)), whole=bool(touched.all()),
        )  # fmt: skip
    return device.read(v_image, image.shape), float(device.read(loss, (1,))[0])


def pictures(width: int, height: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """A smooth image with noise, and bytes that resemble it."""
    rng = np.random.default_rng(seed)
    smooth = 0.5 + 0.4 * np.sin(np.linspace(0, 9, width) + np.linspace(0, 5, height)[:, None])
    image = np.stack([smooth, 1 - smooth, smooth**2]) + rng.normal(0, 0.05, (3, height, width))
    target = np.clip(255 * (image + rng.normal(0, 0.1, image.shape)), 0, 255).transpose(1, 2, 0)
    return image.astype(np.float32), np.ascontiguousarray(target, np.uint8)


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("kind", ["noise", "bright and flat", "equal"])
def test_loss_and_gradient_are_the_cpus(device: Device, size: tuple[int, int], kind: str) -> None:
    """Catches a window, a padding, a byte of the target or a sign that differs, and a tile left out
    of the sum."""
    image, target = pictures(*size)
    if kind == "bright and flat":
        image, target = np.full_like(image, 0.999), np.full_like(target, 255)
        image[:, 20:30, 40:60] = 0.5
    if kind == "equal":
        image = np.ascontiguousarray(
            (target.astype(np.float32) * np.float32(1 / 255)).transpose(2, 0, 1)
        )
    expected = np.empty_like(image)
    l1, ssim = image_gradient(image, target, whole_image(*image.shape[1:]), SSIM_WEIGHT, expected)
    gradient, loss = on_device(device, image, target, np.ones(tile_grid(*size)[::-1], bool))
    # In flat regions both lose digits to the same cancellation, each in its own order of summation.
    tolerance = 2e-5 if kind == "noise" else 5e-4
    np.testing.assert_allclose(
        gradient, expected, atol=tolerance * max(np.abs(expected).max(), 0.1 / image.size)
    )
    assert loss == pytest.approx(
        (1 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1 - ssim), rel=1e-5, abs=tolerance / 10
    )


def test_touched_tiles_have_the_whole_images_gradient(device: Device) -> None:
    """Catches pixels read that a local iteration does not render (they hold NaN), and gradients
    written elsewhere."""
    image, target = pictures(100, 70)
    touched = np.zeros((5, 7), bool)
    touched[1, 2], touched[2, 3], touched[4, 6] = True, True, True
    whole, _ = on_device(device, image, target, np.ones_like(touched))
    pixels = np.kron(touched, np.ones((TILE, TILE), bool))[:70, :100]
    near = pixels.copy()
    for y, x in np.argwhere(pixels):
        near[
            max(0, y - LOSS_REACH_PX) : y + LOSS_REACH_PX + 1,
            max(0, x - LOSS_REACH_PX) : x + LOSS_REACH_PX + 1,
        ] = True
    gradient, _ = on_device(device, np.where(near, image, np.nan), target, touched)
    np.testing.assert_array_equal(gradient[:, pixels], whole[:, pixels])
    assert (gradient[:, ~pixels] == 77).all()
    expected = np.empty_like(image)
    image_gradient(image, target, tile_rectangles(touched, 70, 100), SSIM_WEIGHT, expected)
    np.testing.assert_allclose(
        gradient[:, pixels], expected[:, pixels], atol=2e-5 * np.abs(whole).max()
    )


@pytest.mark.parametrize("size", [(64, 48), (33, 17)], ids=str)
def test_target_over_another_background_is_the_cpus(device: Device, size: tuple[int, int]) -> None:
    """Catches another rounding, clamp or byte of the mask; a channel's color given to another."""
    image, target = pictures(*size)
    mask = np.random.default_rng(3).integers(0, 256, target.shape[:2], np.uint8)
    before, after = 255 * np.float32([1, 0.9, 0.8]), 255 * np.float32([0.13, 0.82, 0.43])
    # Where the mixture lies between two bytes, either may be taken: leave those pixels as they are.
    exact = target + (1 - mask[..., None] / 255) * (after - before).astype(float)
    mask[(np.abs(exact % 1 - 0.5) < 1e-3).any(-1)] = 255
    changed = np.empty_like(target)
    change_background(target, mask, before, after, changed)
    everywhere = np.ones(tile_grid(*size)[::-1], bool)
    expected = on_device(device, image, changed, everywhere)
    gradient, loss = on_device(device, image, target, everywhere, mask=mask, change=after - before)
    np.testing.assert_array_equal(gradient, expected[0])
    assert loss == expected[1]
    assert not np.array_equal(gradient, on_device(device, image, target, everywhere)[0])


@pytest.mark.parametrize("scale", [1e4, 1e8, 1e15, 1e18])
def test_extreme_images_stay_bounded(device: Device, scale: float) -> None:
    """Catches variances that become negative or overflow, whose gradient is NaN or enormous."""
    image, target = pictures(40, 30)
    gradient, _ = on_device(device, np.float32(scale) * image, target, np.ones((2, 3), bool))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() < 10 / image.size
