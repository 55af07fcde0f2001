"""What is done to the captured images before they are trained on or compared with: the backdrop is
taken away, and exposure and white balance of the training cameras are corrected."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from ...capture.loader import Preparation
from ...capture.model import Capture, View, ViewExposure
from ..backdrop import without_backdrop
from ..settings import TrainingSettings

Correction = Callable[[View, np.ndarray, np.ndarray | None], np.ndarray]
"""(view, image (H, W, 3) uint8, mask (H, W) uint8 or None) -> corrected image (H, W, 3) uint8."""


def image_preparation(capture: Capture, settings: TrainingSettings) -> Preparation | None:
    """Takes away the settings' `backdrop`, then inverts their `exposure`; None where neither
    changes anything."""
    correct, backdrop, background = (
        exposure_correction(settings),
        settings.backdrop,
        settings.background,
    )
    if correct is None and backdrop == "plain":
        return None

    def prepare(
        view: View, image: np.ndarray, mask: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        image, mask = without_backdrop(capture, view, image, mask, backdrop, background)
        return (image if correct is None else correct(view, image, mask)), mask

    return prepare


MAX_GAIN = 4.0
EXPOSURE_PRIOR, EXPOSURE_SCALE, EXPOSURE_ITERATIONS = 1e-3, 0.08, 4
"""Weight of the usual exposure as a share of the pixels, which decides where all have one color;
and the difference in 0…1 beyond which pixels are outliers."""


def fit_exposure(
    drawn: np.ndarray,
    seen: np.ndarray,
    usual: np.ndarray | None = None,
    share: float = EXPOSURE_PRIOR,
) -> np.ndarray:
    """(2, 3) gain and offset of each channel with which colors (3, N) become those of a camera.

    In 0…1; robust (Geman-McClure). usual: what is expected (None: gain 1, offset 0), with the
    weight of a share of the pixels.
    """
    usual = np.array([[1.0] * 3, [0.0] * 3]) if usual is None else usual
    if not drawn.size:
        return usual
    found = usual
    for _ in range(EXPOSURE_ITERATIONS):
        columns = []
        for channel, (x, y) in enumerate(zip(drawn, seen, strict=True)):
            residual = y - found[0, channel] * x - found[1, channel]
            weight = (1 + (residual / EXPOSURE_SCALE) ** 2) ** -2.0
            system = np.stack([x, np.ones_like(x)])
            matrix = (weight * system) @ system.T
            prior = share * weight.sum() * np.diag([x.var() + 1e-4, 1.0])
            right = system @ (weight * y) + prior @ usual[:, channel]
            columns.append(np.linalg.solve(matrix + prior, right))
        found = np.stack(columns, axis=1)
        found[0] = np.clip(found[0], 1 / MAX_GAIN, MAX_GAIN)
    return found


def view_exposure(rows: Iterable[Sequence[float]]) -> ViewExposure:
    """Exposure of the cameras in `TrainingSettings.exposure`, where it drifts interpolated between
    timesteps."""
    listed: dict[int, list[Sequence[float]]] = {}
    for row in rows:
        listed.setdefault(int(row[0]), []).append(row[1:])
    curves = {
        camera: np.array(sorted(((*row, 0.0)[6], *row[:6]) for row in own)).T
        for camera, own in listed.items()
    }

    def exposure(view: View) -> np.ndarray | None:
        if view.camera_index not in curves:
            return None
        timesteps, *columns = curves[view.camera_index]
        return np.array(
            [np.interp(view.timestep, timesteps, column) for column in columns]
        ).reshape(2, 3)

    return exposure


def exposure_correction(settings: TrainingSettings) -> Correction | None:
    """The correction that inverts the settings' `exposure`; None if there is none.

    It applies to the foreground only, because the background is constant whatever the camera.
    Images of cameras that the settings do not list stay unchanged.
    """
    if not settings.exposure:
        return None
    exposure = view_exposure(settings.exposure)
    background = 255 * np.array(settings.background, np.float32)

    def correct(view: View, image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        known = exposure(view)
        if known is None:
            return image
        gain, offset = known.astype(np.float32)
        cover = np.float32(1) if mask is None else mask[..., None].astype(np.float32) / 255
        background_part = (1 - cover) * background
        corrected = (image - background_part - cover * offset) / gain + background_part
        return np.asarray(np.clip(corrected, 0, 255) + 0.5).astype(np.uint8)

    return correct
