"""What is done to the captured images before they are trained on or compared with: the backdrop is
taken away by masks or, without masks, by the tracked mesh, and exposure and white balance of the
training cameras are corrected."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from ...capture.green_screen import limited_channel, screen_channel
from ...capture.loader import Preparation
from ...capture.mesh_geometry import silhouette
from ...capture.model import Capture, View, ViewExposure
from ...tracking.appearance import mean_around
from ..settings import TrainingSettings

Correction = Callable[[View, np.ndarray, np.ndarray | None], np.ndarray]
"""(view, image (H, W, 3) uint8, mask (H, W) uint8 or None) -> corrected image (H, W, 3) uint8."""
BLUR_FRACTIONS = (0.01, 0.05)
"""Standard deviations of the neighborhoods that a pixel's backdrop is the mean of, as fractions of
the image's height: the larger one counts where the smaller one holds no backdrop."""
NO_CORRECTION = np.array([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
"""Gain and offset by channel."""
MAX_GAIN = 4.0
"""Largest gain of an image's exposure; the least is its inverse."""
EXPOSURE_PRIOR = 1e-3
"""Weight of an unchanged exposure as a fraction of the pixels, which decides where all have one
color."""
EXPOSURE_SCALE = 0.08
"""Difference in 0…1 beyond which pixels are outliers."""
EXPOSURE_ITERATIONS = 4
"""Reweighted least squares fits of an exposure."""


def image_preparation(capture: Capture, settings: TrainingSettings) -> Preparation | None:
    """Takes away the settings' `backdrop`, inverts their `exposure`; None where nothing changes."""
    backdrop = settings.backdrop
    background = settings.background
    correct = exposure_correction(settings)
    if correct is None and backdrop == "plain":
        return None

    def prepare(
        view: View, image: np.ndarray, mask: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        image, mask = without_backdrop(capture, view, image, mask, backdrop, background)
        return (image if correct is None else correct(view, image, mask)), mask

    return prepare


def without_backdrop(
    capture: Capture,
    view: View,
    image: np.ndarray,
    mask: np.ndarray | None,
    backdrop: str,
    background: Sequence[float],
) -> tuple[np.ndarray, np.ndarray | None]:
    """Image (H, W, 3) uint8 and mask (H, W) uint8 as training sees them: over the color
    `background` (0…1).

    view: with a camera of the image's size; backdrop: one of `settings.BACKDROPS`. "plain" images
    are returned as they are.
    """
    if backdrop == "plain" or (mask is None and backdrop == "masked"):
        return image, mask
    if mask is None:
        mesh = np.asarray(capture.mesh(view.timestep))
        mask = 255 * silhouette(mesh, capture.faces, view.camera).astype(np.uint8)
    return over_color(image, mask, background), mask


def over_color(image: np.ndarray, mask: np.ndarray, color: Sequence[float]) -> np.ndarray:
    """The masked part of an image (H, W, 3) uint8 over a color (0…1); mask (H, W) uint8 coverage.

    image = coverage · foreground + (1 − coverage) · backdrop, where the backdrop of a pixel is the
    mean of those pixels around it that show nothing else; only this second term is exchanged, and
    the light of a green screen is taken from the first. A mask's soft edge thus keeps no rim of the
    backdrop's color.
    """
    import cv2

    beside = _levels(255 * np.asarray(color, np.float32))
    over = cv2.merge([np.full_like(mask, level) for level in beside])
    cv2.copyTo(image, mask, over)
    edge = cv2.findNonZero(cv2.inRange(mask, 1, 254))
    if edge is not None:
        columns, rows = edge.reshape(-1, 2).T
        places = rows, columns
        cover = mask[places][:, None].astype(np.float32) / 255
        foreground = cover * image[places]
        if not mask.all():
            deviations = [max(1.0, fraction * len(image)) for fraction in BLUR_FRACTIONS]
            clear = (mask == 0).astype(np.uint8)
            behind = mean_around(image, clear, deviations, np.stack(places, axis=1))
            foreground = np.clip(image[places] - (1 - cover) * behind, 0, 255 * cover)
            if (key := screen_channel(image, mask)) is not None:
                foreground = limited_channel(foreground, key)
        rest = (1 - cover) * 255 * np.asarray(color, np.float32)
        over[places] = _levels(foreground + rest)
    return np.asarray(over)


def _levels(values: np.ndarray) -> np.ndarray:
    """Rounded, uint8."""
    return np.asarray(np.clip(values, 0, 255) + 0.5).astype(np.uint8)


def fit_exposure(
    drawn: np.ndarray,
    observed: np.ndarray,
    expected: np.ndarray | None = None,
    fraction: float = EXPOSURE_PRIOR,
) -> np.ndarray:
    """(2, 3) gain and offset of each channel with which colors (3, N) become those of a camera.

    In 0…1; robust (Geman-McClure). expected: prior of both (None: gain 1, offset 0), with the
    weight of a fraction of the pixels.
    """
    expected = NO_CORRECTION if expected is None else expected
    found = expected
    for _ in range(EXPOSURE_ITERATIONS if drawn.size else 0):
        gain, offset = found[..., None]
        weight = (1 + ((observed - gain * drawn - offset) / EXPOSURE_SCALE) ** 2) ** -2.0
        prior = fraction * weight.sum(1) * np.stack([drawn.var(1) + 1e-4, np.ones(3)])
        found = fit_lines(drawn, observed, prior, expected, weight)
        found[0] = np.clip(found[0], 1 / MAX_GAIN, MAX_GAIN)
    return found


def fit_lines(
    x: np.ndarray,
    y: np.ndarray,
    prior: np.ndarray,
    expected: np.ndarray = NO_CORRECTION,
    weight: np.ndarray | None = None,
) -> np.ndarray:
    """(2, 3) gain and offset of each channel by least squares, y ≈ gain · x + offset of samples (3,
    N) with a weight (3, N).

    prior: (2, 3), or what broadcasts to it, the weight in samples of the `expected` (2, 3).
    """
    system = np.stack([x, np.ones_like(x)], axis=1)
    weighted = system if weight is None else system * weight[:, None]
    prior = np.broadcast_to(np.asarray(prior), (2, 3)).T
    right = np.einsum("cin,cn->ci", weighted, y) + prior * expected.T
    inner = weighted @ system.swapaxes(1, 2) + prior[:, :, None] * np.eye(2)
    return np.asarray(np.linalg.solve(inner, right[..., None])[..., 0].T)


def view_exposure(rows: Iterable[Sequence[float]]) -> ViewExposure:
    """Exposure of a view from rows of `TrainingSettings.exposure`; where it drifts, interpolated
    between timesteps."""
    listed: dict[int, list[Sequence[float]]] = {}
    for row in rows:
        listed.setdefault(int(row[0]), []).append(row[1:])
    rows_of = {
        n: sorted(((*row, 0.0)[6], *row[:6]) for row in curve_rows)
        for n, curve_rows in listed.items()
    }
    curves = {camera: np.array(curve_rows).T for camera, curve_rows in rows_of.items()}

    def exposure(view: View) -> np.ndarray | None:
        if view.camera_index not in curves:
            return None
        timesteps, *columns = curves[view.camera_index]
        found = [np.interp(view.timestep, timesteps, column) for column in columns]
        return np.array(found).reshape(2, 3)

    return exposure


def exposure_correction(settings: TrainingSettings) -> Correction | None:
    """Inverts the settings' `exposure` of the foreground, in images of cameras listed, if any."""
    if not settings.exposure:
        return None
    exposure = view_exposure(settings.exposure)
    background = 255 * np.array(settings.background, np.float32)

    def correct(view: View, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        known = exposure(view)
        if known is None:
            return image
        import cv2

        gain, offset = known.astype(np.float32)

        def inverted(pixels: np.ndarray, cover: np.ndarray) -> np.ndarray:
            rest = (1 - cover) * background
            return _levels((pixels - rest - cover * offset) / gain + rest)

        every = np.arange(256, dtype=np.float32)[:, None, None]  # levels
        corrected = cv2.LUT(image, inverted(every, np.ones(1, np.float32)))
        if mask is None:
            return np.asarray(corrected)
        outside = cv2.LUT(image, inverted(every, np.zeros(1, np.float32)))
        cv2.copyTo(outside, (mask == 0).astype(np.uint8), corrected)
        edge = (mask > 0) & (mask < 255)
        corrected[edge] = inverted(image[edge], mask[edge][:, None].astype(np.float32) / 255)
        return np.asarray(corrected)

    return correct
