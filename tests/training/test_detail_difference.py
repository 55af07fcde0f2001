"""Detail difference against its formula in float64, pixel by pixel, and on blur that PSNR
prefers."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from stga_addon.training.evaluate.metrics import detail_difference, psnr


def expected(image: np.ndarray, target: np.ndarray, where: np.ndarray) -> float:
    """By loops, for images (H, W, 3) in 0…1; edges repeat by reflection."""

    def windows(values: np.ndarray, side: int) -> np.ndarray:
        padded = np.pad(values, side // 2, mode="symmetric")
        return np.lib.stride_tricks.sliding_window_view(padded, (side, side))

    def local(rgb: np.ndarray) -> np.ndarray:
        near = windows(rgb.astype(np.float64) @ [0.299, 0.587, 0.114], 3)
        across = (near[..., 2].sum(-1) - near[..., 0].sum(-1)) / 3
        down = (near[..., 2, :].sum(-1) - near[..., 0, :].sum(-1)) / 3
        return windows(np.sqrt(across**2 + down**2), 7).mean((-1, -2))

    a, b = local(image), local(target)
    return float((abs(a - b) / (a + b + 0.02))[where].mean())


def test_against_the_formula() -> None:
    """Catches a wrong filter, window, channel weight or region."""
    rng = np.random.default_rng(0)
    image = gaussian_filter(rng.random((3, 24, 32), np.float32), (0, 1, 1))
    target = rng.integers(0, 256, (24, 32, 3), np.uint8)
    where = rng.random((24, 32)) < 0.3
    found = detail_difference(image, target, where)
    assert found == pytest.approx(expected(image.transpose(1, 2, 0), target / 255, where), rel=1e-3)
    assert found != detail_difference(image, target)
    same = np.ascontiguousarray(target.transpose(2, 0, 1), dtype=np.float32) / 255
    assert detail_difference(same, target) == pytest.approx(0, abs=1e-6)


def test_detail_that_is_a_pixel_off_beats_blur() -> None:
    """Catches a criterion that, like PSNR, keeps the blurred state of a run instead of the one with
    hair."""
    rng = np.random.default_rng(1)
    strands = np.repeat(gaussian_filter(rng.random((96, 96)), (4, 0.8))[None], 3, 0).astype(
        np.float32
    )
    strands = (strands - strands.min()) / np.ptp(strands)
    target = (255 * strands).round().astype(np.uint8).transpose(1, 2, 0)
    moved = np.roll(strands, 1, axis=2)
    blurred = gaussian_filter(strands, (0, 0, 2.5))
    assert psnr(blurred, target) > psnr(moved, target)
    assert detail_difference(moved, target) < 0.5 * detail_difference(blurred, target)
