"""Mattes of a take: those of its footage, or found in its frames once the head is tracked."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..files import read_json, replacing, write_json
from .face_networks import PersonNetwork
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
    the backdrop, else the network.
    """
    path, total = out / MATTES_FILE, len(list(footage.views()))
    continues = path.exists() and read_json(path) == source
    write_json(path, source)
    network = PersonNetwork()
    unseen: list[str] = []
    cameras, done = [], 0
    for number, camera in enumerate(footage.cameras):
        written: dict[int, Path] = {}
        frames = _frames(camera, number, head_pixels, out, network, continues, written, unseen)
        with ThreadPoolExecutor() as pool:  # OpenCV works without Python's lock
            while some := list(islice(frames, AT_ONCE)):
                list(pool.map(_write, some))
                report("Mattes", done + len(written), total)
        done += len(camera.timesteps)
        cameras.append(replace(camera, mattes=written))
    found = replace(footage, cameras=tuple(cameras))
    if not unseen:
        return found, ()
    listed = ", ".join(unseen[:6]) + (", …" if len(unseen) > 6 else "")
    return found, (f"no person was recognized in {len(unseen)} frames, whose mattes follow the head alone: {listed}",)


def _frames(
    camera: FootageCamera, number: int, head_pixels: HeadPixels, out: Path, network: PersonNetwork,
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
        probability = network.probability(image) if plate is None else probability_by_plate(image, plate)
        if head.any() and float(np.median(probability[head])) < MIN_HEAD_PROBABILITY:
            unseen.append(f"{camera.name} at timestep {timestep}")
        written[timestep] = path
        yield _Frame(path, image, probability, head)


def _write(frame: _Frame) -> None:
    matte = find_matte(frame.image, frame.probability, frame.head)
    with replacing(frame.path) as partial:
        Image.fromarray(matte).save(partial, format="PNG")
