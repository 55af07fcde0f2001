"""Frames of videos as the images of the capture that is written: each is decoded once, in order."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...capture.images import read_image
from ...capture.model import View
from ...files import replacing
from .model import DerivedFrames, Footage, FootageCamera


@dataclass(frozen=True)
class StoredFrames(DerivedFrames):
    """Frames as recorded; `views`: timestep -> the image file that a frame is kept in from its
    first use."""

    views: Mapping[int, View]

    def image(self, timestep: int) -> np.ndarray:
        view = self.views[timestep]
        if view.image.exists():
            return read_image(view)
        import cv2  # writes PNGs in a fifth of Pillow's time

        pixels = self.frames.image(timestep)
        with replacing(view.image) as partial:
            partial.write_bytes(cv2.imencode(".png", pixels[..., ::-1])[1].tobytes())
        return pixels

    def file(self, timestep: int) -> Path | None:
        path = self.views[timestep].image
        return path if path.exists() else None


def with_stored(footage: Footage, images: Mapping[str, Mapping[int, Path]]) -> Footage:
    """The footage whose undistorted frames that are no files yet are kept in those of their camera:
    timestep -> PNG.

    A file that exists is that of the frame. Lenses with distortion are left out.
    """

    def stored(camera: FootageCamera) -> FootageCamera:
        if camera.undistortion is not None or camera.file(camera.timesteps[0]) is not None:
            return camera
        views = {
            t: View(t, 0, camera.camera, camera.name, images[camera.name][t])
            for t in camera.timesteps
        }
        return replace(camera, frames=StoredFrames(camera.frames, views))

    return replace(footage, cameras=tuple(map(stored, footage.cameras)))
