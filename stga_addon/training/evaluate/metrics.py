"""Image quality of renderings: PSNR, SSIM and, if its weights are available, LPIPS."""

import importlib.util
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import prewitt, uniform_filter

from ...avatar.file import Avatar
from ...avatar.splats import Splats
from ...capture.images import read_image
from ...capture.model import Capture, View, ViewExposure
from ...render.render import render_avatar
from ..optimize.losses import mean_ssim
from . import lpips
from .evaluation_views import EvaluationView, read_evaluation_view
from .match_exposure import NO_CORRECTION, exposed_rendering, known_exposure, with_exposure

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
PREWITT_SUM = 3
"""Sum of the positive weights of Prewitt's filter."""
WINDOW_PX = 7
"""Side of the window that detail is averaged over, so that a hair a pixel beside its place counts
as a hair."""
NOISE_LEVEL = 0.02
"""Change of luma (0…1) from pixel to pixel below which detail counts little."""


@dataclass(frozen=True)
class Quality:
    """Means over views: PSNR in dB, SSIM, and LPIPS (AlexNet) or None if it was not measured.

    regions  the same per region ("mask", "moving"), over the views that have the region; per group
             of views ("take_1"), and per region of a group ("moving_take_1")
    detail_difference  within the head mask, without the matte's border: what the avatar that a run
                       keeps is chosen by; None for a region
    psnr_unmatched     PSNR without fitting the exposure of views; None where none was fitted
    psnr_recorded      of the avatar in front of its world, against images as recorded; or None
    """

    psnr: float
    ssim: float
    lpips: float | None = None
    regions: Mapping[str, "Quality"] = field(default_factory=dict)
    detail_difference: float | None = None
    psnr_unmatched: float | None = None
    psnr_recorded: float | None = None

    def as_json(self) -> dict[str, float]:
        """Flat: "psnr", "ssim", "psnr_mask" and so on, without what was not measured."""
        own = {name: value for name, value in vars(self).items() if name != "regions"}
        flat = {name: value for name, value in own.items() if value is not None}
        for region, quality in self.regions.items():
            flat.update({f"{name}_{region}": value for name, value in quality.as_json().items()})
        return flat


def evaluate(
    render: Callable[[View], np.ndarray],
    evaluation_views: Iterable[EvaluationView],
    perceptual: bool = False,
    exposure: ViewExposure | None = None,
) -> Quality:
    """Mean quality of `render(view)` (3, H, W) float32, clipped to 0…1.

    perceptual: whether to measure LPIPS; exposure: `known_exposure`, which renderings are given
    before; that of other cameras is fitted (`match_exposure`). None: renderings are measured as
    they are.
    """
    scores: dict[str, list[tuple[float, float, float]]] = {"": []}
    differences, unmatched, fitted = [], [], False
    for evaluation_view in evaluation_views:
        target = evaluation_view.target
        image = np.clip(render(evaluation_view.view), 0, 1)
        if exposure is not None:
            head, interior = evaluation_view.regions.get("mask"), evaluation_view.interior
            known = exposure(evaluation_view.view)
            image, plain = exposed_rendering(image, target, known, head, interior)
            unmatched.append(psnr(plain, target))
            fitted = fitted or known is None
        differences.append(detail_difference(image, target, evaluation_view.interior))
        parts: dict[str, np.ndarray | None] = {"": None, **evaluation_view.regions}
        for region, where in parts.items():
            found, group = _scores(image, target, perceptual, where), evaluation_view.group
            for name in dict.fromkeys((region, "_".join(filter(None, (region, group))))):
                scores.setdefault(name, []).append(found)
    means = {region: _mean(of_views) for region, of_views in scores.items()}
    whole = means.pop("")
    return replace(
        whole,
        regions=means,
        detail_difference=float(np.mean(differences)) if differences else None,
        psnr_unmatched=float(np.mean(unmatched)) if fitted else None,
    )


