"""Mattes of a take: those of its footage, or found in its frames once the head is tracked."""

import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from PIL import Image

from ..errors import StgaError
from ..files import read_json, replacing, write_json
from .folder import MATTES_FILE, mask_name
from .footage.model import Footage, FootageCamera
from .landmarks import Report
from .matte import find_matte, probability_by_plate

AT_ONCE = 8
"""Frames that are held at a time."""
MIN_HEAD_PROBABILITY = 0.5
"""Median over the tracked head, below which the network does not see the person there."""

HeadPixels = Callable[[int, FootageCamera], np.ndarray]
"""(timestep, camera) -> (H, W) bool: the pixels of the tracked head."""


class PersonSegmenter(Protocol):
    """Tells people from what is behind them."""

    def probability(self, image: np.ndarray) -> np.ndarray:
        """(H, W) float32 in 0…1 of an image (H, W, 3) uint8: how likely each pixel shows a person."""


class SelfieSegmentation:
    """MediaPipe's network of 250 kB (versions before 0.10.30), which sees 256×256 pixels: no download."""

    def __init__(self, solutions: Any) -> None:
        self._network = solutions.selfie_segmentation.SelfieSegmentation(model_selection=0)

    def probability(self, image: np.ndarray) -> np.ndarray:
        return np.asarray(self._network.process(np.ascontiguousarray(image)).segmentation_mask, np.float32)


def make_segmenter() -> PersonSegmenter:
    """Raises StgaError, in one sentence, where mediapipe or its network is not available."""
    os.environ.setdefault("GLOG_minloglevel", "2")  # its C++ part reports its own progress on stderr
    try:
        import mediapipe
    except ImportError as error:
        raise StgaError(_needs(f"which {sys.executable} lacks")) from error
    if not hasattr(mediapipe, "solutions"):
        raise StgaError(_needs(f"and {mediapipe.__version__} has no network in its wheel"))
    return SelfieSegmentation(mediapipe.solutions)


def _needs(what: str) -> str:
    return (
        f"mattes need mediapipe==0.10.21 (Python 3.11 or 3.12), {what}: give a folder of mattes with --mattes, a clean "
        "plate of each camera, or masks beside the images"
    )


@dataclass(frozen=True)
class _Frame:
    """A frame without a mask: its matte's file, and what the matte is found from."""

    path: Path
    image: np.ndarray
    probability: np.ndarray
    head: np.ndarray


def with_mattes(
    footage: Footage, head_pixels: HeadPixels, out: Path, source: dict[str, Any], report: Report
) -> tuple[Footage, tuple[str, ...]]:
    """The footage with a mask for every frame, and warnings.

    Frames that have one keep it. For the others, mattes are written into the folder of the capture's masks and, where
    an interrupted call with the same `source` wrote them, read from there. A camera's clean plate tells the person from
    the backdrop, else `make_segmenter`; without either, its frames stay as they are, and a warning says so.
    """
    path, total = out / MATTES_FILE, len(list(footage.views()))
    continues = path.exists() and read_json(path) == source
    write_json(path, source)
    segmenter, warnings = _segmenter(footage)
    unseen: list[str] = []
    cameras, done = [], 0
    for number, camera in enumerate(footage.cameras):
        written: dict[int, Path] = {}
        if camera.plate is None and segmenter is None:
            cameras.append(camera)
            continue
        frames = _frames(camera, number, head_pixels, out, segmenter, continues, written, unseen)
        with ThreadPoolExecutor() as pool:  # OpenCV works without Python's lock
            while some := list(islice(frames, AT_ONCE)):
                list(pool.map(_write, some))
                report("Mattes", done + len(written), total)
        done += len(camera.timesteps)
        cameras.append(replace(camera, mattes=written))
    if unseen:
        listed = ", ".join(unseen[:6]) + (", …" if len(unseen) > 6 else "")
        warnings += (f"no person was recognized in {len(unseen)} frames, whose mattes follow the head alone: {listed}",)
    return replace(footage, cameras=tuple(cameras)), warnings


def _segmenter(footage: Footage) -> tuple[PersonSegmenter | None, tuple[str, ...]]:
    """The network where a camera needs it, and a warning where that is not available."""
    lacking = [camera for camera in footage.cameras if camera.plate is None]
    if all(camera.mask(camera.timesteps[0]) is not None for camera in lacking):
        return None, ()
    try:
        return make_segmenter(), ()
    except StgaError as error:
        return None, (f"no mattes were made: {error}",)


def _frames(
    camera: FootageCamera, number: int, head_pixels: HeadPixels, out: Path, segmenter: PersonSegmenter | None,
    continues: bool, written: dict[int, Path], unseen: list[str],
) -> Iterator[_Frame]:  # fmt: skip
    """The frames whose matte is to be found; fills `written`, timestep -> file, and the names of `unseen` frames."""
    plate = camera.clean_plate()
    for timestep in camera.timesteps:
        path = out / mask_name(timestep, number)
        if continues and path.exists():
            written[timestep] = path
            continue
        if camera.mask(timestep) is not None:
            continue
        image, head = camera.image(timestep), head_pixels(timestep, camera)
        if plate is not None:
            probability = probability_by_plate(image, plate)
        else:
            assert segmenter is not None
            probability = segmenter.probability(image)
        if head.any() and float(np.median(probability[head])) < MIN_HEAD_PROBABILITY:
            unseen.append(f"{camera.name} at timestep {timestep}")
        written[timestep] = path
        yield _Frame(path, image, probability, head)


def _write(frame: _Frame) -> None:
    matte = find_matte(frame.image, frame.probability, frame.head)
    with replacing(frame.path) as partial:
        Image.fromarray(matte).save(partial, format="PNG")
