"""Matte of one image: the coverage of each pixel by the person whose head was tracked.

What is likely the person (by a network, or by the difference from a clean plate) and the tracked
head are the seeds of OpenCV's GrabCut (Rother et al. 2004), which finds the outline in between. In
a band along it, coverage is that share of the way from the backdrop's color around the pixel to the
person's that the pixel's color lies at; where both colors are alike, the band is a smooth edge.
"""

from typing import Any

import numpy as np
from scipy.ndimage import binary_fill_holes

LIKELY, SURE, UNLIKELY = 0.5, 0.9, 0.1
"""Probabilities of a person."""
MAX_CUT_SIDE_PX = 400
"""GrabCut works on images of at most this size, since its time grows with the pixels; the band is
of full size."""
CUT_ITERATIONS = 2
CUT_MARGIN_SHARE = 0.04
"""Error of the network's outline, as a share of the head's size (root of its area in the image)."""
HEAD_MARGIN_SHARE = 0.06
"""Error of the tracked head's outline, as a share of the head's size: that far inside it, pixels
are surely the person's."""
BAND_SHARE = 0.018
"""Half of the soft band's width, as a share of the head's size."""
NEIGHBORHOOD_SHARES = (0.03, 0.12)
"""Standard deviations of the neighborhoods that the colors on both sides are means of, as shares of
the head's size."""
FAR_WEIGHT = 0.02
MIN_NEIGHBORHOOD_PX = 2.0
"""Standard deviation of the smaller neighborhood, in pixels of the image that means are taken
of."""
REACH_SHARE = 1.0
"""Distance from the head, as a share of its size, beyond which there is no hair; clothes reach
farther, but below."""
SIMILAR_COLORS_LEVELS = 30.0
"""Difference of the colors on both sides, at which half of the coverage is that of a smooth
edge."""
PLATE_NOISE_LEVELS, PLATE_SURE_LEVELS = 10.0, 40.0
"""Differences from a clean plate, in levels of 255, that noise makes, and that only a person
does."""
MAX_HOLE_SHARE = 0.01
"""Area of a hole in the person, as a share of the head's, up to which it is filled: highlights and
patterned cloth."""


