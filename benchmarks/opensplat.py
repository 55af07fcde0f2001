"""OpenSplat's CPU rasterizer beside ours: the same projected splats, image and gradient of the
image.

Built from the user's own checkout of OpenSplat (AGPL), of which nothing is kept here.
"""

import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.cpp_extension import load_inline

from stga_addon.raster.cpu import layout
from stga_addon.raster.cpu.layout import BLUE, OPACITY, PRECISION_X, PRECISION_Y, RED, SHEAR

SOURCE = Path("rasterizer", "gsplat-cpu", "gsplat_cpu.cpp")
BINDING = """
#include "SOURCE_FILE"

std::vector<torch::Tensor> both_ways(
    int64_t width, int64_t height, std::vector<torch::Tensor> splats, torch::Tensor background,
    torch::Tensor v_image
) {
    auto &xy = splats[0], &conic = splats[1], &color = splats[2], &opacity = splats[3];
    auto &cov = splats[4];
    auto [image, left, lists] = rasterize_forward_tensor_cpu(
        width, height, xy, conic, color, opacity, background, cov, splats[5]);
    std::vector<torch::Tensor> out = {image};
    if (v_image.numel()) {
        auto gradients = rasterize_backward_tensor_cpu(
            height, width, xy, conic, color, opacity, background, cov, splats[5], left, lists,
            v_image, torch::zeros_like(left));
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
    folder: Path, projection: layout.Projection, rows: np.ndarray, image: np.ndarray,
    v_image: np.ndarray, repeats: int, clock: Callable[[], float],
) -> tuple[float, float]:  # fmt: skip
    """Median milliseconds of its forward pass, and of forward and backward pass together, over a
    white background.

    rows (M,): the visible splats; image, v_image (3, H, W): ours and its gradient; clock: returns
    seconds. Raises ValueError where its image is another one.
    """
    module, (_, height, width) = build(folder), image.shape
    gradient = torch.from_numpy(np.ascontiguousarray(v_image.transpose(1, 2, 0)))
    white, splats = torch.ones(3), [torch.from_numpy(array) for array in _splats(projection, rows)]
    theirs = module.both_ways(width, height, splats, white, gradient)[0].numpy().transpose(2, 0, 1)
    # it blends pixels behind an opaque one's stop differently
    if (off := np.abs(theirs - image).mean()) > 2e-3:
        raise ValueError(f"{folder}: its image differs by {off:.4f} on average")
    found = []
    for wanted in (torch.empty(0), gradient):
        times = []
        for _ in range(repeats):
            begin = clock()
            module.both_ways(width, height, splats, white, wanted)
            times.append(1e3 * (clock() - begin))
        found.append(statistics.median(times))
    return found[0], found[1]


def _splats(projection: layout.Projection, rows: np.ndarray) -> list[np.ndarray]:
    """Center, conic, color, opacity, covariance and depth of the listed splats; its pixels have
    their centers at whole numbers."""
    columns = projection.columns[rows]
    px, shear, py = columns[:, PRECISION_X], columns[:, SHEAR], columns[:, PRECISION_Y]
    conic = np.stack([px, -px * shear, px * shear * shear + py], 1)
    covariance = np.zeros((len(rows), 2, 2), np.float32)
    covariance[:, 0, 0], covariance[:, 1, 1] = 1 / px + shear * shear / py, 1 / py
    center = columns[:, [layout.MEAN_X, layout.MEAN_Y]] - np.float32(0.5)
    color, opacity = columns[:, RED : BLUE + 1].copy(), columns[:, OPACITY, None].copy()
    return [
        np.ascontiguousarray(array)
        for array in (center, conic, color, opacity, covariance, projection.depth[rows])
    ]
