"""Statistics of sampled colors: how much of their variation an effect could explain."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...avatar.strain import range_with_margin
from ...flame.quaternions import unit
from ...light.harmonics import basis
from ..optimize.image_preparation import fit_lines
from .samples import Samples

FOLDS = 4
"""Parts of the samples, each left out of one fit, which then predicts it."""
MIN_SAMPLES_PER_TRIANGLE = 6
"""Samples without which a triangle is left out of the fits."""
CAMERA_FIT_ITERATIONS = 30
"""Alternations between cameras and triangles, slow as opposite cameras share few triangles."""
CAMERA_PRIOR_SAMPLES = 5.0
"""Weight, in samples, of the prior that a camera is like the others."""
LIGHT_RIDGE = 1.0
"""Weight in samples of an even light."""
EXPOSURE_RIDGE = 50.0
"""Weight in samples of an even exposure of each view: where light and exposure both explain the
images, the one light does."""
TYPICAL_LEVEL = 100.0
"""Typical color in levels of 255; scales the prior of a gain."""
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
"""Weight of the ridge on a triangle's coefficients, in units of a feature's variance over all
triangles."""


@dataclass(frozen=True)
class Evidence:
    """Root mean square errors, in levels of 255, without and with a model, of held-out colors."""

    before: float
    after: float

    @property
    def gain(self) -> float:
        """Root mean square, in levels of 255, of the error that it removes, or 0."""
        return math.sqrt(max(0.0, self.before**2 - self.after**2))

    @property
    def fraction(self) -> float:
        """Explained fraction of the error's variance."""
        return (self.gain / max(self.before, 1e-9)) ** 2

    @property
    def decibels(self) -> float:
        """Gain of PSNR by the model; negative where it adds error."""
        before, after = (max(error, ROUNDING_LEVELS) for error in (self.before, self.after))
        return 20 * math.log10(before / after)


def compare(before: np.ndarray, after: np.ndarray) -> Evidence:
    """Evidence from the errors (…) on the same samples without and with a model."""
    roots = (float(np.sqrt(np.mean(error**2))) if error.size else 0.0 for error in (before, after))
    return Evidence(*roots)


@dataclass(frozen=True)
class CameraColors:
    """Cameras (C,), their gain (C, 3) and offset (C, 3) in levels, against a mean of cameras."""

    camera: np.ndarray
    gain: np.ndarray
    offset: np.ndarray

    def undo(self, color: np.ndarray, camera: np.ndarray) -> np.ndarray:
        """color (S, K, 3) of the cameras (S,), as their mean would have seen it."""
        row = np.searchsorted(self.camera, camera)
        return (color - self.offset[row][:, None]) / self.gain[row][:, None]

    def against(self, chosen: np.ndarray) -> "CameraColors":
        """The same against the mean of the cameras that are chosen (C,) bool."""
        gain = self.gain / self.gain[chosen].mean(0)
        offset = self.offset - self.offset[chosen].mean(0) * gain
        return CameraColors(self.camera, gain, offset)


def fit_cameras(samples: Samples, color: np.ndarray) -> CameraColors:
    """From color (S, K, 3), NaN if unseen, by least squares: cameras and triangles in turn; against
    the mean of all."""
    camera, row = np.unique(samples.camera, return_inverse=True)
    fitted = CameraColors(camera, np.ones((len(camera), 3)), np.zeros((len(camera), 3)))
    for _ in range(CAMERA_FIT_ITERATIONS):
        mean = _mean(fitted.undo(color, samples.camera))
        fits = []
        for number in range(len(camera)):
            colors = color[row == number].reshape(-1, 3)
            x = np.broadcast_to(mean, color[row == number].shape).reshape(-1, 3)
            known = ~np.isnan(colors[:, 0]) & ~np.isnan(x[:, 0])
            offset_prior = CAMERA_PRIOR_SAMPLES + OFFSET_PENALTY * known.sum()
            prior = [[CAMERA_PRIOR_SAMPLES * TYPICAL_LEVEL**2], [offset_prior]]
            fits.append(fit_lines(x[known].T, colors[known].T, np.array(prior)))
        gain, offset = np.stack(fits, axis=1)
        fitted = CameraColors(camera, gain, offset).against(np.ones(len(camera), bool))
    return fitted


