"""Views that are left out: those that show nobody, because their matte or their image failed, are
found; others are named by a run."""

import statistics
from collections.abc import Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import StgaError, listed
from .camera import Camera
from .images import has_alpha, read_view, upper_border
from .model import Capture, View, evenly_spread, views_by_camera

COMPARED_HEIGHT_PX = 160
"""Height of the small images that are looked at."""
MIN_COVERAGE_FRACTION = 0.05
"""Fraction of its camera's median coverage, up to which a matte counts as empty: specks stay."""
MIN_COVERAGE = 1e-3
"""Fraction of the image up to which a matte counts as empty, whatever its camera's others hold."""
MAX_BORDER_DIFFERENCE = 0.4
"""Fraction of the upper border by which a matte may cover more of it than its camera's others; full
and inverted ones, and halves, cover more."""
MAX_UNCERTAINTY = 0.5
"""Mean of 4 α (1 − α) over a small mask: 1 where all is half transparent, or averaged noise."""
MAX_ROUGHNESS = 0.2
"""Mean difference of neighbors in a row of a small mask, which noise of its size exceeds."""
MAX_ONE_COLOR_LEVELS = 4
"""Range of each channel, of 255, in a small image, up to which it is of one color; levels up to
which it is black."""
INSIDE_LEVEL = 128
"""Level of a small mask, of 255, from which a pixel shows the person."""
OPAQUE_LEVEL = 254
"""Level of a small image's transparency, of 255, from which the white behind it does not show."""
MAX_VIEWS_READ = 64
"""Number of views up to which all are read."""
EXTREME_FILES = 2
"""Number of a camera's smallest and of its largest images and masks that are read among more views
than that: what shows nothing compresses best, and noise worst."""
SAMPLED_VIEWS = 24
"""Number of views among more than MAX_VIEWS_READ that are read whatever their files' sizes are."""
READERS = 4
"""Number of threads that decode images."""
NAMED_TIMESTEPS = 12
"""Largest number of timesteps that a message lists."""


PROBLEMS = (
    "have an empty mask",
    "have a mask of noise",
    "have a full or inverted mask",
    "are of one color",
)
"""What is wrong with views, in the order in which it is reported."""


class _Content(NamedTuple):
    """What is looked at of a view.

    coverage      fraction of the image that the mask covers; None without a mask
    border        fraction of the image's upper border that it covers
    is_noise      whether the mask is noise, or half transparent everywhere
    is_one_color  whether the image has one color, or is black where the mask covers it
    """

    coverage: float | None
    border: float
    is_noise: bool
    is_one_color: bool


def with_usable_views(capture: Capture) -> tuple[Capture, tuple[str, ...]]:
    """The capture without views that show nobody, and a sentence for each kind of them.

    A mask, or an image's transparency, that is noise, or that is empty, full or inverted beside the
    others of its camera; and an image of one color. Raises StgaError where a file cannot be read.
    """
    views = capture.all_views
    kinds = _unusable(views)
    failed = set[Path]().union(*kinds)
    if not failed:
        return capture, ()
    usable = {
        split: tuple(view for view in members if view.image not in failed)
        for split, members in capture.views.items()
    }
    warnings = []
    named = set[Path]()
    for found, why in zip(kinds, PROBLEMS, strict=True):
        files = found - named
        named |= found
        if files:
            unusable = [view for view in views if view.image in files]
            count = f"{len(unusable)} of {len(views)} images {why}"
            left_out = "they are left out of training, tracking and scores"
            warnings.append(f"{capture.root}: {count} ({_timesteps(unusable)}); {left_out}")
    return replace(capture, views=usable), tuple(warnings)


def with_training_views(capture: Capture) -> tuple[Capture, tuple[str, ...]]:
    """`with_usable_views`. Raises StgaError where no training view is left."""
    usable, warnings = with_usable_views(capture)
    if capture.views.get("train") and not usable.views["train"]:
        raise StgaError(
            f"{capture.root}: shows nobody in its training views, so there is nothing to train on: "
            "each has an empty mask, one of noise, or an image of one color; expected masks of 255 "
            "on the person"
        )
    return usable, warnings


def without_training_views(capture: Capture, left_out: Collection[tuple[int, ...]]) -> Capture:
    """The capture without some training views, by (camera index, timestep)."""
    kept = [
        view
        for view in capture.views["train"]
        if (view.camera_index, view.timestep) not in left_out
    ]
    return replace(capture, views={**capture.views, "train": tuple(kept)})


