"""Quality figures against the same computed with numpy and scipy."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from stga_addon.capture.camera import Camera
from stga_addon.capture.images import read_image
from stga_addon.capture.model import View
from stga_addon.training.evaluate.evaluation_views import EvaluationView
from stga_addon.training.evaluate.metrics import Quality, evaluate, peak_memory_mb, psnr

HEIGHT, WIDTH = 31, 24


def random_image(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def reference_ssim(image: np.ndarray, target: np.ndarray, where: np.ndarray | None = None) -> float:
    """Mean SSIM of two (H, W, 3) images in 0…1: Gaussian window of 11 pixels, σ 1.5, zeros around
    the image."""

    def blur(a: np.ndarray) -> np.ndarray:
        return gaussian_filter(a, (1.5, 1.5, 0), mode="constant", radius=(5, 5, 0))

    mx, my = blur(image), blur(target)
    vx, vy, cov = blur(image**2) - mx**2, blur(target**2) - my**2, blur(image * target) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    values = (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    return float(np.mean(values if where is None else values[where]))


def sights_of(views: list[View]) -> list[EvaluationView]:
    return [EvaluationView(view, read_image(view)) for view in views]


def write_views(root: Path, count: int) -> list[View]:
    camera = Camera(WIDTH, HEIGHT, 50.0, 50.0, 12.0, 15.0, np.eye(4))
    for n in range(count):
        Image.fromarray(random_image(n)).save(root / f"{n}.png")
    return [View(n, 0, camera, f"{n}.png", root / f"{n}.png") for n in range(count)]


def test_psnr() -> None:
    """Catches a mean over the wrong axes, a peak of 255, natural logarithms, and a mask that is
    ignored."""
    target = random_image(0)
    image = np.random.default_rng(1).random((3, HEIGHT, WIDTH)).astype(np.float32)
    error = (image.astype(float) - np.moveaxis(target / 255, 2, 0)) ** 2
    assert psnr(image, target) == pytest.approx(10 * np.log10(1 / error.mean()), abs=1e-4)
    where = np.random.default_rng(2).random((HEIGHT, WIDTH)) < 0.2
    wanted = np.mean([error[c][where].mean() for c in range(3)])
    assert psnr(image, target, where) == pytest.approx(10 * np.log10(1 / wanted), abs=1e-4)
    assert psnr((target.transpose(2, 0, 1) / 255).astype(np.float32), target) > 100


def test_evaluate_means_over_views_and_clips(tmp_path: Path) -> None:
    """Catches PSNR of the mean error instead of the mean PSNR, another SSIM, and values over one
    that count double."""
    views = write_views(tmp_path, 3)
    drawn = {
        view.name: np.random.default_rng(9).normal(0.5, 0.5, (3, HEIGHT, WIDTH)).astype(np.float32)
        for view in views
    }
    drawn["2.png"] = (random_image(2).transpose(2, 0, 1) / 255 * 0.9 + 0.05).astype(np.float32)
    quality = evaluate(lambda view: drawn[view.name], sights_of(views))
    pairs = [
        (np.clip(drawn[view.name], 0, 1).transpose(1, 2, 0).astype(float), random_image(n) / 255)
        for n, view in enumerate(views)
    ]
    assert quality.psnr == pytest.approx(
        np.mean([-10 * np.log10(np.mean((a - b) ** 2)) for a, b in pairs]), abs=1e-3
    )
    assert quality.ssim == pytest.approx(
        np.mean([reference_ssim(a, b) for a, b in pairs]), abs=1e-4
    )
    assert quality.lpips is None


def test_regions_are_measured_by_themselves(tmp_path: Path) -> None:
    """Catches a region's figures that depend on the rest of the image, and views without the region
    that count."""
    views = write_views(tmp_path, 2)
    where = np.zeros((HEIGHT, WIDTH), bool)
    where[4:24, 3:18] = True
    target = read_image(views[0])
    rng = np.random.default_rng(3)
    inside = np.clip(target / 255 + rng.normal(0, 0.1, target.shape), 0, 1)
    good = np.where(where[..., None], inside, target / 255)
    bad = np.where(where[..., None], inside, rng.random(target.shape))
    evaluation_views = [
        EvaluationView(views[0], target, {"mask": where}),
        EvaluationView(views[1], read_image(views[1])),
    ]
    for image in (good, bad):
        drawn = np.moveaxis(image, 2, 0).astype(np.float32)
        quality = evaluate(lambda view, drawn=drawn: drawn, evaluation_views)  # type: ignore[misc]
        region = quality.regions["mask"]
        error = ((inside - target / 255) ** 2)[where]
        assert region.psnr == pytest.approx(-10 * np.log10(error.mean()), abs=1e-3)
        # The image's windows reach a few pixels out of the region, where both images are the same.
        outside = reference_ssim(good, target / 255, ~where)
        share = where.mean()
        lost = (1 - reference_ssim(good, target / 255, where)) + (1 - outside) * (1 - share) / share
        assert region.ssim == pytest.approx(1 - lost, abs=1e-4)
    assert set(quality.as_json()) == {"psnr", "ssim", "detail_difference", "psnr_mask", "ssim_mask"}


def test_peak_memory_never_falls() -> None:
    """Catches bytes, or kilobytes, taken for mebibytes, and the memory of now for that of the
    peak."""
    before = peak_memory_mb()
    if before is None:
        pytest.skip("this system does not say how much memory a process held")
    held = np.ones(64 << 20, np.uint8)
    after = peak_memory_mb()
    del held
    assert after is not None
    assert 0 < before <= after < before + 1000
    assert (peak_memory_mb() or 0) > after - 1  # the system counts roughly


def test_lpips_is_left_out_where_its_weights_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a crash, or a made-up number, without weights."""
    monkeypatch.delenv("STGA_LPIPS", raising=False)
    evaluation_views = sights_of(write_views(tmp_path, 1))
    quality = evaluate(
        lambda view: np.zeros((3, HEIGHT, WIDTH), np.float32), evaluation_views, perceptual=True
    )
    assert quality.lpips is None
    assert set(quality.as_json()) == {"psnr", "ssim", "detail_difference"}
    assert Quality(30.0, 0.9, 0.1).as_json() == {"psnr": 30.0, "ssim": 0.9, "lpips": 0.1}
