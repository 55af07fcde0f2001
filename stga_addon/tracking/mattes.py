"""Mattes of a take: those of its footage, or found in its frames once the head is tracked.

A matte is the coverage of each pixel by the person whose head was tracked. What is likely the
person (by a network, or by the difference from a clean plate) and the tracked head are the seeds of
OpenCV's GrabCut (Rother et al. 2004), which finds the outline in between. In a band along it,
coverage is that fraction of the way from the backdrop's color around the pixel to the person's that
the pixel's color lies at; where both colors are alike or uneven, it is that of the cut. Hair that
stands off the head, in front of an even backdrop, has a wider band: the backdrop is seen between
its strands. A guided filter (He et al. 2013) then draws the band to the edges of the image.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_fill_holes

from ..capture.model import evenly_spread, parts_of
from ..errors import listed
from ..files import read_json, write_json
from ..worker.helpers import Step
from .appearance import box_of, mean_around, reduced, sampled
from .face_networks import PersonNetwork
from .folder import MATTES_FILE, mask_name
from .footage.model import Footage, FootageCamera, write_png
from .stages import Stage, Workers

PART_TIMESTEPS = 24
"""Timesteps of a camera that are worked on at once, at most."""
MIN_HEAD_PROBABILITY = 0.5
"""Median over the tracked head below which the network does not find the person there."""
# Probabilities of a person
LIKELY = 0.5
"""Probability from which a pixel is likely the person's."""
SURE = 0.9
"""Probability from which it certainly is."""
UNLIKELY = 0.1
"""Probability below which it certainly is not."""
MAX_CUT_SIDE_PX = 600
"""Largest side of the image that GrabCut works on, whose time grows with the pixels; the band has
all of them."""
MAX_CUT_HEAD_PX = 200
"""Largest size of the head in that image."""
CUT_ITERATIONS = 1
"""Iterations of GrabCut."""
CUT_MARGIN_FRACTION = 0.04
"""Error of the network's outline as a fraction of the head's size (root of its area in the
image)."""
HEAD_MARGIN_FRACTION = 0.06
"""Error of the tracked head's outline, of the head's size: further inside are surely persons."""
BAND_FRACTION = 0.018
"""Half of the soft band's width as a fraction of the head's size."""
HAIR_BAND_FRACTION = 0.1
"""The same within the outline where hair stands out from the tracked head: the backdrop is visible
between strands."""
HAIR_ROWS_FRACTION = 0.6
"""Upper part of the tracked head in which hair stands out, as a fraction of its height; below it
are clothes."""
OPAQUE_HAIR_FRACTION = 0.9
"""Position between the backdrop's color, 0, and the hair's, 1, from which on hair is opaque: gloss
is a little nearer to a bright backdrop."""
EVEN_COLORS_WEIGHT = 4.0
"""Weight of the variance of both sides' colors, beside SIMILAR_COLORS_LEVELS, in the confidence of
coverage by color: in front of a room and in dyed hair, a pixel's color is no evidence."""
NEIGHBORHOOD_FRACTIONS = (0.03, 0.12)
"""Standard deviations of the neighborhoods that colors are means of, as fractions of the head's
size."""
REACH_FRACTION = 1.0
"""Distance from the head that hair reaches, as a fraction of its size; clothes reach farther,
below."""
SIMILAR_COLORS_LEVELS = 30.0
"""Difference of both sides' colors at which half of the coverage is that of the cut."""
GUIDE_FRACTION = 0.012
"""Half the side of the squares in which coverage is a linear function of color, as a fraction of
the head's size."""
GUIDE_PX = 2
"""The same in the smaller image in which these functions are found."""
GUIDE_VARIANCE = 1e-3
"""Variance of colors in 0…1 that noise makes: squares of less contrast have a smooth edge."""
PLATE_NOISE_LEVELS = 10.0
"""Difference from a clean plate, of 255, that noise makes."""
PLATE_SURE_LEVELS = 40.0
"""Difference from a clean plate, of 255, that only a person makes."""
MAX_HOLE_FRACTION = 0.01
"""Area of a hole in the person, of the head's, that is filled: highlights, patterned cloth."""

