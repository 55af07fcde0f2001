"""Both renderers against images that gsplat made."""

import numpy as np
import pytest
import torch

from stga_addon.capture.camera import Camera
from stga_addon.raster import reference
from stga_addon.raster.cpu.autograd import render_differentiable
from stga_addon.raster.cpu.layout import Parameters

TOLERANCE = 2e-5  # gsplat computes in float32


@pytest.fixture(params=["tiny_case", "basic_case"])
def gsplat_case(request, shared_data) -> tuple[list[torch.Tensor], Camera, torch.Tensor]:
    load_file = pytest.importorskip("safetensors.torch").load_file
    tensors = load_file(shared_data / "raster_reference" / f"{request.param}.safetensors")
    height, width, _ = tensors["out_img"].shape
    pose = np.eye(4)
    pose[:3, 3] = -np.array([0.123, 0.456, -8.0])
    camera = Camera(width, height, width / 2, width / 2, width / 2, height / 2, pose)
    splats = [tensors[name] for name in ("means", "quats", "scales", "opacities", "coeffs")]
    return splats, camera, tensors["out_img"].permute(2, 0, 1)


def test_reference_reproduces_gsplat(gsplat_case):
    """Catches any difference of convention: axes, harmonics' signs, low-pass, cuts, blending order."""
    splats, camera, expected = gsplat_case
    rgb, alpha, _ = reference.render(*(tensor.double() for tensor in splats), camera)
    assert (torch.cat([rgb, alpha[None]]) - expected).abs().max() < TOLERANCE


def test_kernels_reproduce_gsplat(gsplat_case):
    """Catches the same in the kernels, independently of our own reference."""
    splats, camera, expected = gsplat_case
    rgb, alpha, _ = render_differentiable(Parameters(*splats), camera)
    assert (torch.cat([rgb, alpha[None]]) - expected).abs().max() < TOLERANCE