def camera_evidence(samples: Samples, color: np.ndarray) -> Evidence:
    """Whether cameras fitted to half of the triangles make images of the others agree."""
    half = np.arange(len(samples.faces)) % 2 == 0
    fitted = fit_cameras(samples, np.where(half[:, None], color, np.nan))
    other = color[:, ~half]
    return _agreement(other, fitted.undo(other, samples.camera))


def _agreement(before: np.ndarray, after: np.ndarray) -> Evidence:
    """From the deviations of colors (S, K, 3), where known, from each triangle's mean."""
    away = [color - _mean(color) for color in (before, after)]
    return compare(*(each[~np.isnan(each)] for each in away))


def stable_colors(color: np.ndarray) -> np.ndarray:
    """color (S, K, 3) of the half of the triangles with the least relative change of color, NaN for
    the others: lids and lips change ten times as much as cameras differ."""
    mean = _mean(color)
    change = ((color - mean) / (mean + RELATIVE_CHANGE_BIAS_LEVELS)) ** 2
    observed = ~np.isnan(color[..., 0])
    count = observed.sum(0)
    scatter = np.where(observed[..., None], change, 0).sum((0, 2)) / (3 * np.maximum(count, 1))
    judged = count >= MIN_SAMPLES_PER_TRIANGLE
    limit = np.median(scatter[judged]) if judged.any() else -1.0
    return np.where((judged & (scatter <= limit))[:, None], color, np.nan)


def fit_drift(samples: Samples, color: np.ndarray) -> np.ndarray:
    """Gains (S, 3) of views against their camera's mean, from color (S, K, 3), NaN if unseen."""
    known = ~np.isnan(color)
    gain = np.ones((len(color), 3))
    prior = CAMERA_PRIOR_SAMPLES * TYPICAL_LEVEL**2
    _, row = np.unique(samples.camera, return_inverse=True)
    for _ in range(CAMERA_FIT_ITERATIONS):
        mean = np.where(known, _mean(color / gain[:, None]), 0)
        gain = (np.where(known, color * mean, 0).sum(1) + prior) / ((mean**2).sum(1) + prior)
        mean = np.stack([gain[row == camera].mean(0) for camera in range(row.max() + 1)])
        gain /= mean[row]
    return gain