BAR_FRAMES = 8
"""Number of frames, spread over the take, in each of which a bar must be of one color."""
BAR_LEVELS = 12
"""Largest difference of a pixel's channels from the bar's color, of 255: compression is noisy."""
MIN_BAR_FRACTION = 0.99
"""Fraction of the pixels of a row, or column, that have the bar's color."""
MIN_END_FRACTION = 0.5
"""Fraction of the pixels beyond a bar that have another color: a plain backdrop is no bar, because
most of the row in which hair begins is backdrop as well."""
BAR_END_PX = 2
"""Number of rows beyond a bar that compression mixes with it."""
MAX_BAR_FRACTION = 0.4
"""Fraction of the image's height, or width, up to which a bar is one."""

Sides = tuple[int, int, int, int]
"""Number of rows above and below, of columns to the left and to the right."""
HeadPixels = Callable[[int, FootageCamera], np.ndarray]
"""(timestep, camera) -> (H, W) bool: the tracked head's pixels; helping processes take it."""


def with_mattes(
    footage: Footage,
    head_pixels: HeadPixels,
    out: Path,
    source: dict[str, Any],
    workers: Workers,
) -> tuple[Footage, tuple[str, ...]]:
    """The footage with a mask for every frame, and warnings.

    Frames that have one keep it. For the others, mattes are written into the folder of the
    capture's masks and, where an interrupted call with the same `source` wrote them, read from
    there. A camera's clean plate separates the person from the backdrop, else the network. Bars of
    one color at the edges of all frames belong to nobody.
    """
    path = out / MATTES_FILE
    total = len(list(footage.views()))
    done = 0
    continues = path.exists() and read_json(path) == source
    write_json(path, source)
    unseen = list[str]()
    warnings = list[str]()
    cameras = []
    for number, camera in enumerate(footage.cameras):
        files = {t: out / mask_name(t, number) for t in camera.timesteps}
        kept = {t: file for t, file in files.items() if continues and file.exists()}
        left = [t for t in camera.timesteps if t not in kept]
        parts = [part for part in parts_of(left, PART_TIMESTEPS) if part]
        bars = bars_of(camera)
        if any(bars):
            warnings.append(_bar_warning(camera, bars))
        work = [(camera, bars, {t: files[t] for t in part}, head_pixels) for part in parts]
        done += len(kept)
        found = workers.map(_write_mattes, work, (Stage.MATTES, done, total))
        done += len(left)
        workers.report(Stage.MATTES, done, total)
        known = {t: is_recognized for part in found for t, is_recognized in part.items()}
        unseen += [f"{camera.name} at timestep {t}" for t in left if not known.get(t, True)]
        mattes = {t: file for t, file in files.items() if t in kept or t in known}
        cameras.append(replace(camera, mattes=mattes))
    warning = f"no person was recognized in {len(unseen)} frames"
    warning += f", whose mattes follow the head alone: {listed(unseen)}"
    warnings += [warning] if unseen else []
    return replace(footage, cameras=tuple(cameras)), tuple(warnings)


def bars_of(camera: FootageCamera) -> Sides:
    """Bars of one color at the edges of all frames without a mask, as in letterboxed videos."""
    images = []
    for timestep in evenly_spread(camera.timesteps, BAR_FRAMES):
        if camera.mask(timestep) is None:
            images.append(camera.image(timestep))
            if not any(_bars(images[-1:])):
                return 0, 0, 0, 0
    return _bars(images)


