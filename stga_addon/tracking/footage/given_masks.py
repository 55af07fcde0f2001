"""Masks from another folder than the footage's."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from os.path import isdir, realpath
from pathlib import Path

import numpy as np

from ...capture.images import read_mask
from ...capture.model import View
from ...errors import StgaError
from .model import DerivedFrames, Footage, FootageCamera
from .sources import Sources, find_sources, frame_number
from .video import VideoFrames


@dataclass(frozen=True)
class MaskedFrames(DerivedFrames):
    """Frames with other masks. `masks`: timestep -> view of the mask."""

    masks: Mapping[int, View]

    def mask(self, timestep: int) -> np.ndarray | None:
        return read_mask(self.masks[timestep])


def with_masks(footage: Footage, recorded: Sources, folder: Path) -> Footage:
    """The footage with the masks of a folder, named as `open_footage` says. recorded: the footage's
    files.

    Raises StgaError for the first frame that has none.
    """
    if not isdir(folder):
        raise StgaError(f"{folder}: is not a folder; expected one of mattes")
    given = find_sources(Path(realpath(folder)))
    cameras = tuple(
        _masked(camera, recorded, given, len(footage.cameras) == 1) for camera in footage.cameras
    )
    return replace(footage, cameras=cameras)


def _masked(
    camera: FootageCamera, recorded: Sources, given: Sources, single: bool
) -> FootageCamera:
    """single: whether it is the only camera, whose masks need no folder of their own."""
    names = [camera.name, ""] if single else [camera.name]
    by_number = {
        frame_number(path): path for name in reversed(names) for path in given.folders.get(name, [])
    }
    masks = {}
    for timestep in camera.timesteps:
        if isinstance(camera.frames, VideoFrames):
            expected = f"{camera.name}/{camera.frames.numbers[timestep]:05d}"
            path = by_number.get(camera.frames.numbers[timestep])
        else:
            file = Path(camera.source(timestep))
            expected = recorded.name_of(file) if file.is_relative_to(recorded.root) else file.stem
            path = next(iter(given.images.get(expected) or given.masks.get(expected, [])), None)
        if path is None:
            raise StgaError(
                f"{given.root}: has no matte of {camera.source(timestep)}; expected {expected}.png"
            )
        view = View(timestep, 0, camera.camera, camera.name, Path(camera.source(timestep)), path)
        masks[timestep] = view
    return replace(camera, frames=MaskedFrames(camera.frames, masks))
