"""Statistics of sampled colors: how much of their variation an effect could explain."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...avatar.strain import range_with_margin
from .samples import Samples

FOLDS = 4
MIN_SAMPLES_PER_TRIANGLE = 6
CAMERA_FIT_ITERATIONS = 30
"""Alternations between cameras and triangles; cameras on opposite sides share few triangles, so it
converges slowly."""
CAMERA_PRIOR_SAMPLES = 5.0
"""Weight, in samples, of the prior that a camera is like the others."""
TYPICAL_LEVEL = 100.0
"""Of a color, in levels of 255; scales the prior of a gain."""
MIN_EXPOSURE_LEVELS = 1.5
"""Gain in levels of 255 from which differences between cameras, or in time, are corrected."""
OFFSET_PENALTY = 0.05
"""Favors gains over offsets: cameras differ in exposure and white balance more than in their black
level, and where all colors are alike, nothing else separates the two."""
RELATIVE_CHANGE_BIAS_LEVELS = 32.0
"""Added to a color before its change is taken relative to it."""
ROUNDING_LEVELS = 12**-0.5
"""Root mean square error of colors in whole levels; none is known better."""
RIDGE_WEIGHT = 1.0
"""Of a triangle's coefficients, in units of a feature's variance over all triangles."""


@dataclass(frozen=True)
class Evidence:
    """Root mean square errors, in levels of 255, of colors that a model was not fitted to: without
    it and with it."""

    before: float
    after: float

    @property
    def gain(self) -> float:
        """Root mean square, in levels of 255, of the error that the model removes; 0 where it adds
        error."""
        return math.sqrt(max(0.0, self.before**2 - self.after**2))

    @property
    def share(self) -> float:
        """Explained share of the error's variance."""
        return (self.gain / max(self.before, 1e-9)) ** 2

    @property
    def decibels(self) -> float:
        """By how much PSNR rises with the model; negative where it adds error."""
        before, after = (max(error, ROUNDING_LEVELS) for error in (self.before, self.after))
        return 20 * math.log10(before / after)


def compare(before: np.ndarray, after: np.ndarray) -> Evidence:
    """Evidence from the errors (…) on the same samples without and with a model; zero without
    samples."""
    if not before.size:
        return Evidence(0.0, 0.0)
    return Evidence(float(np.sqrt(np.mean(before**2))), float(np.sqrt(np.mean(after**2))))


@dataclass(frozen=True)
class CameraColors:
    """Cameras (C,), and per camera and channel the gain (C, 3) and offset (C, 3), in levels, of its
    images against the mean of all cameras, for which they are 1 and 0."""

    camera: np.ndarray
    gain: np.ndarray
    offset: np.ndarray

    def undo(self, color: np.ndarray, camera: np.ndarray) -> np.ndarray:
        """color (S, K, 3) of the cameras (S,), as the mean camera would have seen it."""
        row = np.searchsorted(self.camera, camera)
        return np.asarray((color - self.offset[row][:, None]) / self.gain[row][:, None])


def fit_cameras(samples: Samples, color: np.ndarray) -> CameraColors:
    """Gains and offsets from color (S, K, 3), NaN where not seen: least squares, cameras and
    triangles in turn."""
    camera, row = np.unique(samples.camera, return_inverse=True)
    fitted = CameraColors(camera, np.ones((len(camera), 3)), np.zeros((len(camera), 3)))
    for _ in range(CAMERA_FIT_ITERATIONS):
        mean = _mean(fitted.undo(color, samples.camera))
        fits = [
            _line(np.broadcast_to(mean, color[row == c].shape), color[row == c])
            for c in range(len(camera))
        ]
        gain, offset = np.array([fit[0] for fit in fits]), np.array([fit[1] for fit in fits])
        gain /= gain.mean(0)
        fitted = CameraColors(camera, gain, offset - offset.mean(0))
    return fitted


