"""Mattes of a take: those of its footage, or found in its frames once the head is tracked."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..capture.model import parts_of
from ..files import read_json, replacing, write_json
from ..worker.helpers import Helpers, Step
from .face_networks import PersonNetwork
from .folder import MATTES_FILE, mask_name
from .footage.model import Footage, FootageCamera
from .landmarks import Report
from .matte import find_matte, probability_by_plate

PART_TIMESTEPS = 24
"""At most, of the parts of a camera that are worked on at once."""
MIN_HEAD_PROBABILITY = 0.5
"""Median over the tracked head, below which the network does not see the person there."""

HeadPixels = Callable[[int, FootageCamera], np.ndarray]
"""(timestep, camera) -> (H, W) bool: the pixels of the tracked head; can be handed to helping
processes."""


def with_mattes(
    footage: Footage,
    head_pixels: HeadPixels,
    out: Path,
    source: dict[str, Any],
    helpers: Helpers,
    report: Report,
) -> tuple[Footage, tuple[str, ...]]:
    """The footage with a mask for every frame, and warnings.

    Frames that have one keep it. For the others, mattes are written into the folder of the
    capture's masks and, where an interrupted call with the same `source` wrote them, read from
    there. A camera's clean plate tells the person from the backdrop, else the network.
    """
    path, total = out / MATTES_FILE, len(list(footage.views()))
    continues = path.exists() and read_json(path) == source
    write_json(path, source)
    unseen: list[str] = []
    cameras, done = [], 0
    for number, camera in enumerate(footage.cameras):
        files = {t: out / mask_name(t, number) for t in camera.timesteps}
        kept = {t: file for t, file in files.items() if continues and file.exists()}
        left = [t for t in camera.timesteps if t not in kept]
        parts = [
            (camera, {t: files[t] for t in part}, head_pixels)
            for part in parts_of(left, PART_TIMESTEPS)
            if part
        ]
        done += len(kept)
        found = helpers.map(_write_mattes, parts, partial(_count, report, done, total))
        done += len(left)
        report("Mattes", done, total)
        known = {t: is_seen for part in found for t, is_seen in part.items()}
        unseen += [f"{camera.name} at timestep {t}" for t in left if not known.get(t, True)]
        cameras.append(
            replace(camera, mattes={t: files[t] for t in files if t in kept or t in known})
        )
    result = replace(footage, cameras=tuple(cameras))
    if not unseen:
        return result, ()
    listed = ", ".join(unseen[:6]) + (", …" if len(unseen) > 6 else "")
    return result, (
        f"no person was recognized in {len(unseen)} frames, whose mattes follow the head alone: {listed}",
    )


def _count(report: Report, done: int, total: int, number: int) -> None:
    report("Mattes", done + number, total)


def _write_mattes(
    camera: FootageCamera, files: dict[int, Path], head_pixels: HeadPixels, step: Step
) -> dict[int, bool]:
    """Write the mattes of timesteps without a mask; by those, whether a person was recognized."""
    plate, network = camera.clean_plate(), PersonNetwork()
    recognized = {}
    for timestep, file in files.items():
        if camera.mask(timestep) is None:
            image, head = camera.image(timestep), head_pixels(timestep, camera)
            probability = (
                network.probability(image) if plate is None else probability_by_plate(image, plate)
            )
            recognized[timestep] = (
                not head.any() or float(np.median(probability[head])) >= MIN_HEAD_PROBABILITY
            )
            with replacing(file) as partial_file:
                Image.fromarray(find_matte(image, probability, head)).save(
                    partial_file, format="PNG"
                )
        step()
    return recognized