def _bars(images: Sequence[np.ndarray]) -> Sides:
    """Bars of images (H, W, 3) uint8 of one size."""
    if not images:
        return 0, 0, 0, 0
    frames = np.stack(images).astype(np.int16)
    across = frames.transpose(0, 2, 1, 3)
    top, bottom, left, right = (
        _bar(each) for each in (frames, frames[:, ::-1], across, across[:, ::-1])
    )
    return top, bottom, left, right


def _bar(frames: np.ndarray) -> int:
    """Number of the first rows of frames (N, H, W, 3) that a bar covers, its mixed end included."""
    color = np.median(frames[:, 0], axis=(0, 1))
    count = frames.shape[1]
    most = int(MAX_BAR_FRACTION * count)
    fractions = (np.abs(frames[:, : most + BAR_END_PX + 1] - color).max(axis=3) <= BAR_LEVELS).mean(
        2
    )
    is_bar = fractions.min(axis=0) >= MIN_BAR_FRACTION
    depth = int(np.argmin(is_bar)) if not is_bar.all() else count
    end = depth + BAR_END_PX
    if (
        not 0 < depth <= most
        or 1 - fractions[:, min(end, fractions.shape[1] - 1)].mean() < MIN_END_FRACTION
    ):
        return 0
    return end


def _bar_warning(camera: FootageCamera, bars: Sides) -> str:
    names = "above", "below", "on the left", "on the right"
    listed = ", ".join(
        f"{size} pixels {name}" for size, name in zip(bars, names, strict=True) if size
    )
    return f"{camera.name}: bars of one color belong to nobody and are left out: {listed}"


def _write_mattes(
    camera: FootageCamera, bars: Sides, files: dict[int, Path], head_pixels: HeadPixels, step: Step
) -> dict[int, bool]:
    """Write the mattes of timesteps without a mask; by those, whether a person was recognized."""
    top, bottom, left, right = bars
    size = camera.camera.height, camera.camera.width
    inside_bars = np.s_[top : size[0] - bottom, left : size[1] - right]
    plate = camera.clean_plate()
    plate = None if plate is None else np.ascontiguousarray(plate[inside_bars])
    network = PersonNetwork()
    recognized = {}
    for timestep, file in files.items():
        if camera.mask(timestep) is None:
            image = np.ascontiguousarray(camera.image(timestep)[inside_bars])
            head = np.ascontiguousarray(head_pixels(timestep, camera)[inside_bars])
            is_person = network.probability(image) if plate is None else by_plate(image, plate)
            probability = float(np.median(is_person[head])) if head.any() else 1.0
            recognized[timestep] = probability >= MIN_HEAD_PROBABILITY
            matte = np.zeros(size, np.uint8)
            matte[inside_bars] = find_matte(image, is_person, head)
            write_png(file, matte)
        step()
    return recognized


