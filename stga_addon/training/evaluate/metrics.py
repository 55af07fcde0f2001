"""Image quality of renderings: PSNR, SSIM and, if its weights are available, LPIPS, of held-out
images with the pixels of the head mask and of the moving region; where training corrects exposure,
with that of each view, known from training or fitted to it."""

import importlib.util
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_erosion, prewitt, uniform_filter

from ...avatar.embedding import NO_COLUMNS
from ...avatar.file import Avatar
from ...avatar.splats import SH_C0, Splats
from ...capture.images import read_image, read_mask, read_view
from ...capture.loader import Preparation
from ...capture.model import Capture, View, ViewExposure
from ...capture.selection import SelectionOptions, select_capture, visible_pixels
from ...raster.cpu.layout import Parameters
from ...raster.cpu.rasterize import BufferPool, frames_in_camera, render_backward, render_forward
from ...raster.posed_splats import PosedSplats
from ...render.render import posed_avatar, render_avatar, render_layers
from ..optimize.image_loss import mean_ssim
from ..optimize.image_preparation import NO_CORRECTION, fit_lines, view_exposure, without_backdrop
from . import lpips
from .forecast import FITTED_HEADS

MAX_EVALUATION_VIEWS = 16
"""Held-out views that an evaluation during training renders."""
MIN_REGION_PIXELS = 50
"""A smaller region of a view is left out."""
MATTE_BORDER_FRACTION = 0.0075
"""Width of a head mask's border, where the matte is uncertain, as a fraction of the image's
height."""
PRIOR_FRACTION = 1e-3
"""Weight of gain 1, offset 0, of the fitted pixels; decides where a rendering is one color."""
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
"""Weights of red, green and blue in a pixel's brightness (BT.601)."""
PREWITT_SUM = 3
"""Sum of the positive weights of Prewitt's filter."""
WINDOW_PX = 7
"""Side of the window of detail's mean, so that a hair a pixel beside its place counts as one."""
NOISE_LEVEL = 0.02
"""Change of luma (0…1) from pixel to pixel below which detail counts little."""
RESIDUAL_SCALE = 0.5
"""Size of the images that residuals are measured in: what matters is larger than a pixel."""
MIN_WEIGHT_PX = 2.0
"""Pixels that a triangle's splats must cover together for its residual to be known."""


@dataclass(frozen=True)
class EvaluationView:
    """A view and the image that its rendering is compared with.

    target    (H, W, 3) uint8, read-only
    regions   name -> (H, W) bool: "mask", if the view has one, and "moving", the visible pixels of
              the triangles that the default selection picks at the timestep, if there are any
    interior  (H, W) bool: the head mask without the matte's border; None without a mask
    group     of views whose quality is reported apart as well, as those of one take; empty: none
    """

    view: View
    target: np.ndarray
    regions: Mapping[str, np.ndarray] = field(default_factory=dict)
    interior: np.ndarray | None = None
    group: str = ""


def read_evaluation_view(
    capture: Capture,
    view: View,
    background: Sequence[float] = (1.0, 1.0, 1.0),
    backdrop: str = "plain",
) -> EvaluationView:
    """Read a view's image and mask and find its regions; background (0…1), backdrop: as in
    `TrainingSettings`.

    "moving" is by the default selection whatever a run's settings are, so that runs are comparable.
    Raises StgaError if a file cannot be read.
    """
    red, green, blue = (round(255 * level) for level in background)
    target = read_image(view, (red, green, blue))
    mask = read_mask(view)
    target, mask = without_backdrop(capture, view, target, mask, backdrop, background)
    target.setflags(write=False)  # as in training: Numba would compile again for writable arrays
    selection = select_capture(replace(capture, timesteps=(view.timestep,)), SelectionOptions())
    regions = {"moving": visible_pixels(capture, view, selection[view.timestep])}
    interior = None
    if mask is not None:
        regions = {"mask": mask > 127, **regions}
        border = max(1, round(MATTE_BORDER_FRACTION * len(mask)))
        inside = binary_erosion(mask > 127, iterations=border)
        interior = inside if inside.sum() >= MIN_REGION_PIXELS else None
    regions = {name: where for name, where in regions.items() if where.sum() >= MIN_REGION_PIXELS}
    return EvaluationView(view, target, regions, interior)


def known_exposure(rows: Sequence[Sequence[float]], training_views: Iterable[View]) -> ViewExposure:
    """Exposure of the training cameras' views by the rows of `TrainingSettings.exposure`; a camera
    that they do not list was trained as it is."""
    trained = {view.camera_index for view in training_views}
    listed = view_exposure(rows)

    def exposure(view: View) -> np.ndarray | None:
        found = listed(view)
        return NO_CORRECTION if found is None and view.camera_index in trained else found

    return exposure


