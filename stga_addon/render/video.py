"""Videos: recordings of what images show, and MP4 files or PNGs, written image by image."""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from fractions import Fraction
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..capture.camera import Camera
from ..errors import StgaError
from ..export.playback import check_rate
from ..files import NumberedFiles, check_writable, file_address, naming, replacing
from ..raster.posed_splats import ComposedImage, PosedSplats, with_holdouts
from ..worker.messages import receive, send
from .client import pack_camera, pack_layers, unpack_camera, unpack_layers
from .composer import Composer

CODEC = "libx264"
"""H.264, which browsers, phones and editors play."""
PIXEL_FORMAT = "yuv420p"
"""Halved color resolution, which they expect."""
QUALITY = {"crf": "16", "preset": "medium"}
"""Constant rate factor of x264: 18 is called visually lossless, lower is better."""
BT709 = 1
"""Value of FFmpeg's AVCOL_* for BT.709, which players assume of untagged HD video."""
LIMITED_RANGE = 1
"""Value of FFmpeg's AVCOL_RANGE for levels of 16 to 235, which they assume as well."""
IMAGE_NAME = re.compile(r"\d{4,}\.png", re.IGNORECASE)
"""Name of an image of a sequence: 0012.png."""

WriteImage = Callable[[np.ndarray], None]


@contextmanager
def video_writer(path: Path, fps: float) -> Iterator[WriteImage]:
    """Write an MP4 file: the block is given a function that appends an image (H, W, 3) uint8, sRGB.

    All images have the size of the first; odd sizes are extended by a row or column, which the
    format needs. The file appears when the block ends without an exception. Raises StgaError where
    it cannot be written, or no video has such a frame rate.
    """
    check_rate(path, fps)
    import av

    rate = Fraction(fps).limit_denominator(1001)
    is_empty = True
    with replacing(path) as partial:
        try:
            with av.open(
                file_address(partial), "w", format="mp4", options={"movflags": "faststart"}
            ) as container:
                stream: Any = container.add_stream(CODEC, rate=rate, options=QUALITY)
                stream.pix_fmt = PIXEL_FORMAT
                context = stream.codec_context
                context.colorspace = context.color_primaries = context.color_trc = BT709
                context.color_range = LIMITED_RANGE

                def append(image: np.ndarray) -> None:
                    nonlocal is_empty
                    odd = ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0))
                    pixels = np.ascontiguousarray(np.pad(image, odd, mode="edge"))
                    frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
                    if is_empty:
                        stream.width = frame.width
                        stream.height = frame.height
                        is_empty = False
                    colors = {"dst_colorspace": BT709, "dst_color_range": LIMITED_RANGE}
                    container.mux(stream.encode(frame.reformat(format=PIXEL_FORMAT, **colors)))

                yield append
                container.mux(stream.encode())  # what the encoder still holds
        except av.error.FFmpegError as error:
            reason = error.strerror or error
            raise StgaError(f"{path}: the video cannot be written ({reason})") from error


@contextmanager
def sequence_writer(folder: Path) -> Iterator[WriteImage]:
    """Write 0001.png, 0002.png, … into the folder: the block is given a function that writes the
    next image.

    Images: (H, W, 3) or, with straight alpha, (H, W, 4) uint8, sRGB. They replace an earlier
    sequence: when the block ends, its other images are removed, also where it was cut short, so
    that the folder never holds images of two; all else in it stays. Raises StgaError where one
    cannot be written or removed, and, before any is written, where the folder holds images with
    such names that `sequence_writer` did not write.
    """
    from PIL import Image

    with sequence_files(folder) as next_file:

        def write(image: np.ndarray) -> None:
            with next_file() as partial:
                Image.fromarray(image).save(partial, format="PNG")

        yield write


@contextmanager
def sequence_files(folder: Path) -> Iterator[Callable[[], AbstractContextManager[Path]]]:
    """The files of `sequence_writer`: the block is given a function like `replacing` of the next
    one."""
    files = NumberedFiles(folder, IMAGE_NAME)
    number = count(1)

    @contextmanager
    def next_file() -> Iterator[Path]:
        path = folder / f"{next(number):04d}.png"
        with replacing(path) as partial:
            yield partial
            files.add(path.name, partial)

    try:
        yield next_file
    finally:
        files.finish()


def is_video(output: Path) -> bool:
    """Whether images are written as one video; else as PNGs in a folder."""
    return output.suffix.lower() == ".mp4"


def check_output(output: Path) -> None:
    """Raise StgaError where the output cannot be written, or others' images are there."""
    check_writable(output if is_video(output) else output / "0001.png")
    if not is_video(output):
        NumberedFiles(output, IMAGE_NAME)


class Recorder:
    """Writes a recording; close it before it is read."""

    def __init__(self, path: Path) -> None:
        """Raises StgaError where the file cannot be written."""
        self.path = path
        with naming(path):
            self._stream: BinaryIO = path.open("wb")
        self._before: Sequence[PosedSplats] = ()

    def add(self, layers: Sequence[PosedSplats], camera: Camera) -> None:
        """Append an image. Raises StgaError on a full disk."""
        message = {**pack_camera(camera), **pack_layers(layers, self._before)}
        self._before = layers
        with naming(self.path):
            send(self._stream, message)

    def close(self) -> None:
        """Raises StgaError on a full disk, and closes all the same."""
        with naming(self.path):
            self._stream.close()


def recorded_images(path: Path, count: int, composer: Composer) -> Iterator[ComposedImage]:
    """The images of a recording, rendered. Raises StgaError where it is damaged."""
    layers: list[PosedSplats] = []
    try:
        with path.open("rb") as stream:
            for _ in range(count):
                message = receive(stream)
                layers = unpack_layers(message, layers)
                draw = partial(composer.compose, camera=unpack_camera(message))
                yield with_holdouts(layers, draw)
    except (OSError, EOFError, KeyError, ValueError) as error:
        kind = type(error).__name__
        raise StgaError(f"{path}: cannot be read as the images of a video ({kind})") from error


def finished(
    image: ComposedImage, background: tuple[float, float, float] | None, opaque: bool
) -> np.ndarray:
    """(H, W, 3) uint8 sRGB over the background; if that is None, or holdouts hide some of it,
    straight alpha or `opaque`, where they are black."""
    behind = np.array(background or (0, 0, 0), np.float32)
    pixels = image.rgb.transpose(1, 2, 0) + (1 - image.alpha[..., None]) * behind
    if not opaque and not (background is not None and image.hidden is None):
        alpha = image.alpha if background is None else np.ones_like(image.alpha)
        alpha = (alpha if image.hidden is None else alpha - image.hidden)[..., None]
        straight = pixels / np.maximum(alpha, np.finfo(np.float32).tiny)
        pixels = np.concatenate([straight, alpha], axis=2)
    return np.asarray(np.rint(np.clip(pixels, 0, 1) * 255), np.uint8)