def find_matte(image: np.ndarray, probability: np.ndarray, head: np.ndarray) -> np.ndarray:
    """Matte (H, W) uint8, 255 on the person, of an image (H, W, 3) uint8 sRGB.

    probability (H, W) float32 in 0…1, of a person; head (H, W) bool, the pixels of the tracked
    head.
    """
    import cv2

    size = np.sqrt(max(head.sum(), 1.0))
    whole = image.shape[1::-1]
    scale = min(1.0, MAX_CUT_SIDE_PX / max(whole), MAX_CUT_HEAD_PX / size)
    small = tuple(max(1, round(scale * side)) for side in whole)
    pixels = cv2.resize(image, small, interpolation=cv2.INTER_AREA)
    seeds = probability, head.astype(np.float32)
    likely, heads = (reduced(seed, small) for seed in seeds)
    cut = _cut(cv2, pixels, likely, heads > 0.5, scale * size).astype(np.float32)
    person = cv2.resize(cut, whole, interpolation=cv2.INTER_LINEAR) > 0.5
    # coverage in a band along the person's outline, and what is near it
    band = max(1.0, BAND_FRACTION * size)
    matte = np.where(person, np.uint8(255), np.uint8(0))
    near = box_of(person, math.ceil(band) + 2)
    outline = person[near]
    outside = ~grown(cv2, outline, band)
    narrow = _shrunk(cv2, outline, band)
    is_hair = narrow & ~_shrunk(cv2, outline, HAIR_BAND_FRACTION * size)
    is_hair &= _may_be_hair(cv2, head, band)[near]
    inside = narrow & ~is_hair
    unknown = ~inside & ~outside
    if not (unknown.any() and inside.any() and outside.any()):
        return matte
    places = np.argwhere(unknown) + [side.start for side in near]
    deviations = [fraction * size for fraction in NEIGHBORHOOD_FRACTIONS]
    squares = cv2.pow(image.astype(np.float32), 2)
    means = []
    variance = np.zeros(len(places), np.float32)
    for known, beyond in ((outside, 1), (inside, 0)):
        everywhere = np.full(person.shape, beyond, np.uint8)
        everywhere[near] = known
        means.append(mean_around(image, everywhere, deviations, places))
        square = mean_around(squares, everywhere, deviations, places)
        variance += np.maximum(square - means[-1] ** 2, 0).sum(axis=1)
    (backdrop, color) = means
    towards = color - backdrop
    contrast = (towards**2).sum(axis=1)
    colors = image[near][unknown]
    fraction = ((colors - backdrop) * towards).sum(axis=1) / np.maximum(contrast, 1e-3)
    fraction[is_hair[unknown]] /= OPAQUE_HAIR_FRACTION
    doubt = 3 * SIMILAR_COLORS_LEVELS**2 + EVEN_COLORS_WEIGHT * variance
    trust = contrast / (contrast + doubt)
    rough = outline.astype(np.float32)
    rough[unknown] += trust * (np.clip(fraction, 0, 1) - rough[unknown])
    edge = ~narrow & ~outside
    radius = GUIDE_FRACTION * size
    rough[edge] = _guided(cv2, image[near], rough, radius, np.argwhere(edge))
    matte[near][unknown] = (255 * rough[unknown] + 0.5).astype(np.uint8)
    return matte


def _guided(
    cv2: Any, image: np.ndarray, rough: np.ndarray, radius: float, places: np.ndarray
) -> np.ndarray:
    """Coverage (N,) float32 in 0…1 at places (N, 2), rows and columns, from a rough one (H, W):
    in squares of 2 · radius pixels it is a linear function of the colors of an image (H, W, 3)
    uint8. This is the guided filter of He et al. (2013), whose functions are found in a smaller
    image (He and Sun 2015)."""
    whole = image.shape[1::-1]
    scale = min(1.0, GUIDE_PX / radius)
    small = tuple(max(1, round(scale * side)) for side in whole)
    color, covered = (
        cv2.resize(each, small, interpolation=cv2.INTER_AREA) for each in (image, rough)
    )
    color = color.astype(np.float32) / 255

    def mean(values: np.ndarray) -> np.ndarray:
        side = 2 * GUIDE_PX + 1
        return np.asarray(cv2.blur(values, (side, side), borderType=cv2.BORDER_REFLECT))

    products = color[..., :, None] * color[..., None, :]
    middle = mean(color)
    mixed = mean(color * covered[..., None]) - middle * mean(covered)[..., None]
    spread = np.stack([mean(products[..., row, :]) for row in range(3)], axis=-2)
    spread -= middle[..., :, None] * middle[..., None, :]
    spread += GUIDE_VARIANCE * np.eye(3, dtype=np.float32)
    slope = np.linalg.solve(spread, mixed[..., None])[..., 0]
    offset = mean(covered) - (slope * middle).sum(axis=-1)
    at = (places[:, ::-1] + 0.5) * (np.array(small) / whole)
    slopes, offsets = sampled([mean(slope), mean(offset)], at)
    colors = image[tuple(places.T)].astype(np.float32) / 255
    return np.asarray(np.clip((slopes * colors).sum(axis=-1) + offsets, 0, 1))