def with_exposure(
    image: np.ndarray, exposure: np.ndarray, head: np.ndarray | None = None
) -> np.ndarray:
    """The rendering (3, H, W) as a camera of this exposure (2, 3) shows it, clipped to 0…1; head
    (H, W) bool: where it applies, as in training not behind the head; None: everywhere."""
    head = np.ones(image.shape[1:], bool) if head is None else head
    gain, offset = exposure.astype(np.float32)[..., None]
    exposed = image.copy()
    exposed[:, head] = gain * image[:, head] + offset / 255
    return np.clip(exposed, 0, 1)


def match_exposure(
    image: np.ndarray,
    target: np.ndarray,
    head: np.ndarray | None = None,
    fitted: np.ndarray | None = None,
) -> np.ndarray:
    """The rendering (3, H, W) float32 with gain and offset per channel fitted to the target (H, W,
    3) uint8, clipped to 0…1.

    head: as in `with_exposure`; fitted (H, W) bool, the pixels that the least squares are over, by
    default those of the head. A run corrects its training cameras only, so the exposure of any
    other view is unknown to it. The same is done by RawNeRF and, as `cc_psnr`, by gsplat with a
    full color matrix; here it is the model that training inverts.
    """
    head = np.ones(image.shape[1:], bool) if head is None else head
    fitted = head if fitted is None else fitted
    x = image[:, fitted].astype(np.float64)
    y = target[fitted].T.astype(np.float64) / 255
    if not x.size:
        return image
    found = fit_lines(x, y, np.full(2, PRIOR_FRACTION * x.shape[1])[:, None])
    return with_exposure(image, found * [[1.0], [255.0]], head)


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
        scores = {name: value for name, value in vars(self).items() if name != "regions"}
        flat = {name: value for name, value in scores.items() if value is not None}
        for region, quality in self.regions.items():
            flat.update({f"{name}_{region}": value for name, value in quality.as_json().items()})
        return flat


def with_fitted_heads(
    as_tracked: Mapping[str, float], fitted: Mapping[str, float]
) -> dict[str, float]:
    """Figures of `Quality.as_json` with heads as they were tracked and, named so, with those of
    unseen timesteps fitted by the avatar to the images that it is measured by."""
    return {**as_tracked, **{f"{name}{FITTED_HEADS}": value for name, value in fitted.items()}}


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
    differences = []
    unmatched = []
    fitted = False
    for evaluation_view in evaluation_views:
        target = evaluation_view.target
        image = np.clip(render(evaluation_view.view), 0, 1)
        if exposure is not None:
            head = evaluation_view.regions.get("mask")
            interior = evaluation_view.interior
            known = exposure(evaluation_view.view)
            plain = image
            if known is None:
                image = match_exposure(image, target, head, interior)
                fitted = True
            else:
                image = plain = with_exposure(image, known, head)
            unmatched.append(psnr(plain, target))
        differences.append(detail_difference(image, target, evaluation_view.interior))
        parts: dict[str, np.ndarray | None] = {"": None, **evaluation_view.regions}
        for region, where in parts.items():
            found = _scores(image, target, perceptual, where)
            group = evaluation_view.group
            for name in dict.fromkeys((region, "_".join(filter(None, (region, group))))):
                scores.setdefault(name, []).append(found)
    means = {}
    for name, rows in scores.items():
        mean = np.mean(rows, axis=0).tolist() if rows else [np.nan] * 3
        means[name] = Quality(mean[0], mean[1], None if np.isnan(mean[2]) else mean[2])
    detail = float(np.mean(differences)) if differences else None
    plain_psnr = float(np.mean(unmatched)) if fitted else None
    whole = means.pop("")
    return replace(whole, regions=means, detail_difference=detail, psnr_unmatched=plain_psnr)


def evaluate_avatar(
    avatar: Avatar,
    capture: Capture,
    split: str,
    perceptual: bool = False,
    matched: bool | None = None,
) -> Quality:
    """Quality of an avatar on all views of a split that show someone, read one at a time; matched:
    whether to apply the exposure of each view, None: where the avatar was trained so."""
    rows = avatar.settings.get("exposure") or ()
    exposure = None
    backdrop = str(avatar.settings.get("backdrop", "plain"))
    if rows if matched is None else matched:
        exposure = known_exposure(rows, capture.views.get("train", ()))
    background = avatar.background
    views = capture.views[split]
    read = (read_evaluation_view(capture, view, background, backdrop) for view in views)

    def render(view: View) -> np.ndarray:
        return render_avatar(avatar, capture.mesh(view.timestep), view.camera, background)

    return evaluate(render, read, perceptual, exposure)