def _timesteps(views: Iterable[View]) -> str:
    numbers = sorted({view.timestep for view in views})
    return f"timestep{'s' if len(numbers) > 1 else ''} {listed(numbers, NAMED_TIMESTEPS)}"


def _unusable(views: Sequence[View]) -> list[set[Path]]:
    """Images of views with each of PROBLEMS."""
    if len(views) > MAX_VIEWS_READ:
        certain = {view.image for view in evenly_spread(views, SAMPLED_VIEWS)}
        for camera_views in views_by_camera(views).values():
            certain |= _suspects(camera_views)
        found = _found([view for view in views if view.image in certain])
        if not any(found):
            return found
    return _found(views)


def _found(views: Sequence[View]) -> list[set[Path]]:
    with ThreadPoolExecutor(READERS) as pool:
        contents = dict(zip((view.image for view in views), pool.map(_content, views), strict=True))
    empty = set[Path]()
    full = set[Path]()
    for camera_views in views_by_camera(views).values():
        known = {view.image: contents[view.image].coverage for view in camera_views}
        covered = {path: fraction for path, fraction in known.items() if fraction is not None}
        median = statistics.median([fraction for fraction in covered.values() if fraction] or [0.0])
        least = max(MIN_COVERAGE, MIN_COVERAGE_FRACTION * median)
        empty |= {path for path, fraction in covered.items() if fraction <= least}
        border = statistics.median([contents[path].border for path in covered] or [0.0])
        border += MAX_BORDER_DIFFERENCE
        full |= {path for path in covered if contents[path].border > border}
    noise = {path for path, content in contents.items() if content.is_noise}
    plain = {path for path, content in contents.items() if content.is_one_color}
    return [empty, noise, full, plain]


def _suspects(views: Sequence[View]) -> set[Path]:
    """Images of a camera's views, of which some show nobody if any of its views does: those whose
    files are the smallest and the largest. All, where sizes tell nothing: of transparency that is
    the mask, and of files that are not compressed."""
    if any(view.mask is None and has_alpha(view.image) for view in views):
        return {view.image for view in views}
    suspects = set[Path]()
    for files in ([view.image for view in views], [view.mask for view in views]):
        sizes = [path.stat().st_size if path and path.is_file() else 0 for path in files]
        if max(sizes) == min(sizes) > 0:
            return {view.image for view in views}
        order = np.argsort(sizes, kind="stable")
        extreme = *order[:EXTREME_FILES], *order[-EXTREME_FILES:]
        suspects |= {views[row].image for row in extreme}
    return suspects


def _content(view: View) -> _Content:
    files = [path for path in (view.image, view.mask) if path is not None]
    stamps = tuple((path.stat().st_mtime_ns if path.is_file() else 0) for path in files)
    of_mask = view.mask, view.is_mask_inverted
    return _content_of(view.image, of_mask, (view.camera.width, view.camera.height), stamps)


@lru_cache(1 << 16)
def _content_of(
    image: Path,
    of_mask: tuple[Path | None, bool],
    size: tuple[int, int],
    stamps: tuple[int, ...],
) -> _Content:
    """of_mask: its file, and whether that is inverted. stamps: times of the files' last changes, so
    that others are read anew."""
    mask, is_inverted = of_mask
    camera = Camera(*size, 1.0, 1.0, 0.0, 0.0, np.eye(4))
    scale = min(1.0, COMPARED_HEIGHT_PX / camera.height)
    view = View(0, 0, camera, image.name, image, mask, is_mask_inverted=is_inverted)
    _, pixels, covered = read_view(view, scale)
    coverage = None if covered is None else float(covered.mean()) / 255
    least = OPAQUE_LEVEL if mask is None else INSIDE_LEVEL
    inside = np.ones(pixels.shape[:2], bool) if covered is None else covered >= least
    alpha = None if covered is None else covered / np.float32(255)
    is_plain = np.ptp(pixels.reshape(-1, 3), axis=0).max() <= MAX_ONE_COLOR_LEVELS
    is_black = inside.any() and pixels[inside].max() <= MAX_ONE_COLOR_LEVELS
    border = 0.0 if alpha is None else float(upper_border(alpha).mean())
    is_noise = alpha is not None and _is_noise(alpha)
    return _Content(coverage, border, is_noise, bool(is_plain or is_black))


def _is_noise(alpha: np.ndarray) -> bool:
    uncertainty = float((4 * alpha * (1 - alpha)).mean())
    roughness = float(np.abs(np.diff(alpha, axis=1)).mean()) if alpha.shape[1] > 1 else 0.0
    return uncertainty > MAX_UNCERTAINTY or roughness > MAX_ROUGHNESS
