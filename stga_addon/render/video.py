"""MP4 videos and numbered PNGs, written image by image."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import StgaError
from ..export.playback import check_rate
from ..files import NumberedFiles, replacing

CODEC, PIXEL_FORMAT = "libx264", "yuv420p"
"""H.264 with halved color resolution: what browsers, phones and editors play."""
QUALITY = {"crf": "16", "preset": "medium"}
"""Constant rate factor of x264: 18 is called visually lossless, lower is better."""
BT709, LIMITED_RANGE = 1, 1
"""Values of FFmpeg's AVCOL_* enumerations: what players assume of untagged high-definition video."""
IMAGE_NAME = re.compile(r"\d{4,}\.png", re.IGNORECASE)
"""Name of an image of a sequence: 0012.png."""

WriteImage = Callable[[np.ndarray], None]


@contextmanager
def video_writer(path: Path, fps: float) -> Iterator[WriteImage]:
    """Write an MP4 file: the block is given a function that appends an image (H, W, 3) uint8, sRGB.

    All images have the size of the first; odd sizes are extended by a row or column, which the format needs. The file
    appears when the block ends without an exception. Raises StgaError where it cannot be written, or no video has
    such a frame rate.
    """
    check_rate(path, fps)
    import av

    with replacing(path) as partial:
        try:
            with av.open(str(partial), "w", format="mp4", options={"movflags": "faststart"}) as container:
                append, finish = _encoder(container, Fraction(fps).limit_denominator(1001))
                yield append
                finish()
        except av.error.FFmpegError as error:
            raise StgaError(f"{path}: the video cannot be written ({error.strerror or error})") from error


@contextmanager
def sequence_writer(folder: Path) -> Iterator[WriteImage]:
    """Write 0001.png, 0002.png, … into the folder: the block is given a function that writes the next image.

    Images: (H, W, 3) or, with straight alpha, (H, W, 4) uint8, sRGB. They replace an earlier sequence: when the block
    ends, its other images are removed, also where it was cut short, so that the folder never holds images of two; all
    else in it stays. Raises StgaError where one cannot be written or removed, and, before any is written, where the
    folder holds images with such names that `sequence_writer` did not write.
    """
    from PIL import Image

    files, number = NumberedFiles(folder, IMAGE_NAME), count(1)

    def write(image: np.ndarray) -> None:
        path = folder / f"{next(number):04d}.png"
        with replacing(path) as partial:
            Image.fromarray(image).save(partial, format="PNG")
            files.add(path.name, partial)

    try:
        yield write
    finally:
        files.finish()


def _encoder(container: Any, rate: Fraction) -> tuple[WriteImage, Callable[[], None]]:
    """Functions that append an image to the container, and write what the encoder still holds."""
    from av import VideoFrame

    stream = container.add_stream(CODEC, rate=rate, options=QUALITY)
    stream.pix_fmt = PIXEL_FORMAT
    context = stream.codec_context
    context.colorspace = context.color_primaries = context.color_trc = BT709
    context.color_range = LIMITED_RANGE
    is_empty = True

    def append(image: np.ndarray) -> None:
        nonlocal is_empty
        frame = VideoFrame.from_ndarray(_even(image), format="rgb24")
        if is_empty:
            stream.width, stream.height, is_empty = frame.width, frame.height, False
        frame = frame.reformat(format=PIXEL_FORMAT, dst_colorspace=BT709, dst_color_range=LIMITED_RANGE)
        container.mux(stream.encode(frame))

    return append, lambda: container.mux(stream.encode())


def _even(image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    return np.ascontiguousarray(np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge"))
