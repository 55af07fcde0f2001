"""Training views in which something covers the head: a hand, a cup, a microphone."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from ...capture.model import Capture, View, views_by_camera
from ..optimize.semantic_regions import Region, head_regions
from .samples import IMAGES_AT_A_TIME, Samples, sample_view

MIN_TIMESTEPS = 12
"""Sampled timesteps without which no color of a triangle is typical."""
MIN_VISIBLE_FRACTION = 0.5
"""Fraction of the sampled views that must show a triangle: what is seen less often, such as a
chin's underside, has no typical color."""
MIN_DIFFERENCE_LEVELS = 20.0
"""Difference from a triangle's typical color, in levels of 255, up to which nothing covers it."""
MIN_DEVIATIONS = 4.0
"""The same in standard deviations of the triangle's colors."""
NEIGHBORS = 16
"""Sampled triangles, the triangle included, that are covered together."""
MIN_NEIGHBOR_FRACTION = 0.6
"""Fraction of the visible neighbors that must differ as well: highlights and wrinkles are small."""
MIN_COVERED_FRACTION = 0.03
"""Covered fraction of the head's pixels from which a view is left out: hands before real faces
cover 0.03 to 0.49, and twelve recordings without hands reach 0.025."""
MAX_COVERED_VIEWS = 0.5
"""Fraction of the sampled views above which nothing is left out: what covers a face most of the
time, such as a mask, is part of the person."""
MARGIN_VIEWS = 1
"""Views before and after a covered one that are left out as well: a hand arrives before it covers
enough."""
DARK_LEVELS = 8.0
"""Added to colors, in levels of 255, before their ratio is an exposure."""
EXPOSURE_ITERATIONS = 4
"""Alternations between typical colors and the views' exposures."""


@dataclass(frozen=True)
class TypicalColors:
    """Colors of K sampled triangles of the head while nothing covers them.

    rows       (K,) rows of `Samples.faces`
    color      (K, 3) median over the views, levels of 255
    deviation  (K,) robust standard deviation over the views, levels of 255
    neighbors  (K, NEIGHBORS) the nearest of the K triangles, each first of its own
    """

    rows: np.ndarray
    color: np.ndarray
    deviation: np.ndarray
    neighbors: np.ndarray

    def covered_fraction(self, color: np.ndarray, pixels: np.ndarray) -> float:
        """Fraction of the head's visible pixels without their typical color, in one piece;
        color (F, 3), NaN where not visible, and pixels (F,) of a view, as in `Samples`."""
        color = color[self.rows].astype(np.float64)
        visible = ~np.isnan(color[:, 0])
        if not visible.any():
            return 0.0
        even = color / _exposure(color, self.color)
        difference = np.abs(even - self.color).max(1)
        differs = difference > np.maximum(MIN_DIFFERENCE_LEVELS, MIN_DEVIATIONS * self.deviation)
        differs &= visible
        around = np.maximum(visible[self.neighbors].sum(1), NEIGHBORS / 2)
        together = differs[self.neighbors].sum(1) >= MIN_NEIGHBOR_FRACTION * around
        area = np.where(visible, pixels[self.rows], 0.0)
        return float(area[differs & together].sum() / max(area.sum(), 1e-9))


def _exposure(color: np.ndarray, typical: np.ndarray) -> np.ndarray:
    """(3,) gain of each channel of a view's colors (K, 3), NaN where not visible: a median, which a
    hand does not change."""
    return np.asarray(np.nanmedian((color + DARK_LEVELS) / (typical + DARK_LEVELS), axis=0))


def typical_colors(capture: Capture, samples: Samples) -> TypicalColors | None:
    """Typical colors of the sampled triangles of the head, but for eyes, mouth, neck and shoulders;
    None where too few views show any."""
    region = head_regions(capture).region[samples.faces]
    chosen = ~np.isin(region, (Region.MOUTH, Region.NAPE, Region.BODY))
    for name in ("left_eye", "right_eye", "mouth"):
        if name in capture.regions:
            chosen &= ~capture.regions[name][samples.faces]
    visible = ~np.isnan(samples.color[..., 0])
    chosen &= visible.mean(0) >= MIN_VISIBLE_FRACTION
    rows = np.flatnonzero(chosen)
    views = visible[:, rows].any(1)
    if len(rows) < NEIGHBORS or np.unique(samples.timestep[views]).size < MIN_TIMESTEPS:
        return None
    color = samples.color[views][:, rows].astype(np.float64)
    even = color
    for _ in range(EXPOSURE_ITERATIONS):
        typical = np.nanmedian(even, axis=0)
        even = color / np.stack([_exposure(view, typical) for view in color])[:, None]
    difference = np.abs(even - typical).max(2)
    deviation = 1.4826 * np.nanmedian(difference, axis=0)
    centers = capture.neutral[capture.faces[samples.faces[rows]]].mean(1)
    _, neighbors = cKDTree(centers).query(centers, NEIGHBORS)
    return TypicalColors(rows, typical, deviation, neighbors)


def covered_views(capture: Capture, samples: Samples) -> list[View]:
    """Training views of single cameras in which something covers part of the head for a while, with
    their neighbors in time. Of the views that `samples` leaves out, those next to a covered one are
    read. Raises StgaError where an image cannot be read."""
    found = []
    for camera, views in views_by_camera(capture.views["train"]).items():
        sampled = samples.of_views(samples.camera == camera)
        in_order = sorted(views, key=lambda view: view.timestep)
        found += _covered_in_recording(capture, in_order, sampled)
    return found


def _covered_in_recording(capture: Capture, views: Sequence[View], samples: Samples) -> list[View]:
    """The same of one camera's views, in the order of time."""
    typical = typical_colors(capture, samples)
    if typical is None:
        return []
    rows = zip(samples.timestep.tolist(), samples.color, samples.pixels, strict=True)
    is_covered = {
        timestep: typical.covered_fraction(color, pixels) >= MIN_COVERED_FRACTION
        for timestep, color, pixels in rows
    }
    if not 0 < sum(is_covered.values()) <= MAX_COVERED_VIEWS * len(is_covered):
        return []

    def covers(view: View) -> bool:
        row = sample_view(capture, view, samples.faces)
        return typical.covered_fraction(row["color"], row["pixels"]) >= MIN_COVERED_FRACTION

    between = [view for view in views if _is_beside_covered(view.timestep, is_covered)]
    with ThreadPoolExecutor(IMAGES_AT_A_TIME) as pool:
        found = dict(
            zip((view.timestep for view in between), pool.map(covers, between), strict=True)
        )
    is_covered |= found
    covered = [is_covered.get(view.timestep, False) for view in views]
    left_out = binary_dilation(covered, iterations=MARGIN_VIEWS)
    return [view for view, is_out in zip(views, left_out.tolist(), strict=True) if is_out]


def _is_beside_covered(timestep: int, is_covered: Mapping[int, bool]) -> bool:
    """Whether a timestep that was not sampled has a covered sample before or after it."""
    before = max((each for each in is_covered if each < timestep), default=timestep)
    after = min((each for each in is_covered if each > timestep), default=timestep)
    beside = (is_covered.get(before, False), is_covered.get(after, False))
    return timestep not in is_covered and any(beside)
