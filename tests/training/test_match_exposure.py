"""Matching the exposure of a rendering to a held-out view."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stga_addon.capture.camera import Camera
from stga_addon.capture.model import View
from stga_addon.training.evaluate.evaluation_views import EvaluationView
from stga_addon.training.evaluate.match_exposure import known_exposure, match_exposure
from stga_addon.training.evaluate.metrics import evaluate
from stga_addon.training.optimize.image_preparation import exposure_correction
from stga_addon.training.settings import TrainingSettings

SIDE = 32


def head_and_image() -> tuple[np.ndarray, np.ndarray]:
    """A mask (H, W) bool and a rendering (3, H, W) float32 over white."""
    head = np.zeros((SIDE, SIDE), bool)
    head[6:26, 8:24] = True
    image = np.where(head, np.random.default_rng(0).uniform(0.2, 0.7, (3, SIDE, SIDE)), 1.0).astype(
        np.float32
    )
    return head, image


def test_inverts_what_training_corrects() -> None:
    """Catches another model than the effect's: gain and offset swapped, mixed channels, a
    background that changes."""
    head, image = head_and_image()
    gain, offset = np.array([1.1, 0.9, 1.2]), np.array([5.0, -8.0, 2.0])
    levels = 255 * image.transpose(1, 2, 0)
    target = np.where(head[..., None], gain * levels + offset, levels).round().astype(np.uint8)
    matched = match_exposure(image, target, head, head)
    assert np.abs(255 * matched - target.transpose(2, 0, 1)).max() < 2
    assert np.array_equal(matched[:, ~head], image[:, ~head])
    correct = exposure_correction(TrainingSettings(iterations=1, exposure=((0.0, *gain, *offset),)))
    assert correct is not None
    view = View(0, 0, Camera(SIDE, SIDE, 50.0, 50.0, 16.0, 16.0, np.eye(4)), "0.png", Path("0.png"))
    back = correct(view, target, (255 * head).astype(np.uint8))
    assert np.abs(back - levels).max() < 3


def test_a_rendering_of_one_color_stays_finite() -> None:
    """Catches a singular system where gain and offset cannot be told apart, and a crash without a
    mask or pixels."""
    head, _ = head_and_image()
    flat = np.full((3, SIDE, SIDE), 0.5, np.float32)
    target = np.full((SIDE, SIDE, 3), 153, np.uint8)
    assert match_exposure(flat, target) == pytest.approx(0.6, abs=2e-3)
    assert np.array_equal(match_exposure(flat, target, head, np.zeros_like(head)), flat)


def test_evaluation_reports_both(tmp_path: Path) -> None:
    """Catches figures that are matched without being asked for, and a report that hides the other
    figure."""
    head, image = head_and_image()
    target = np.where(head[..., None], 0.8 * image.transpose(1, 2, 0), 1.0)
    Image.fromarray((255 * target).round().astype(np.uint8)).save(tmp_path / "0.png")
    view = View(
        0, 0, Camera(SIDE, SIDE, 50.0, 50.0, 16.0, 16.0, np.eye(4)), "0.png", tmp_path / "0.png"
    )
    views = [EvaluationView(view, (255 * target).round().astype(np.uint8), {"mask": head}, head)]
    plain = evaluate(lambda view: image, views)
    matched = evaluate(lambda view: image, views, exposure=known_exposure((), ()))
    assert plain.psnr_unmatched is None
    assert matched.psnr_unmatched == pytest.approx(plain.psnr)
    assert matched.psnr > plain.psnr + 20
    assert matched.regions["mask"].psnr > plain.regions["mask"].psnr + 20
    assert matched.as_json()["psnr_unmatched"] == matched.psnr_unmatched


def test_nothing_is_fitted_where_the_exposure_is_known(tmp_path: Path) -> None:
    """Catches six numbers fitted to views of cameras whose exposure training has estimated, which
    hides its errors."""
    head, image = head_and_image()
    gain, offset = np.array([0.8, 1.1, 0.9]), np.array([4.0, -6.0, 3.0])
    levels = 255 * image.transpose(1, 2, 0)
    target = np.where(head[..., None], gain * levels + offset, levels).round().astype(np.uint8)
    camera = Camera(SIDE, SIDE, 50.0, 50.0, 16.0, 16.0, np.eye(4))
    views = [View(0, number, camera, "0.png", tmp_path / "0.png") for number in range(3)]
    known = known_exposure([[0, *gain, *offset]], views[:2])
    trained, plain, other = (
        evaluate(
            lambda view: image, [EvaluationView(view, target, {"mask": head}, head)], exposure=known
        )
        for view in views
    )
    assert trained.psnr > 45
    assert trained.psnr_unmatched is None
    assert plain.psnr == pytest.approx(
        evaluate(lambda view: image, [EvaluationView(views[1], target)]).psnr
    )
    assert plain.psnr_unmatched is None  # trained, and not corrected
    assert other.psnr > 45
    assert other.psnr_unmatched == pytest.approx(plain.psnr)
