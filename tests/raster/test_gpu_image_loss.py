"""The image loss on a WebGPU device against the CPU's, in value and gradient."""

import numpy as np
import pytest

from raster import gpu_device
from stga_addon.raster.cpu.rasterize import tile_grid
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.image_loss import image_loss, upload_target
from stga_addon.raster.gpu.layout import VIEW
from stga_addon.training.optimize.losses import image_gradient, whole_image

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
            work, width, height, view=device.upload("view", view, "uniform"),
            image=device.upload("image", image),
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


@pytest.mark.parametrize("scale", [1e4, 1e8, 1e15, 1e18])
def test_extreme_images_stay_bounded(device: Device, scale: float) -> None:
    """Catches variances that become negative or overflow, whose gradient is NaN or enormous."""
    image, target = pictures(40, 30)
    gradient, _ = on_device(device, np.float32(scale) * image, target, np.ones((2, 3), bool))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() < 10 / image.size