def fit_turning_light(samples: Samples, color: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Factors (S, K, 3) by which light that stays falls on triangles as they turn, from color (S,
    K, 3), NaN if unseen: one light for all of them, by the normal, which is rest (K, 3) in the
    neutral mesh. What follows it is no drift of the exposure, which all triangles share wherever
    they face."""
    judged = np.flatnonzero((~np.isnan(color[..., 0])).sum(0) > 1)
    normal = unit(rest + samples.signals["normal"])
    rows = basis(normal.reshape(-1, 3))[:, 1:].reshape(*normal.shape[:2], -1)
    # logarithms of a triangle's color, a view's gain and the light add up
    gains = np.broadcast_to(np.eye(len(color))[:, None], (len(color), len(judged), len(color)))
    parts = np.concatenate([rows[:, judged], gains], axis=2)
    ridge = np.repeat([LIGHT_RIDGE, EXPOSURE_RIDGE], [rows.shape[2], len(color)])
    light = np.ones(color.shape)
    for channel in range(3):
        level = color[:, judged, channel]
        weight = np.where(np.isnan(level), 0, np.square(np.nan_to_num(level)))
        logarithm = np.log(np.maximum(np.nan_to_num(level), 1.0))
        total = np.maximum(weight.sum(0), 1e-9)
        y = logarithm - (weight * logarithm).sum(0) / total
        x = parts - np.einsum("sk,skd->kd", weight, parts) / total[:, None]
        weighted = (weight[..., None] * x).reshape(-1, x.shape[2])
        matrix = weighted.T @ x.reshape(weighted.shape)
        matrix += np.diag(ridge * max(float(weight.sum()) / max(weight.size, 1), 1e-9))
        found = np.linalg.solve(matrix, weighted.T @ y.ravel())
        light[..., channel] = np.exp(rows @ found[: rows.shape[2]])
    return light


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
            known = samples.timestep[others]
            columns = gain[others].T
            predicted[row] = [np.interp(timestep, known, column) for column in columns]
    other = color[:, ~half]
    return _agreement(other, other / predicted[:, None])


Fold = tuple[np.ndarray, np.ndarray]
"""Views (S,) bool that are held out, and views (S,) bool that the model is fitted to meanwhile."""


def scattered_folds(group: np.ndarray) -> list[Fold]:
    """Folds of every fourth of the groups (S,), which have no order, as cameras."""
    groups, rank = np.unique(group, return_inverse=True)
    number = rank % FOLDS
    return [(number == fold, number != fold) for fold in range(min(FOLDS, len(groups)))]


def consecutive_folds(timestep: np.ndarray) -> list[Fold]:
    """FOLDS folds of consecutive timesteps (S,), without those that leave nothing to fit. A model
    is not fitted to the timesteps beside them either, in which slow changes are alike."""
    timesteps, order = np.unique(timestep, return_inverse=True)
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
    """Whether each triangle's color (S, K, 3), NaN where not seen, follows its features (S, K, D)
    linearly, by cross-validation.

    Errors of more than `max_error` times the median are clipped to that; rest (K, D): features of
    views that are held out are clipped to the range, with its margin, of those that the model was
    fitted to, as an avatar's strain is.
    """
    before = []
    after = []
    for held, fitted in folds:
        # ridge regression by triangle: mean color (K, 3), NaN without a sample, mean features (K,
        # D) and slopes (K, D, 3)
        observed = ~np.isnan(color[fitted][..., :1])
        count = observed.sum(0)
        mean = np.where(observed, color[fitted], 0).sum(0) / np.where(count, count, np.nan)
        center = np.where(observed, features[fitted], 0).sum(0) / np.maximum(count, 1)
        x = np.where(observed, features[fitted] - center, 0)
        y = np.where(observed, color[fitted] - mean, 0)
        inner = np.einsum("skd,ske->kde", x, x)
        size = x.shape[2]
        weight = RIDGE_WEIGHT * np.einsum("kdd->", inner) / max(float(count.sum()) * size, 1.0)
        inner += max(weight, 1e-12) * np.eye(size)
        slope = np.linalg.solve(inner, np.einsum("skd,skc->kdc", x, y))
        error = color[held] - mean
        given = features[held]
        if rest is not None:
            lowest, highest = range_with_margin(rest, features[fitted]).swapaxes(0, 1)
            given = np.clip(given, lowest, highest)
        predicted = np.einsum("skd,kdc->skc", given - center, slope)
        known = ~np.isnan(error)
        before.append(error[known])
        after.append((error - predicted)[known])
    errors = [np.abs(np.concatenate([[], *each])) for each in (before, after)]
    is_clipped = np.isfinite(max_error) and errors[0].size
    limit = max_error * float(np.median(errors[0])) if is_clipped else np.inf
    return compare(*(np.minimum(each, limit) for each in errors))


def _mean(color: np.ndarray) -> np.ndarray:
    """Mean (K, 3) over the samples (S, K, 3) that are known; NaN where none is."""
    known = ~np.isnan(color)
    count = known.sum(0)
    return np.where(known, color, 0).sum(0) / np.where(count > 0, count, np.nan)
