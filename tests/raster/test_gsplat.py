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

from raster import reference
from stga_addon.avatar.embedding import WORLD
from stga_addon.capture.camera import Camera
from stga_addon.raster.cpu.autograd import render_differentiable
from stga_addon.raster.cpu.layout import (
    MEAN_X,
    OPACITY,
    PRECISION_X,
    PRECISION_Y,
    PROJECTED,
    RED,
    SHEAR,
    Parameters,
)
from stga_addon.raster.cpu.rasterize import frames_in_camera, render_forward

from .test_kernels import NAMES

DATA = np.load(Path(__file__).parent / "data" / "gsplat.npz")
CAMERA = Camera(*DATA["size"].tolist(), *DATA["intrinsics"].tolist(), DATA["world_to_camera"])
TOLERANCE = 2e-5  # of float32 kernels, and of gsplat's images in shared data, which are float32


def splats(dtype: torch.dtype) -> list[torch.Tensor]:
    return [torch.from_numpy(DATA[name]).to(dtype) for name in NAMES]


def conics(covariance: np.ndarray) -> np.ndarray:
    """Inverse of 2D covariances (N, 2, 2) as gsplat stores it: xx, xy, yy."""
    inverse = np.linalg.inv(covariance)
    return np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], axis=-1)


def test_reference_stages_are_gsplats():
    """Catches a difference of convention in one stage: axes, pixel centers, low-pass, harmonics'
    signs, compensation."""
    xyz, rotation, log_scale, _, sh = splats(torch.float64)
    center, covariance, depth, compensation = reference.project(xyz, rotation, log_scale, CAMERA)
    color = reference.sh_color(sh, xyz - torch.from_numpy(CAMERA.position), 3)
    found = {
        "means2d": center,
        "conics": conics(covariance.numpy()),
        "depths": depth,
        "compensations": compensation,
        "colors": color,
    }
    for name, values in found.items():
        np.testing.assert_allclose(values, DATA[name], rtol=1e-6, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("antialiased", [False, True])
def test_reference_image_is_gsplats(antialiased):
    """Catches a wrong density, cut or blending order."""
    rgb, alpha, _ = reference.render(*splats(torch.float64), CAMERA, antialiased=antialiased)
    kind = "antialiased" if antialiased else "classic"
    np.testing.assert_allclose(rgb, DATA[f"image_{kind}"], atol=1e-6)
    np.testing.assert_allclose(alpha, DATA[f"alpha_{kind}"], atol=1e-6)


def projected_columns(back_end: str, antialiased: bool) -> np.ndarray:
    """(N, PROJECTED) of the scene, by the kernels of one back end."""
    parameters = Parameters(*(DATA[name] for name in NAMES))
    face = np.zeros(24, np.int32)
    frames = frames_in_camera(WORLD, CAMERA)
    if back_end == "cpu":
        return render_forward(parameters, face, frames, 3, antialiased=antialiased).projection[0]
    from raster.gpu_autograd import render, shared_rasterizer
    from stga_addon.raster.gpu.rasterize import ViewOptions

    render(ViewOptions(CAMERA, 3, antialiased=antialiased), frames, face, parameters)
    device = shared_rasterizer().device
    return device.read(device.buffer("projected", 0), (24, PROJECTED))


@pytest.mark.parametrize("antialiased", [False, True])
def test_projection_kernels_are_gsplats(back_end, antialiased):
    """Catches a projection that is wrong in both our reference and our kernels."""
    columns = projected_columns(back_end, antialiased)
    x = columns[:, PRECISION_X]
    shear = columns[:, SHEAR]
    y = columns[:, PRECISION_Y]
    opacity = 1 / (1 + np.exp(-DATA["opacity"])) * (DATA["compensations"] if antialiased else 1)
    # Splats below 1/255 are never projected.
    seen = (opacity > 1 / 254) & (
        np.abs(DATA["means2d"] - DATA["size"] / 2) < DATA["size"] / 2
    ).all(1)
    assert seen.sum() > 12
    found = {
        "means2d": (columns[:, MEAN_X : MEAN_X + 2], DATA["means2d"]),
        "conics": (np.stack([x, -x * shear, y + x * shear * shear], axis=-1), DATA["conics"]),
        "opacities": (columns[:, OPACITY], opacity),
        "colors": (columns[:, RED : RED + 3], DATA["colors"]),
    }
    for name, (values, expected) in found.items():
        np.testing.assert_allclose(values[seen], expected[seen], rtol=5e-5, atol=1e-5, err_msg=name)


@pytest.fixture(params=["tiny_case", "basic_case"])
def gsplat_case(request, shared_data) -> tuple[list[torch.Tensor], Camera, torch.Tensor]:
    """Images that gsplat's CUDA kernels made; development data, not part of the project."""
    load_file = pytest.importorskip("safetensors.torch").load_file
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
