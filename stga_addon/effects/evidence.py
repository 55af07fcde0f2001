"""How much of the differences between images of the same triangle has a cause that an effect can follow."""

import warnings
from dataclasses import dataclass

import numpy as np

from .samples import Samples

FOLDS = 4
FEWEST = 6
"""A triangle seen less often than this says nothing."""
ROUNDS = 30
"""Of fitting the cameras to the triangles' colours and these to the cameras: far cameras share few triangles."""
PRIOR = 5.0
"""Samples' worth of belief that a camera is like the others."""
TYPICAL = 100.0
"""Level of a typical colour."""
BLACK = 0.05
"""How far an offset is doubted: cameras differ in exposure and white balance, which are gains, more than in what black
is; and where all colours are alike, nothing else tells the two apart."""
DARK = 32.0
"""Levels that are added to a colour before asking by what share of it it changes."""
RIDGE = 1.0
"""The same for a triangle's coefficients, in units of a feature's variance over all triangles."""


@dataclass(frozen=True)
class Evidence:
    """What a model explains of colours that it was not fitted to.

    gain   root mean square, in levels of 255, of what the model takes away from the error; 0 where it only adds
    error  root mean square of what was there before
    """

    gain: float
    error: float

    @property
    def share(self) -> float:
        """Explained share of the error's variance."""
        return (self.gain / max(self.error, 1e-9)) ** 2


def compare(before: np.ndarray, after: np.ndarray) -> Evidence:
    """From errors (…) of two models on the same samples; nothing is explained where there are none."""
    if not before.size:
        return Evidence(0.0, 0.0)
    least, most = float(np.mean(before**2)), float(np.mean(after**2))
    return Evidence(float(np.sqrt(max(0.0, least - most))), float(np.sqrt(least)))


@dataclass(frozen=True)
class CameraColors:
    """Cameras (C,), and per camera and channel the gain (C, 3) and offset (C, 3), in levels, of its images against
    the mean of all cameras, for which they are 1 and 0."""

    camera: np.ndarray
    gain: np.ndarray
    offset: np.ndarray

    def undo(self, color: np.ndarray, camera: np.ndarray) -> np.ndarray:
        """color (S, K, 3) of the cameras (S,), as the mean camera would have seen it."""
        row = np.searchsorted(self.camera, camera)
        return np.asarray((color - self.offset[row][:, None]) / self.gain[row][:, None])


def fit_cameras(samples: Samples, color: np.ndarray) -> CameraColors:
    """Gains and offsets from color (S, K, 3), NaN where not seen: least squares, cameras and triangles in turn."""
    camera, row = np.unique(samples.camera, return_inverse=True)
    found = CameraColors(camera, np.ones((len(camera), 3)), np.zeros((len(camera), 3)))
    for _ in range(ROUNDS):
        mean = _mean(found.undo(color, samples.camera))
        fits = [_line(np.broadcast_to(mean, color[row == c].shape), color[row == c]) for c in range(len(camera))]
        gain, offset = np.array([fit[0] for fit in fits]), np.array([fit[1] for fit in fits])
        gain /= gain.mean(0)
        found = CameraColors(camera, gain, offset - offset.mean(0))
    return found


def _line(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain (3,) and offset (3,) of y ≈ gain·x + offset over the samples (…, 3) that are not NaN."""
    x, y = x.reshape(-1, 3), y.reshape(-1, 3)
    known = ~np.isnan(y[:, 0]) & ~np.isnan(x[:, 0])
    x, difference = x[known], (y - x)[known]
    xx, xo, oo = (x**2).sum(0) + PRIOR * TYPICAL**2, x.sum(0), len(x) * (1 + BLACK) + PRIOR
    dx, do = (x * difference).sum(0), difference.sum(0)
    determinant = xx * oo - xo**2
    return 1 + (oo * dx - xo * do) / determinant, (xx * do - xo * dx) / determinant


def camera_evidence(samples: Samples, color: np.ndarray) -> Evidence:
    """Whether cameras fitted to one half of the triangles bring the images of the other half together."""
    half = np.arange(len(samples.faces)) % 2 == 0
    fitted = fit_cameras(samples, np.where(half[:, None], color, np.nan))
    other = color[:, ~half]
    return compare(_scatter(other), _scatter(fitted.undo(other, samples.camera)))


def calm(color: np.ndarray) -> np.ndarray:
    """color (S, K, 3) of the half of the triangles that changes least for how bright it is, NaN for the others.

    Lids, lips and whatever the mesh does not follow change by ten times as much as anything a camera does.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # triangles that no view shows
        mean = np.nanmean(color, axis=0)
        scatter = np.nanmean(((color - mean) / (mean + DARK)) ** 2, axis=(0, 2))
        scatter[(~np.isnan(color[..., 0])).sum(0) < FEWEST] = np.nan
        return np.where((scatter <= np.nanmedian(scatter))[:, None], color, np.nan)


def _scatter(color: np.ndarray) -> np.ndarray:
    """Deviations from each triangle's mean of color (S, K, 3), where known."""
    away = color - _mean(color)
    return np.asarray(away[~np.isnan(away)])


def linear_evidence(color: np.ndarray, features: np.ndarray, group: np.ndarray, largest: float = np.inf) -> Evidence:
    """Whether each triangle's colour follows its features linearly, in views that the fit did not see.

    color (S, K, 3), NaN where not seen; features (S, K, D); group (S,): views that are left out together; errors of
    more than `largest` times the median one count as no more than that.
    """
    before, after = [], []
    fold = np.searchsorted(np.unique(group), group) % min(FOLDS, len(np.unique(group)))
    for left_out in np.unique(fold):
        held = fold == left_out
        mean, centre, slope = _ridge(color[~held], features[~held])
        error = color[held] - mean
        predicted = np.einsum("skd,kdc->skc", features[held] - centre, slope)
        known = ~np.isnan(error)
        before.append(error[known])
        after.append((error - predicted)[known])
    errors = np.abs(np.concatenate(before)), np.abs(np.concatenate(after))
    limit = largest * float(np.median(errors[0])) if np.isfinite(largest) and errors[0].size else np.inf
    return compare(np.minimum(errors[0], limit), np.minimum(errors[1], limit))


def _ridge(color: np.ndarray, features: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per triangle mean colour (K, 3), mean features (K, D) and slopes (K, D, 3); NaN mean where there is no sample."""
    seen = ~np.isnan(color[..., :1])
    count = seen.sum(0)
    with np.errstate(invalid="ignore"):
        mean = np.where(seen, color, 0).sum(0) / np.where(count, count, np.nan)
        centre = np.where(seen, features, 0).sum(0) / np.maximum(count, 1)
    x, y = np.where(seen, features - centre, 0), np.where(seen, color - mean, 0)
    inner = np.einsum("skd,ske->kde", x, x)
    weight = RIDGE * np.einsum("kdd->", inner) / max(float(count.sum()) * x.shape[2], 1.0)
    inner += max(weight, 1e-12) * np.eye(x.shape[2])
    return mean, centre, np.linalg.solve(inner, np.einsum("skd,skc->kdc", x, y))


def _mean(color: np.ndarray) -> np.ndarray:
    """Mean (K, 3) over the samples (S, K, 3) that are known; NaN where none is."""
    known = ~np.isnan(color)
    count = known.sum(0)
    return np.asarray(np.where(known, color, 0).sum(0) / np.where(count > 0, count, np.nan))