def _line(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain (3,) and offset (3,) of y ≈ gain·x + offset over the samples (…, 3) that are not NaN."""
    x, y = x.reshape(-1, 3), y.reshape(-1, 3)
    known = ~np.isnan(y[:, 0]) & ~np.isnan(x[:, 0])
    x, difference = x[known], (y - x)[known]
    xx, xo = (x**2).sum(0) + CAMERA_PRIOR_SAMPLES * TYPICAL_LEVEL**2, x.sum(0)
    oo = len(x) * (1 + OFFSET_PENALTY) + CAMERA_PRIOR_SAMPLES
    dx, do = (x * difference).sum(0), difference.sum(0)
    determinant = xx * oo - xo**2
    return 1 + (oo * dx - xo * do) / determinant, (xx * do - xo * dx) / determinant


def camera_evidence(samples: Samples, color: np.ndarray) -> Evidence:
    """Whether cameras fitted to half of the triangles make images of the others agree."""
    half = np.arange(len(samples.faces)) % 2 == 0
    fitted = fit_cameras(samples, np.where(half[:, None], color, np.nan))
    other = color[:, ~half]
    return compare(_scatter(other), _scatter(fitted.undo(other, samples.camera)))


def stable_colors(color: np.ndarray) -> np.ndarray:
    """color (S, K, 3) of the half of the triangles with the least relative change of color, NaN for
    the others.

    Lids, lips and whatever the mesh does not follow change ten times as much as cameras differ.
    """
    mean = _mean(color)
    change = ((color - mean) / (mean + RELATIVE_CHANGE_BIAS_LEVELS)) ** 2
    seen = ~np.isnan(color[..., 0])
    count = seen.sum(0)
    scatter = np.where(seen[..., None], change, 0).sum((0, 2)) / (3 * np.maximum(count, 1))
    judged = count >= MIN_SAMPLES_PER_TRIANGLE
    limit = np.median(scatter[judged]) if judged.any() else -1.0
    return np.where((judged & (scatter <= limit))[:, None], color, np.nan)


def fit_drift(samples: Samples, color: np.ndarray) -> np.ndarray:
    """Gains (S, 3) of the views against their camera's mean, from color (S, K, 3), NaN where not
    seen."""
    known, gain = ~np.isnan(color), np.ones((len(color), 3))
    prior = CAMERA_PRIOR_SAMPLES * TYPICAL_LEVEL**2
    _, row = np.unique(samples.camera, return_inverse=True)
    for _ in range(CAMERA_FIT_ITERATIONS):
        mean = np.where(known, _mean(color / gain[:, None]), 0)
        gain = (np.where(known, color * mean, 0).sum(1) + prior) / ((mean**2).sum(1) + prior)
        usual = np.stack([gain[row == camera].mean(0) for camera in range(row.max() + 1)])
        gain /= usual[row]
    return gain


def drift_evidence(samples: Samples, color: np.ndarray) -> Evidence:
    """Whether gains fitted to one half of the triangles, at the timesteps before and after, make
    the images of the other half agree: takes in no order, and expressions, do not drift."""
    half = np.arange(len(samples.faces)) % 2 == 0
    gain = fit_drift(samples, np.where(half[:, None], color, np.nan))
    predicted = np.ones_like(gain)
    for row, (camera, timestep) in enumerate(zip(samples.camera, samples.timestep, strict=True)):
        others = np.flatnonzero((samples.camera == camera) & (samples.timestep != timestep))
        others = others[np.argsort(samples.timestep[others])]
        if len(others):
            known, columns = samples.timestep[others], gain[others].T
            predicted[row] = [np.interp(timestep, known, column) for column in columns]
    other = color[:, ~half]
    return compare(_scatter(other), _scatter(other / predicted[:, None]))


def _scatter(color: np.ndarray) -> np.ndarray:
    """Deviations from each triangle's mean of color (S, K, 3), where known."""
    away = color - _mean(color)
    return np.asarray(away[~np.isnan(away)])


Fold = tuple[np.ndarray, np.ndarray]
"""Views (S,) bool that are held out, and views (S,) bool that the model is fitted to meanwhile."""


def scattered_folds(group: np.ndarray) -> list[Fold]:
    """FOLDS folds of the groups (S,), of which each takes every fourth: for groups without an
    order, as cameras are."""
    groups = np.unique(group)
    number = np.searchsorted(groups, group) % FOLDS
    return [(number == fold, number != fold) for fold in range(min(FOLDS, len(groups)))]


def consecutive_folds(timestep: np.ndarray) -> list[Fold]:
    """FOLDS folds of consecutive timesteps (S,); a model is not fitted to the timesteps directly
    beside them either.

    What changes slowly is alike in neighboring timesteps, so that they say nothing of unseen ones.
    A fold that leaves nothing to fit is left out.
    """
    timesteps = np.unique(timestep)
    order = np.searchsorted(timesteps, timestep)
    count = min(FOLDS, len(timesteps))
    folds = []
    for fold in range(count):
        held = order * count // len(timesteps) == fold
        fitted = (order < order[held].min() - 1) | (order > order[held].max() + 1)
        if fitted.any():
            folds.append((held, fitted))
    return folds


def linear_evidence(
    color: np.ndarray,
    features: np.ndarray,
    folds: Sequence[Fold],
    max_error: float = np.inf,
    rest: np.ndarray | None = None,
) -> Evidence:
    """Whether each triangle's color follows its features linearly, by cross-validation.

    color (S, K, 3), NaN where not seen; features (S, K, D); folds: views that are held out, and
    those that the model is fitted to meanwhile; errors of more than `max_error` times the median
    are clipped to that; rest (K, D): features of views that are held out are clipped to the range,
    with its margin, of those that the model was fitted to, as an avatar's strain is.
    """
    before, after = [], []
    for held, fitted in folds:
        # ridge regression by triangle: mean color (K, 3), NaN without a sample, mean features (K,
        # D) and slopes (K, D, 3)
        seen = ~np.isnan(color[fitted][..., :1])
        count = seen.sum(0)
        mean = np.where(seen, color[fitted], 0).sum(0) / np.where(count, count, np.nan)
        center = np.where(seen, features[fitted], 0).sum(0) / np.maximum(count, 1)
        x = np.where(seen, features[fitted] - center, 0)
        y = np.where(seen, color[fitted] - mean, 0)
        inner, size = np.einsum("skd,ske->kde", x, x), x.shape[2]
        weight = RIDGE_WEIGHT * np.einsum("kdd->", inner) / max(float(count.sum()) * size, 1.0)
        inner += max(weight, 1e-12) * np.eye(size)
        slope = np.linalg.solve(inner, np.einsum("skd,skc->kdc", x, y))
        error, given = color[held] - mean, features[held]
        if rest is not None:
            lowest, highest = range_with_margin(rest, features[fitted]).swapaxes(0, 1)
            given = np.clip(given, lowest, highest)
        predicted = np.einsum("skd,kdc->skc", given - center, slope)
        known = ~np.isnan(error)
        before.append(error[known])
        after.append((error - predicted)[known])
    errors = np.abs(np.concatenate([[], *before])), np.abs(np.concatenate([[], *after]))
    is_clipped = np.isfinite(max_error) and errors[0].size
    limit = max_error * float(np.median(errors[0])) if is_clipped else np.inf
    return compare(np.minimum(errors[0], limit), np.minimum(errors[1], limit))


def _mean(color: np.ndarray) -> np.ndarray:
    """Mean (K, 3) over the samples (S, K, 3) that are known; NaN where none is."""
    known = ~np.isnan(color)
    count = known.sum(0)
    return np.asarray(np.where(known, color, 0).sum(0) / np.where(count > 0, count, np.nan))