def evaluate_avatar(
    avatar: Avatar,
    capture: Capture,
    split: str,
    perceptual: bool = False,
    matched: bool | None = None,
) -> Quality:
    """Quality of an avatar on all views of a split; holds one view at a time in memory.

    matched: whether to apply the exposure of each view, known or fitted; None: where the avatar was
    trained so.
    """
    rows, exposure = avatar.settings.get("exposure") or (), None
    backdrop = str(avatar.settings.get("backdrop", "plain"))
    if rows if matched is None else matched:
        exposure = known_exposure(rows, capture.views.get("train", ()))
    background, views = avatar.background, capture.views[split]
    read = (read_evaluation_view(capture, view, background, backdrop) for view in views)

    def render(view: View) -> np.ndarray:
        return render_avatar(avatar, capture.mesh(view.timestep), view.camera, background)

    return evaluate(render, read, perceptual, exposure)


def psnr_recorded(avatar: Avatar, world: Splats, capture: Capture, split: str) -> float:
    """Mean PSNR in dB of the avatar in front of its world, in all views of a split, against images
    as recorded.

    Renderings are given the exposure of their camera where the run knows one; none is fitted.
    """
    known = known_exposure(avatar.settings.get("exposure") or (), capture.views.get("train", ()))
    found = []
    for view in capture.views[split]:
        mesh = np.asarray(capture.mesh(view.timestep))
        image = render_avatar(avatar, mesh, view.camera, avatar.background, behind=world)
        exposure = known(view)
        exposed = with_exposure(image, NO_CORRECTION if exposure is None else exposure)
        found.append(psnr(exposed, read_image(view)))
    return float(np.mean(found))


def psnr(image: np.ndarray, target: np.ndarray, where: np.ndarray | None = None) -> float:
    """PSNR in dB of image (3, H, W) in 0…1 and target (H, W, 3) uint8, over the pixels `where` (H,
    W) if given."""
    error = (image - target.transpose(2, 0, 1).astype(np.float32) / 255) ** 2
    mean = float(error.mean() if where is None else error[:, where].mean())
    return float(-10 * np.log10(max(mean, 1e-12)))


def peak_memory_mb() -> float | None:
    """Peak memory of this process in MiB; None if the system does not report it (Windows)."""
    with suppress(OSError):  # Linux, where getrusage would include the parent process
        status = Path("/proc/self/status").read_text(encoding="ascii")
        return round(int(status.partition("VmHWM:")[2].split()[0]) / 2**10, 1)
    if importlib.util.find_spec("resource") is None:
        return None
    import resource

    peak: int = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # bytes there, KiB elsewhere
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10), 1)


def _scores(
    image: np.ndarray, target: np.ndarray, perceptual: bool, where: np.ndarray | None = None
) -> tuple[float, float, float]:
    """PSNR, SSIM and LPIPS (NaN if not measured) of the whole image or of the region `where` (H,
    W).

    For a region's SSIM and LPIPS, pixels outside it are replaced by the target's, and SSIM is
    scaled to a mean over the region.
    """
    psnr_db, shown = psnr(image, target, where), target.transpose(2, 0, 1).astype(np.float32) / 255
    share = 1.0 if where is None else float(where.mean())
    if where is not None:
        image = np.where(where, image, shown)
    ssim = 1 - (1 - mean_ssim(image, target)) / share
    network = lpips.load_network() if perceptual else None
    if network is None or min(target.shape[:2]) < lpips.MIN_SIDE_PX:
        return psnr_db, ssim, np.nan
    return psnr_db, ssim, network.distance(image, shown)


def _mean(scores: list[tuple[float, float, float]]) -> Quality:
    mean = np.mean(scores, axis=0) if scores else [np.nan] * 3
    return Quality(float(mean[0]), float(mean[1]), None if np.isnan(mean[2]) else float(mean[2]))


def detail_difference(
    image: np.ndarray, target: np.ndarray, where: np.ndarray | None = None
) -> float:
    """Mean of |a − b| / (a + b + NOISE_LEVEL) over the pixels `where` (H, W) if given; 0 for equal
    images, below 1.

    image (3, H, W) float32 in 0…1, target (H, W, 3) uint8; a and b are their mean gradients of luma
    (by Prewitt) around a pixel. It falls with LPIPS during training, also where PSNR falls, and
    needs no weights.
    """
    a, b = (
        uniform_filter(np.hypot(prewitt(luma, 0), prewitt(luma, 1)) / PREWITT_SUM, WINDOW_PX)
        for luma in (np.tensordot(LUMA, image, 1), target @ LUMA / np.float32(255))
    )
    difference = abs(a - b) / (a + b + NOISE_LEVEL)
    return float(difference.mean() if where is None else difference[where].mean())