def find_matte(image: np.ndarray, probability: np.ndarray, head: np.ndarray) -> np.ndarray:
    """Matte (H, W) uint8, 255 on the person, of an image (H, W, 3) uint8 sRGB.

    probability (H, W) float32 in 0…1, of a person; head (H, W) bool, the pixels of the tracked
    head.
    """
    cv2 = _opencv()
    size = np.sqrt(max(head.sum(), 1.0))
    scale = min(1.0, MAX_CUT_SIDE_PX / max(image.shape[:2]))
    height, width = (max(1, round(scale * side)) for side in image.shape[:2])

    def small(values: np.ndarray) -> Any:
        return cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA)

    person = _cut(
        cv2, small(image), small(probability), small(head.astype(np.float32)) > 0.5, scale * size
    )
    person = (
        cv2.resize(person.astype(np.float32), image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        > 0.5
    )
    return _soft_edge(cv2, image, person, size)


def probability_by_plate(image: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """Probability (H, W) float32 of a person, from the difference of an image from a clean plate,
    (H, W, 3) uint8."""
    cv2 = _opencv()
    difference = np.abs(
        cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32)
        - cv2.GaussianBlur(plate, (0, 0), 1.0)
    )
    share = (difference.max(axis=2) - PLATE_NOISE_LEVELS) / (PLATE_SURE_LEVELS - PLATE_NOISE_LEVELS)
    return np.asarray(np.clip(share, 0, 1), np.float32)


def _cut(
    cv2: Any, image: np.ndarray, probability: np.ndarray, head: np.ndarray, size: float
) -> np.ndarray:
    """(H, W) bool: the person; size: of the head in pixels."""
    core = _shrunk(cv2, head, HEAD_MARGIN_SHARE * size)
    margin = max(2.0, CUT_MARGIN_SHARE * size)
    surely = core | _shrunk(cv2, probability > SURE, margin)
    possibly = _grown(cv2, (probability > UNLIKELY) | head, 2 * margin) & _reach(cv2, head, size)
    marks = np.where(probability > LIKELY, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    marks[~possibly], marks[surely] = cv2.GC_BGD, cv2.GC_FGD
    if 0 < np.isin(marks, (cv2.GC_FGD, cv2.GC_PR_FGD)).mean() < 1:  # it learns the colors of both
        cv2.setRNGSeed(0)  # of the clusters that the color models begin with
        models = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(
            np.ascontiguousarray(image[..., ::-1]),
            marks,
            None,
            *models,
            CUT_ITERATIONS,
            cv2.GC_INIT_WITH_MASK,
        )
    found = (marks == cv2.GC_FGD) | (marks == cv2.GC_PR_FGD)
    return _head_part(cv2, cv2.medianBlur(found.astype(np.uint8), 3) > 0, core, head.sum())


def _reach(cv2: Any, head: np.ndarray, size: float) -> np.ndarray:
    """(H, W) bool: where hair and body may be: around the head, and below its middle."""
    around = _grown(cv2, head, REACH_SHARE * size)
    if head.any():
        around[int(np.flatnonzero(head.any(axis=1)).mean()) :] = True
    return around


def _head_part(cv2: Any, found: np.ndarray, core: np.ndarray, area: float) -> np.ndarray:
    """The connected parts of `found` that hold some of the head, without small holes."""
    _, label = cv2.connectedComponents(found.astype(np.uint8), connectivity=4)
    kept = np.isin(label, np.setdiff1d(np.unique(label[core]), [0])) if core.any() else found
    holes = binary_fill_holes(kept) & ~kept
    _, label, statistics, _ = cv2.connectedComponentsWithStats(
        holes.astype(np.uint8), connectivity=4
    )
    filled = statistics[:, cv2.CC_STAT_AREA] <= MAX_HOLE_SHARE * area
    filled[0] = False
    return np.asarray(kept | filled[label])


def _soft_edge(cv2: Any, image: np.ndarray, person: np.ndarray, size: float) -> np.ndarray:
    """(H, W) uint8: coverage in a band along the person's outline, 0 and 255 elsewhere."""
    band = max(1.0, BAND_SHARE * size)
    inside, outside = _shrunk(cv2, person, band), ~_grown(cv2, person, band)
    matte = np.where(inside, 255, 0).astype(np.uint8)
    unknown = ~inside & ~outside
    if not (unknown.any() and inside.any() and outside.any()):
        return np.where(person, 255, 0).astype(np.uint8)
    backdrop = _mean_around(cv2, image, outside, size)[unknown]
    towards = _mean_around(cv2, image, inside, size)[unknown] - backdrop
    contrast = (towards**2).sum(axis=1)
    share = ((image[unknown] - backdrop) * towards).sum(axis=1) / np.maximum(contrast, 1e-3)
    smooth = cv2.GaussianBlur(person.astype(np.float32), (0, 0), max(0.7, band / 3))[unknown]
    trust = contrast / (contrast + 3 * SIMILAR_COLORS_LEVELS**2)
    coverage = trust * np.clip(share, 0, 1) + (1 - trust) * smooth
    matte[unknown] = (255 * coverage + 0.5).astype(np.uint8)
    return matte


def _mean_around(cv2: Any, image: np.ndarray, known: np.ndarray, size: float) -> np.ndarray:
    """(H, W, 3) float32 mean of the known pixels around each pixel; those far away count where none
    is near."""
    # wide neighborhoods need few pixels
    scale = min(1.0, MIN_NEIGHBORHOOD_PX / (NEIGHBORHOOD_SHARES[0] * size))
    small = tuple(max(1, round(scale * side)) for side in image.shape[1::-1])
    weighted = cv2.resize(
        image * known[..., None].astype(np.float32), small, interpolation=cv2.INTER_AREA
    )
    weight = cv2.resize(known.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    total, norm = np.zeros_like(weighted), np.full_like(weight, 1e-9)
    for share, importance in zip(NEIGHBORHOOD_SHARES, (1.0, FAR_WEIGHT), strict=True):
        sigma = max(0.7, scale * share * size)
        total += importance * cv2.GaussianBlur(weighted, (0, 0), sigma)
        norm += importance * cv2.GaussianBlur(weight, (0, 0), sigma)
    mean = cv2.resize(total / norm[..., None], image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(mean, np.float32)


def _shrunk(cv2: Any, where: np.ndarray, pixels: float) -> np.ndarray:
    """(H, W) bool: the pixels farther than so many from the outside; the image's border is not
    outside."""
    distance = cv2.distanceTransform(where.astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(distance > pixels)


def _grown(cv2: Any, where: np.ndarray, pixels: float) -> np.ndarray:
    return ~_shrunk(cv2, ~where, pixels)


def _opencv() -> Any:
    import cv2

    return cv2
