"""Recordings: a file with a message for each image, its camera and what has changed of the splats."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..capture.camera import Camera
from ..errors import StgaError
from ..files import NumberedFiles, check_writable
from ..raster.posed_splats import ComposedImage, PosedSplats
from .compose import Composer
from .protocol import pack_layers, receive, send, unpack_layers
from .video import IMAGE_NAME

FIRST_IMAGE = "0001.png"
"""Of a sequence, as `video.sequence_writer` names it."""


def is_video(output: Path) -> bool:
    """Whether images are written as one video; else as PNGs in a folder."""
    return output.suffix.lower() == ".mp4"


def check_output(output: Path) -> None:
    """Raise StgaError where a video, or the PNGs of a folder, cannot be written, or others' images are there."""
    check_writable(output if is_video(output) else output / FIRST_IMAGE)
    if not is_video(output):
        NumberedFiles(output, IMAGE_NAME)


class Recorder:
    """Writes a recording; close it before it is read."""

    def __init__(self, path: Path) -> None:
        """Raises StgaError where the file cannot be written."""
        self.path = path
        with self._reported():
            self._stream: BinaryIO = path.open("wb")
        self._before: Sequence[PosedSplats] = ()

    def add(self, layers: Sequence[PosedSplats], camera: Camera) -> None:
        """Append an image. Raises StgaError on a full disk."""
        intrinsics = np.array([camera.width, camera.height, camera.fl_x, camera.fl_y, camera.cx, camera.cy])
        message = {"camera": intrinsics, "pose": camera.world_to_camera, **pack_layers(layers, self._before)}
        self._before = layers
        with self._reported():
            send(self._stream, message)

    def close(self) -> None:
        """Raises StgaError on a full disk, and closes all the same."""
        with self._reported():
            self._stream.close()

    @contextmanager
    def _reported(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise StgaError(f"{self.path}: cannot be written ({error.strerror or error})") from error


def recorded_images(path: Path, count: int, composer: Composer) -> Iterator[ComposedImage]:
    """The images of a recording, rendered. Raises StgaError where it is damaged."""
    layers: list[PosedSplats] = []
    try:
        with path.open("rb") as stream:
            for _ in range(count):
                message = receive(stream)
                layers = unpack_layers(message, layers)
                width, height, fl_x, fl_y, cx, cy = message["camera"].tolist()
                yield composer.compose(layers, Camera(int(width), int(height), fl_x, fl_y, cx, cy, message["pose"]))
    except (OSError, EOFError, KeyError, ValueError) as error:
        raise StgaError(f"{path}: cannot be read as the images of a video ({type(error).__name__})") from error


def finished(image: ComposedImage, background: tuple[float, float, float] | None, opaque: bool) -> np.ndarray:
    """(H, W, 3) uint8 sRGB over the background, or (H, W, 4) with straight alpha where it is None and not `opaque`."""
    color, alpha = image.rgb.transpose(1, 2, 0), image.alpha[..., None]
    if background is None and not opaque:
        pixels = np.concatenate([color / np.maximum(alpha, np.finfo(np.float32).tiny), alpha], axis=2)
    else:
        pixels = color + (1 - alpha) * np.array(background or (0, 0, 0), np.float32)
    return np.asarray(np.rint(np.clip(pixels, 0, 1) * 255), np.uint8)