def psnr_recorded(avatar: Avatar, world: Splats, capture: Capture, split: str) -> float:
    """Mean PSNR in dB of the avatar in front of its world, in all views of a split, against images
    as recorded: with the exposure of their camera where the run knows one; none is fitted."""
    known = known_exposure(avatar.settings.get("exposure") or (), capture.views.get("train", ()))
    found = []
    for view in capture.views[split]:
        mesh = capture.mesh(view.timestep)
        layers = [posed_avatar(avatar, mesh), PosedSplats(world)]
        image = render_layers(layers, view.camera, avatar.background)
        exposure = known(view)
        exposed = with_exposure(image, NO_CORRECTION if exposure is None else exposure)
        found.append(psnr(exposed, read_image(view)))
    return float(np.mean(found))


def psnr(image: np.ndarray, target: np.ndarray, where: np.ndarray | None = None) -> float:
    """In dB, of image (3, H, W) in 0…1 and target (H, W, 3) uint8, over pixels `where` (H, W)."""
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
    """PSNR, SSIM and LPIPS (NaN if not measured) of the image, or of the region `where` (H, W): the
    pixels outside are replaced by the target's, and SSIM is scaled to a mean over the region."""
    psnr_db = psnr(image, target, where)
    expected = target.transpose(2, 0, 1).astype(np.float32) / 255
    fraction = 1.0 if where is None else float(where.mean())
    if where is not None:
        image = np.where(where, image, expected)
    ssim = 1 - (1 - mean_ssim(image, target)) / fraction
    network = lpips.load_network() if perceptual else None
    if network is None or min(target.shape[:2]) < lpips.MIN_SIDE_PX:
        return psnr_db, ssim, np.nan
    return psnr_db, ssim, network.distance(image, expected)


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


@dataclass(frozen=True)
class Residuals:
    """Absolute error (0…1, mean of the channels) by triangle, summed over views with the splats'
    blending weights.

    error, weight  (F,) float64: Σ weight · error and Σ weight over all pixels, in pixels
    """

    error: np.ndarray
    weight: np.ndarray

    def __add__(self, other: "Residuals") -> "Residuals":
        return Residuals(self.error + other.error, self.weight + other.weight)

    def mean(self) -> np.ndarray:
        """(F,) mean absolute error that each triangle's splats show; NaN where too little."""
        known = self.weight >= MIN_WEIGHT_PX
        return np.where(known, self.error / np.where(known, self.weight, 1.0), np.nan)


def triangle_residuals(
    avatar: Avatar,
    capture: Capture,
    views: Iterable[View],
    prepare: Preparation | None = None,
    scale: float = 1.0,
) -> Residuals:
    """Residuals of the avatar in the views; prepare: as in training; scale: size of the images
    compared. A pixel's error is divided among its splats by their blending weights."""
    splats = avatar.splats
    count = len(avatar.faces)
    buffers = BufferPool()
    total = Residuals(*np.zeros((2, count)))
    background = np.array(avatar.background, np.float32)
    colored = Parameters(
        *(np.ascontiguousarray(getattr(splats, name)) for name in Parameters._fields)
    )
    # Gray: a color clamped at black would have no gradient. The blending weights do not depend on
    # colors.
    gray = colored._replace(sh=np.zeros_like(splats.sh))
    gradients = Parameters(*(np.zeros_like(array) for array in colored))
    red, green, blue = (round(255 * level) for level in avatar.background)
    for view in views:
        scaled, target, mask = read_view(view, scale, (red, green, blue))
        if prepare is not None:
            target, _ = prepare(scaled, target, mask)
        mesh = capture.mesh(view.timestep)
        frames = frames_in_camera(avatar.frames(mesh), scaled.camera)
        render = partial(
            render_forward,
            face=splats.face,
            background=background,
            antialiased=avatar.antialiased,
            buffers=buffers,
        )
        image = render(colored, frames=frames, degree=splats.sh_degree).image
        expected = target.transpose(2, 0, 1).astype(np.float32) / 255
        difference = np.abs(np.clip(image, 0, 1) - expected).mean(0)
        # The gradient with respect to a color is the sum of blending weights times that with
        # respect to the image.
        v_image = np.stack([difference, np.ones_like(difference), np.zeros_like(difference)])
        frames = frames._replace(color=NO_COLUMNS)
        output = render(gray, frames=frames, degree=0)
        rows, _ = render_backward(
            output, gray, splats.face, frames, v_image, gradients, buffers=buffers
        )
        by_splat = gradients.sh[rows, 0, :2].astype(np.float64) / SH_C0
        face = splats.face[rows]
        total += Residuals(*(np.bincount(face, column, count) for column in by_splat.T))
    return total