def _may_be_hair(cv2: Any, head: np.ndarray, margin: float) -> np.ndarray:
    """(H, W) bool: pixels beside and above a tracked head (H, W) bool, where hair may stand out."""
    rows = np.flatnonzero(head.any(axis=1))
    if not len(rows):
        return np.zeros_like(head)
    found = ~grown(cv2, head, margin)
    found[int(rows[0] + HAIR_ROWS_FRACTION * np.ptp(rows)) :] = False
    return np.asarray(found)


def by_plate(image: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """Probability (H, W) float32 of a person: the difference from a clean plate (H, W, 3) uint8."""
    import cv2

    smooth, backdrop = (cv2.GaussianBlur(each, (0, 0), 1.0) for each in (image, plate))
    difference = np.abs(smooth.astype(np.float32) - backdrop).max(axis=2)
    fraction = (difference - PLATE_NOISE_LEVELS) / (PLATE_SURE_LEVELS - PLATE_NOISE_LEVELS)
    return np.asarray(np.clip(fraction, 0, 1), np.float32)


def _cut(
    cv2: Any, image: np.ndarray, probability: np.ndarray, head: np.ndarray, size: float
) -> np.ndarray:
    """(H, W) bool: the person; size: of the head in pixels."""
    core = _shrunk(cv2, head, HEAD_MARGIN_FRACTION * size)
    margin = max(2.0, CUT_MARGIN_FRACTION * size)
    reach = grown(cv2, head, REACH_FRACTION * size)  # of hair; the body's is all below
    if head.any():
        reach[int(np.flatnonzero(head.any(axis=1)).mean()) :] = True
    surely = core | _shrunk(cv2, probability > SURE, margin)
    possibly = grown(cv2, (probability > UNLIKELY) | head, 2 * margin) & reach
    marks = np.where(probability > LIKELY, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    marks[~possibly] = cv2.GC_BGD
    marks[surely] = cv2.GC_FGD
    if 0 < np.isin(marks, (cv2.GC_FGD, cv2.GC_PR_FGD)).mean() < 1:  # it learns the colors of both
        cv2.setRNGSeed(0)  # of the clusters that the color models begin with
        models = (np.zeros((1, 65)), np.zeros((1, 65)))
        near = box_of(marks != cv2.GC_BGD, math.ceil(REACH_FRACTION * size))
        colors = image[near][..., ::-1].copy()
        part = marks[near].copy()
        cv2.grabCut(colors, part, None, *models, CUT_ITERATIONS, cv2.GC_INIT_WITH_MASK)
        marks[near] = part
    found = np.isin(marks, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8)
    found = (cv2.medianBlur(found, 3) > 0).astype(np.uint8)
    _, label = cv2.connectedComponents(found, connectivity=4)
    of_head = np.setdiff1d(np.unique(label[core]), [0])
    kept = np.isin(label, of_head) if core.any() else found > 0
    holes = (binary_fill_holes(kept) & ~kept).astype(np.uint8)
    _, label, statistics, _ = cv2.connectedComponentsWithStats(holes, connectivity=4)
    filled = statistics[:, cv2.CC_STAT_AREA] <= MAX_HOLE_FRACTION * head.sum()
    filled[0] = False
    return kept | filled[label]


def _shrunk(cv2: Any, where: np.ndarray, pixels: float) -> np.ndarray:
    """(H, W) bool: pixels farther than so many from the outside, which the border is not."""
    distance = cv2.distanceTransform(where.astype(np.uint8), cv2.DIST_L2, 3)
    return distance > pixels


def grown(cv2: Any, where: np.ndarray, pixels: float) -> np.ndarray:
    """(H, W) bool: `where` (H, W) bool, and the pixels up to so many beside it."""
    return ~_shrunk(cv2, ~where, pixels)
