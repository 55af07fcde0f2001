"""How close renderings come to the images: PSNR, SSIM and, where its package is installed, LPIPS."""

import importlib.util
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any

import numpy as np
import torch

from ..capture.images import read_image
from ..capture.model import View
from .losses import similarity


@dataclass(frozen=True)
class Quality:
    """Means over views: PSNR in dB, SSIM, and LPIPS (AlexNet) or None without its package."""

    psnr: float
    ssim: float
    lpips: float | None = None

    def as_json(self) -> dict[str, float]:
        return {name: value for name, value in asdict(self).items() if value is not None}


def evaluate(draw: Callable[[View], np.ndarray], views: Iterable[View], perceptual: bool = False) -> Quality:
    """Mean quality of `draw(view)` (3, H, W) float32 against each view's image; images are clipped to 0…1."""
    scores = []
    for view in views:
        image, target = np.clip(draw(view), 0, 1), read_image(view)
        target.setflags(write=False)  # as in training; Numba would compile anew for writable arrays
        lpips = _lpips(image, target) if perceptual else None
        scores.append((psnr(image, target), similarity(image, target), np.nan if lpips is None else lpips))
    mean = np.mean(scores, axis=0) if scores else [np.nan] * 3
    return Quality(float(mean[0]), float(mean[1]), None if np.isnan(mean[2]) else float(mean[2]))


def psnr(image: np.ndarray, target: np.ndarray, where: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB of image (3, H, W) in 0…1 and target (H, W, 3) uint8, at `where` (H, W)."""
    error = (image - target.transpose(2, 0, 1).astype(np.float32) / 255) ** 2
    mean = float(error.mean() if where is None else error[:, where].mean())
    return float(-10 * np.log10(max(mean, 1e-12)))


@cache
def _network() -> Any:
    if importlib.util.find_spec("lpips") is None:
        return None
    import lpips

    return lpips.LPIPS(net="alex", verbose=False).eval()


def _lpips(image: np.ndarray, target: np.ndarray) -> float | None:
    network = _network()
    if network is None:
        return None
    pair = [torch.from_numpy(image), torch.from_numpy(target.transpose(2, 0, 1).astype(np.float32) / 255)]
    with torch.no_grad():
        return float(network(*(2 * p[None] - 1 for p in pair)))
