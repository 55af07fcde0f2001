"""OpenSplat's CPU rasterizer and image loss beside ours: the same projected splats and target.

Built from the user's own checkout of OpenSplat (AGPL) of 2026 or later, of which nothing is kept
here. It starts a thread for each of the machine's processors.
"""

import statistics
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch.utils.cpp_extension import load_inline

from ...raster.cpu import layout
from ...raster.cpu.layout import BLUE, OPACITY, PRECISION_X, PRECISION_Y, RED, SHEAR
from ...raster.cpu.rasterize import RenderOutput

SOURCE = Path("rasterizer", "gsplat-cpu", "gsplat_cpu.cpp")
BINDING = """
#include "SOURCE_FILE"

std::vector<torch::Tensor> both_ways(
    int64_t width, int64_t height, std::vector<torch::Tensor> splats, torch::Tensor background,
    torch::Tensor target, double ssim_weight
) {
    auto &xy = splats[0], &conic = splats[1], &color = splats[2], &opacity = splats[3];
    auto &cov = splats[4];
    auto [image, left, lists] = rasterize_forward_tensor_cpu(
        width, height, xy, conic, color, opacity, background, cov, splats[5]);
    std::vector<torch::Tensor> out = {image};
    if (target.numel()) {
        auto none = torch::empty({0}), one = torch::ones({1});
        float weight = ssim_weight;
        auto [stats, partials] =
            fused_loss_forward_tensor_cpu(image, target, none, weight, false, true);
        auto v_image = fused_loss_backward_tensor_cpu(
            image, target, none, partials, stats, one, weight, false);
        auto gradients = rasterize_backward_tensor_cpu(
            height, width, xy, conic, color, opacity, background, cov, splats[5], left, lists,
            v_image, torch::zeros_like(left), none, none, none, none);
        out.push_back(std::get<0>(gradients));
    }
    delete[] lists;
    return out;
}
"""


def build(folder: Path) -> Any:
    """The module of `both_ways`, compiled with the options of OpenSplat's release build."""
    source = (folder / SOURCE).resolve(strict=True)
    binding = BINDING.replace("SOURCE_FILE", str(source))
    return load_inline("opensplat_cpu", binding, functions=["both_ways"], extra_cflags=["-O3"])


def both_ways_ms(
    folder: Path, ours: RenderOutput, target: np.ndarray, ssim_weight: float, repeats: int
) -> tuple[float, float]:
    """Median milliseconds of wall time of its forward pass, and of forward pass, loss and backward
    pass together, over a white background.

    target (H, W, 3) uint8. Raises ValueError where its image is another one than ours.
    """
    module = build(folder)
    (_, height, width) = ours.image.shape
    captured = torch.from_numpy(target.astype(np.float32) / 255)
    white = torch.ones(3)
    splats = [torch.from_numpy(array) for array in _splats(ours.projection, ours.lists.visible)]

    def render(wanted: torch.Tensor) -> torch.Tensor:
        return module.both_ways(width, height, splats, white, wanted, ssim_weight)[0]

    theirs = render(captured).numpy().transpose(2, 0, 1)
    # it blends pixels behind an opaque one's stop differently
    if (off := np.abs(theirs - ours.image).mean()) > 2e-3:
        raise ValueError(f"{folder}: its image differs by {off:.4f} on average")
    found = []
    for wanted in (torch.empty(0), captured):
        times = []
        for _ in range(repeats):
            begin = perf_counter()
            render(wanted)
            times.append(1e3 * (perf_counter() - begin))
        found.append(statistics.median(times))
    return found[0], found[1]


def _splats(projection: layout.Projection, rows: np.ndarray) -> list[np.ndarray]:
    """Center, conic, color, opacity, covariance and depth of the listed splats; its pixels have
    their centers at whole numbers."""
    columns = projection.columns[rows]
    px = columns[:, PRECISION_X]
    shear = columns[:, SHEAR]
    py = columns[:, PRECISION_Y]
    conic = np.stack([px, -px * shear, px * shear * shear + py], 1)
    covariance = np.zeros((len(rows), 2, 2), np.float32)
    covariance[:, 0, 0] = 1 / px + shear * shear / py
    covariance[:, 1, 1] = 1 / py
    center = columns[:, [layout.MEAN_X, layout.MEAN_Y]] - np.float32(0.5)
    color = columns[:, RED : BLUE + 1].copy()
    opacity = columns[:, OPACITY, None].copy()
    return [
        np.ascontiguousarray(array)
        for array in (center, conic, color, opacity, covariance, projection.depth[rows])
    ]
