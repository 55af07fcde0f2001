"""Reference and kernels against numbers that gsplat computed.

`data/gsplat.npz`: 24 random splats, a camera, and what gsplat 1.5.3 (PyPI, Apache-2.0 license;
`cuda/_torch_impl.py`, run in float64 on the CPU) makes of them: projected centers, conics, depths,
compensations, colors, and the image and alpha without and with compensated opacities. The pixels of
each splat, those where alpha is 1/255 or more, were listed by us; nothing in this scene is opaque
enough to end a pixel.
"""

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from safetensors.torch import load_file

from raster import reference
from stga_addon.capture.camera import Camera
from stga_addon.raster.cpu.autograd import render_differentiable
from stga_addon.raster.cpu.layout import Parameters

from .test_kernels import NAMES

DATA = np.load(Path(__file__).parent / "data" / "gsplat.npz")
CAMERA = Camera(*DATA["size"].tolist(), *DATA["intrinsics"].tolist(), DATA["world_to_camera"])
TOLERANCE = 2e-5  # of float32 kernels, and of gsplat's images in shared data, which are float32


@pytest.mark.parametrize("antialiased", [False, True])
def test_reference_image_is_gsplats(antialiased):
    """Catches a difference of convention, axes, pixel centers, low-pass, harmonics' signs or
    compensation, and a wrong density, cut or blending order."""
    splats = (torch.from_numpy(DATA[name]).double() for name in NAMES)
    rgb, alpha, _ = reference.render(*splats, CAMERA, antialiased=antialiased)
    kind = "antialiased" if antialiased else "classic"
    assert_allclose(rgb, DATA[f"image_{kind}"], atol=1e-6)
    assert_allclose(alpha, DATA[f"alpha_{kind}"], atol=1e-6)


@pytest.fixture(params=["tiny_case", "basic_case"])
def gsplat_case(request, shared_data):
    """Images that gsplat's CUDA kernels made; development data, not part of the project."""
    tensors = load_file(shared_data / "raster_reference" / f"{request.param}.safetensors")
    height, width, _ = tensors["out_img"].shape
    pose = np.eye(4)
    pose[:3, 3] = -np.array([0.123, 0.456, -8.0])
    camera = Camera(width, height, width / 2, width / 2, width / 2, height / 2, pose)
    splats = [tensors[name] for name in ("means", "quats", "scales", "opacities", "coeffs")]
    return splats, camera, tensors["out_img"].permute(2, 0, 1)


def test_kernels_reproduce_gsplats_cuda_images(back_end, gsplat_case):
    """Catches any difference of convention, tiles and stop included, of kernels or reference."""
    splats, camera, expected = gsplat_case
    rgb, alpha, _ = render_differentiable(Parameters(*splats), camera)
    assert (torch.cat([rgb, alpha[None]]) - expected).abs().max() < TOLERANCE
    rgb, alpha, _ = reference.render(*(tensor.double() for tensor in splats), camera)
    assert (torch.cat([rgb, alpha[None]]) - expected).abs().max() < TOLERANCE
