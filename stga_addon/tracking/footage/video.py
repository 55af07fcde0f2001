"""Frames of one camera that are in a video, decoded with PyAV."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...capture.camera import is_image_size
from ...errors import StgaError

SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".m4v", ".webm", ".mts", ".mxf")
MIN_HD_LINES = 720
"""From here on, videos without a stated color matrix are in that of HD (BT.709)."""

MAX_FRAMES_AHEAD = 100
"""Frames that are decoded to reach a later one; further ahead, the key frame before it is sought."""


@dataclass(frozen=True)
class Video:
    """What a video holds.

    times     presentation times of its frames, ascending, in the stream's time base
    size      (width, height) as displayed
    """

    path: Path
    times: tuple[int, ...]
    fps: float
    size: tuple[int, int]


def read_video(path: Path) -> Video:
    """Index a video; only its first frame is decoded. Raises StgaError where it cannot be read, or without PyAV."""
    av = _pyav(path)
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            times = tuple(sorted(packet.pts for packet in container.demux(stream) if packet.pts is not None))
            fps = float(stream.average_rate or stream.guessed_rate or 0)
            container.seek(min(times, default=0), stream=stream)
            height, width = _pixels(next(container.decode(stream))).shape[:2]
    except (av.FFmpegError, StopIteration, IndexError, ValueError) as error:
        raise StgaError(f"{path}: is not a readable video ({error or type(error).__name__})") from error
    if not is_image_size(width, height):
        raise StgaError(f"{path}: has {width} x {height} pixels, more than are read")
    return Video(path, times, fps, (width, height))


class VideoFrames:
    """`numbers`: timestep -> number of the frame in the video, ascending. One decoder: not for two threads at once."""

    def __init__(self, video: Video, numbers: Mapping[int, int]) -> None:
        self.video, self.numbers = video, numbers
        self._container: Any = None
        self._decoder: Any = None
        self._decoded = -1
        """Number of the frame that was decoded last."""

    @property
    def timesteps(self) -> tuple[int, ...]:
        return tuple(self.numbers)

    def image(self, timestep: int) -> np.ndarray:
        number = self.numbers[timestep]
        av = _pyav(self.video.path)
        try:
            pixels = _pixels(self._frame(number))
        except (av.FFmpegError, StopIteration, ValueError) as error:
            self.close()
            raise StgaError(f"{self.source(timestep)}: cannot be decoded ({error or type(error).__name__})") from error
        if timestep == self.timesteps[-1]:
            self.close()  # a decoder holds dozens of frames, and a rig has dozens of cameras
        return pixels

    def mask(self, timestep: int) -> None:
        return None

    def source(self, timestep: int) -> str:
        return f"{self.video.path}: frame {self.numbers[timestep]}"

    def file(self, timestep: int) -> None:
        return None

    def close(self) -> None:
        """Release the decoder; the next frame opens it again."""
        if self._container is not None:
            self._container.close()
        self._container, self._decoder, self._decoded = None, None, -1

    def _frame(self, number: int) -> Any:
        """The frame, decoded on from the last one, or from the key frame before it."""
        if self._container is None:
            self._container = _pyav(self.video.path).open(str(self.video.path))
            self._container.streams.video[0].thread_type = "AUTO"
        time = self.video.times[number]
        if self._decoder is None or not 0 < number - self._decoded <= MAX_FRAMES_AHEAD:
            stream = self._container.streams.video[0]
            self._container.seek(time, stream=stream)
            self._decoder = self._container.decode(stream)
        frame = next(frame for frame in self._decoder if frame.pts is not None and frame.pts >= time)
        self._decoded = number
        return frame


def _pixels(frame: Any) -> np.ndarray:
    """(H, W, 3) uint8 RGB, turned as the video asks for."""
    matrix = frame.colorspace
    if matrix == 2 and frame.height >= MIN_HD_LINES:  # FFmpeg's "unspecified"
        matrix = 1  # BT.709
    rgb = frame.reformat(format="rgb24", src_colorspace=matrix).to_ndarray()
    return np.ascontiguousarray(np.rot90(rgb, round(frame.rotation / 90)))


def _pyav(path: Path) -> Any:
    try:
        import av
    except ImportError as error:
        raise StgaError(f"{path}: reading videos needs the package av (PyAV)") from error
    return av
