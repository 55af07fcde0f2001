"""Frames of one camera from a video, decoded with PyAV."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ...capture.camera import MAX_IMAGE_PIXELS, is_image_size
from ...capture.color import is_srgb, to_srgb
from ...capture.images import read_mask
from ...capture.model import View
from ...errors import StgaError
from ...files import file_address
from .focal_tags import clean_aperture

MIN_HD_LINES = 720
"""Height from which on videos without a stated color matrix use that of HD (BT.709)."""
TIMED_CONTAINERS = ("mov", "matroska")
"""FFmpeg's names of containers that store when each packet is shown."""
SEEKABLE_CONTAINERS = (*TIMED_CONTAINERS, "mpegts")
"""Containers in which a frame has the same presentation time after a seek as in order."""
CODECS_WITH_HIDDEN_PACKETS = ("vp8",)
"""Codecs whose reference frames that are not shown are packets of their own."""
DISPLAY_MATRIX_ONE = 1 << 16
"""The number 1 in the fixed-point numbers of a display matrix (ISO/IEC 14496-12, track header)."""
CHECKED_FRAMES = 8
"""Frames at the beginning of a video that are decoded to check the times of its packets."""
MAX_FRAMES_AHEAD = 100
"""Frames that are decoded to reach a later one; further ahead, a key frame is sought."""
SEEK_BACK_FRAMES = (0, 16, 64, 256)
"""Distances before a frame to which a seek is tried, in turn, before all is decoded from the
beginning."""
RATE_TOLERANCE = 0.01
"""Relative difference up to which a stated frame rate is that of the frames' times."""
TURN_TOLERANCE = 0.02
"""Sine of an angle beyond which a turn is not by a right angle."""
VARIABLE_RATE_FACTOR = 1.5
"""A frame that lasts this many times the median makes the rate a variable one."""


@dataclass(frozen=True)
class Video:
    """What a video holds.

    times     presentation times of the frames that are shown, ascending, in the stream's time base;
              their numbers where the file holds no reliable times
    timesteps  of the frames, not descending: their numbers, but where the rate varies their times
               in units of 1 / fps
    fps       frames per second; without its gaps where it varies; 0 where unknown
    size      (width, height) as displayed, of square pixels
    stored    (width, height) before the pixels were made square, turned as displayed
    aspect    width of a stored pixel over its height, by which frames are stretched
    seekable  whether a frame is recognized by its time; False: frames are counted from the
              beginning
    warnings  one sentence each
    """

    path: Path
    times: tuple[int, ...]
    timesteps: tuple[int, ...]
    fps: float
    size: tuple[int, int]
    stored: tuple[int, int] = (0, 0)
    aspect: Fraction = Fraction(1)
    seekable: bool = True
    warnings: tuple[str, ...] = ()

    def as_stored(self) -> "Video":
        """With frames as they are stored, of pixels that are not square."""
        return replace(self, size=self.stored, aspect=Fraction(1))

    @property
    def sentences(self) -> tuple[str, ...]:
        """The warnings, and that frames are stretched where they are."""
        if self.aspect == 1:
            return self.warnings
        pixels = f"its pixels are not square ({self.aspect.numerator}:{self.aspect.denominator})"
        return (
            *self.warnings,
            f"{self.path}: {pixels}; frames are stretched to {self.size[0]} x {self.size[1]}",
        )


def read_video(path: Path) -> Video:
    """Index a video. Raises StgaError where it cannot be read, or without PyAV. Where the container
    says when packets are shown, only the first frames are decoded; otherwise, all are."""
    begin = first_frames(path)
    first = list(begin.times)
    times, is_cut_off = _packet_times(path)
    left_out = times.index(first[0]) if first[0] in times else 0
    with opened_video(path) as container:
        stream = container.streams.video[0]
        if times[left_out : left_out + len(first)] != first:
            stream.thread_type = "AUTO"
            times = [frame.pts for frame in _decoded_frames(container)]
            left_out = 0
        exact = _is_of(container, SEEKABLE_CONTAINERS) or stream.codec_context.codec.intra_only
        seekable = _ascending(times) and exact
        rates = [float(rate) for rate in (stream.average_rate, stream.guessed_rate) if rate]
        time_base = float(stream.time_base)
    if not seekable:
        numbers = tuple(range(len(times)))
        fps = next(iter(rates), 0.0)
        return replace(begin, times=numbers, timesteps=numbers, fps=fps, seekable=False)
    kept = tuple(times[left_out:])
    timesteps, fps, warnings = _timed(path, kept, time_base, rates)
    warnings = (*begin.warnings, *warnings)
    if left_out:
        fate = "cannot be decoded; they are left out, and not counted"
        warnings += (f"{path}: its first {left_out} frames {fate}",)
    if is_cut_off:
        warnings += (f"{path}: is cut off; it ends after {len(kept)} frames",)
    return replace(begin, times=kept, timesteps=timesteps, fps=fps, warnings=warnings)


class VideoFrames:
    """Frames in a video, read with one decoder: not for two threads at once.

    numbers  timestep -> number of the frame in the video, ascending
    masks    timestep -> the view of its mask, where there are any
    """

    def __init__(
        self, video: Video, numbers: Mapping[int, int], masks: Mapping[int, View] | None = None
    ) -> None:
        self.video = video
        self.numbers = numbers
        self.masks = masks
        self._container: Any = None
        self._decoder: Iterator[Any] | None = None

        self._decoded = -1
        """Number of the frame that was decoded last."""

    def __getstate__(self) -> dict[str, Any]:
        """For helping processes, which open the video themselves."""
        return {**vars(self), "_container": None, "_decoder": None, "_decoded": -1}

    @property
    def timesteps(self) -> tuple[int, ...]:
        """Timesteps that have a frame, ascending."""
        return tuple(self.numbers)

    def image(self, timestep: int) -> np.ndarray:
        """(H, W, 3) uint8 sRGB. Raises StgaError naming the file; KeyError without a frame."""
        number = self.numbers[timestep]
        av = _pyav(self.video.path)
        try:
            pixels = _pixels(self._frame(number), self.video.aspect)
        except (av.FFmpegError, ValueError) as error:
            self.close()
            raise StgaError(
                f"{self.source(timestep)}: cannot be decoded ({_reason(error)})"
            ) from error
        if timestep == self.timesteps[-1]:
            self.close()  # a decoder holds dozens of frames, and a rig has dozens of cameras
        return pixels

    def mask(self, timestep: int) -> np.ndarray | None:
        """(H, W) uint8, 255 inside; None where the frame has none. Raises as `image` does."""
        return None if self.masks is None else read_mask(self.masks[timestep])

    def source(self, timestep: int) -> str:
        """What a message calls the frame."""
        return f"{self.video.path}: frame {self.numbers[timestep]}"

    @property
    def files(self) -> tuple[Path, ...]:
        """What the frames are read from."""
        return (self.video.path,)

    def sizes(self) -> Iterator[tuple[Path, tuple[int, int]]]:
        """Width and height of each of the files."""
        yield self.video.path, self.video.size

    def file(self, timestep: int) -> Path | None:
        """The image file whose stored pixels are the frame; None where they are converted."""
        return None

    def close(self) -> None:
        """Release the decoder; the next frame opens it again."""
        if self._container is not None:
            self._container.close()
        self._container = None
        self._decoder = None
        self._decoded = -1

    def _frame(self, number: int) -> Any:
        """The frame, decoded on from the last one, from a key frame before it, or from the
        beginning. Raises ValueError where the decoder gives no frame of that time."""
        from av.error import InvalidDataError

        failure = None
        times = self.video.times
        for decoder in self._decoders(number):
            self._decoder = decoder
            frame = None
            try:
                if self.video.seekable:
                    later = (f for f in decoder if f.pts is not None and f.pts >= times[number])
                    frame = next(later, None)
                    frame = frame if frame is not None and frame.pts == times[number] else None
                else:
                    frame = next(itertools.islice(decoder, number - self._decoded - 1, None), None)
            except InvalidDataError as error:
                failure = error
            if frame is not None:
                self._decoded = number
                return frame
        raise failure or ValueError("the decoder gives no picture for it; the file may be damaged")

    def _decoders(self, number: int) -> Iterator[Iterator[Any]]:
        """Decoders before the frame, the nearest first."""
        from av.error import FFmpegError

        seekable = self.video.seekable
        farthest = MAX_FRAMES_AHEAD if seekable else number + 1
        if self._decoder is not None and 0 < number - self._decoded <= farthest:
            yield self._decoder
        for back in SEEK_BACK_FRAMES if seekable else ():
            if number - back > 0:
                self._open()
                stream = self._container.streams.video[0]
                try:
                    self._container.seek(self.video.times[number - back], stream=stream)
                except FFmpegError:
                    break
                frames = _decoded_frames(self._container)
                yield _from_key_frame(frames, self.video.times[number])
        self.close()
        self._open()
        yield _decoded_frames(self._container)

    def _open(self) -> None:
        if self._container is None:
            self._container = _open(self.video.path)
            self._container.streams.video[0].thread_type = "AUTO"


def first_frames(path: Path) -> Video:
    """Look at the beginning: `times` are those of the first frames, None where one has none, in the
    order shown; without `timesteps` and `fps`. Raises StgaError as `read_video` does."""
    with opened_video(path) as container:
        aspect = container.streams.video[0].sample_aspect_ratio
        aspect = Fraction(aspect) if aspect and aspect > 0 else Fraction(1)
        frames = _decoded_frames(container)
        first = next(frames, None)
        if first is None:
            raise ValueError("none of its frames can be decoded")
        stored = _display_size(first, Fraction(1))
        size = _display_size(first, aspect)
        rest = (frame.pts for frame in itertools.islice(frames, CHECKED_FRAMES - 1))
        times = (first.pts, *rest)
        problems = _unheard(path, first)
    for width, height in (stored, size):
        if not is_image_size(width, height):
            pixels = f"{width} x {height} pixels"
            raise StgaError(f"{path}: has {pixels}, more than are read ({MAX_IMAGE_PIXELS})")
    warnings = tuple(f"{path}: {text}" for text in problems)
    return Video(path, times, (), 0.0, size, stored, aspect, warnings=warnings)


def _display_size(frame: Any, aspect: Fraction) -> tuple[int, int]:
    """(width, height) as displayed, of pixels of that aspect."""
    size = _square_width(frame, aspect), frame.height
    turn = _turn(frame)
    return size[::-1] if turn is not None and turn[0, 0] == 0 else size


def _square_width(frame: Any, aspect: Fraction) -> int:
    width: int = frame.width
    return max(1, round(width * aspect))


def _unheard(path: Path, frame: Any) -> list[str]:
    """Requests of a video that are not followed."""
    sentences = []
    matrix = _display_matrix(frame)
    if matrix is not None:
        length = max(np.hypot(*matrix[0]), 1e-9)
        off = np.sort(np.abs(matrix[0]) / length)[0]
        if off > TURN_TOLERANCE:
            angle = np.degrees(np.arctan2(matrix[0, 1], matrix[0, 0]))
            sentences.append(f"asks to be turned by {angle:.0f}°; only right angles are done")
    if frame.interlaced_frame:
        sentences.append(
            "is interlaced: every second line is of another moment, and fast motion has "
            "combs; deinterlace it"
        )
    aperture = clean_aperture(path)
    if aperture is not None and (aperture[0] < frame.width or aperture[1] < frame.height):
        sentences.append(
            f"asks for {aperture[0]} x {aperture[1]} of its {frame.width} x {frame.height} pixels "
            "(clean aperture); all are used"
        )
    return sentences


@contextmanager
def opened_video(path: Path) -> Iterator[Any]:
    """A container that has a video stream. Raises StgaError for what fails while it is open."""
    av = _pyav(path)
    try:
        with _open(path) as container:
            if not container.streams.video:
                raise ValueError("it has no video stream")
            context = container.streams.video[0].codec_context
            if context.width * context.height > MAX_IMAGE_PIXELS:
                size = f"{context.width} x {context.height} pixels"
                raise StgaError(f"{path}: has {size}, more than are read ({MAX_IMAGE_PIXELS})")
            yield container
    except (av.FFmpegError, ValueError) as error:
        raise StgaError(f"{path}: is not a readable video ({_reason(error)})") from error


def _packet_times(path: Path) -> tuple[list[int], bool]:
    """Presentation times of packets, ascending, without those that an edit list hides; none where
    packets have no times, so that all frames must be decoded. And whether the file ends within a
    packet, which is left out."""
    with opened_video(path) as container:
        stream = container.streams.video[0]
        timed = stream.codec_context.name not in CODECS_WITH_HIDDEN_PACKETS
        timed = timed and _is_of(container, TIMED_CONTAINERS)
        if not (timed or stream.codec_context.codec.intra_only):
            return [], False
        packets = []
        is_cut_off = False
        for packet in container.demux(stream):
            is_cut_off = _is_cut_off(container, packet)
            if is_cut_off:
                break
            if packet.size and not packet.is_discard:
                packets.append(packet.pts)
    times = sorted(time for time in packets if time is not None)
    return times if len(times) == len(packets) and _ascending(times) else [], is_cut_off


def _is_cut_off(container: Any, packet: Any) -> bool:
    """Other containers have corrupt packets in the middle, which decoders conceal."""
    return packet.is_corrupt and _is_of(container, TIMED_CONTAINERS)


def _decoded_frames(container: Any) -> Iterator[Any]:
    """All frames; the first packets of a transport stream may not be decodable."""
    from av.error import InvalidDataError

    stream = container.streams.video[0]
    may_fail = _is_of(container, ("mpegts",))
    for packet in container.demux(stream):
        if _is_cut_off(container, packet):
            yield from stream.decode(None)  # what the decoder still holds
            return
        try:
            frames = packet.decode()
        except InvalidDataError:
            if not may_fail:
                raise
            continue
        may_fail = may_fail and not frames
        yield from frames


def _from_key_frame(frames: Iterator[Any], time: int) -> Iterator[Any]:
    """The frames from the first key frame on, because those before it may refer to frames before
    the seek; none where it is later than `time`."""
    for frame in frames:
        if frame.key_frame:
            yield frame
            yield from frames
        elif frame.pts is not None and frame.pts >= time:
            return


def _ascending(times: Sequence[int | None]) -> bool:
    return None not in times and all(a < b for a, b in itertools.pairwise(times))  # type: ignore[operator]


def _is_of(container: Any, formats: Sequence[str]) -> bool:
    return not set(formats).isdisjoint(container.format.name.split(","))


def _timed(
    path: Path, times: Sequence[int], time_base: float, rates: list[float]
) -> tuple[tuple[int, ...], float, tuple[str, ...]]:
    """Timesteps of the frames, frames per second, and a sentence where the rate varies. The rate is
    the first of the stated ones that the frames' times agree with, else that of the times: what a
    file states also counts frames that are hidden."""
    if len(times) < 2:
        return tuple(range(len(times))), next(iter(rates), 0.0), ()
    durations = np.diff(times)
    longest = VARIABLE_RATE_FACTOR * np.median(durations)
    if durations.max() <= longest:
        fps = (len(times) - 1) / ((times[-1] - times[0]) * time_base)
        agreeing = (rate for rate in rates if abs(rate - fps) <= RATE_TOLERANCE * fps)
        return tuple(range(len(times))), next(agreeing, fps), ()
    typical = durations[durations <= longest]
    fps = 1 / (time_base * float(typical.mean()))
    timesteps = np.round((np.array(times) - times[0]) * time_base * fps).astype(int)
    low, high = (1000 * time_base * float(ticks) for ticks in (durations.min(), durations.max()))
    missing = timesteps[-1] + 1 - len(np.unique(timesteps))
    rate = f"has a variable frame rate (frames last {low:.0f} to {high:.0f} ms)"
    numbered = f"its frames are numbered by their times, {fps:.4g} a second"
    warning = f"{path}: {rate}; {numbered}, and {missing} numbers have none"
    return tuple(timesteps.tolist()), fps, (warning,)


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


def _pixels(frame: Any, aspect: Fraction) -> np.ndarray:
    """(H, W, 3) uint8 sRGB, of square pixels, turned and mirrored as the video asks for."""
    matrix = frame.colorspace
    if matrix == 2 and frame.height >= MIN_HD_LINES:  # FFmpeg's "unspecified"
        matrix = 1  # BT.709
    codes = int(frame.color_primaries), int(frame.color_trc)
    deep = not is_srgb(*codes)  # 8 bits of HDR are too few for its dark colors
    form = {"format": "rgb48le" if deep else "rgb24", "src_colorspace": matrix}
    if aspect != 1:
        form |= {"width": _square_width(frame, aspect), "interpolation": "BICUBIC"}
    rgb = frame.reformat(**form).to_ndarray()
    pixels = to_srgb(rgb, *codes) if deep else rgb
    turn = _turn(frame)
    if turn is None:
        return np.ascontiguousarray(pixels)
    if turn[0, 0] == 0:  # the stored x becomes y
        pixels = pixels.swapaxes(0, 1)
        turn = turn[::-1]
    columns, rows = turn.diagonal().astype(int).tolist()
    return np.ascontiguousarray(pixels[::rows, ::columns])


def _open(path: Path) -> Any:
    """A container, whose decoders refuse frames larger than images may be; raises what PyAV does,
    and StgaError without it."""
    container = _pyav(path).open(file_address(path))
    for stream in container.streams.video:
        stream.codec_context.options = {"max_pixels": str(MAX_IMAGE_PIXELS)}
    return container


def _display_matrix(frame: Any) -> np.ndarray | None:
    """(2, 2): row vector (x, y) of a stored pixel times it, y down, is where it is shown."""
    data = frame.side_data.get("DISPLAYMATRIX")
    if data is None:
        return None
    fixed = np.frombuffer(bytes(data), "<i4")[[0, 1, 3, 4]].reshape(2, 2)
    return fixed / DISPLAY_MATRIX_ONE


def _turn(frame: Any) -> np.ndarray | None:
    """The display matrix as a turn by right angles, of 1, 0 and -1; None for others."""
    matrix = _display_matrix(frame)
    if matrix is None:
        return None
    turn = np.sign(np.round(matrix))
    is_right = np.abs(turn).sum(0).tolist() == np.abs(turn).sum(1).tolist() == [1, 1]
    return turn if is_right else None


def _pyav(path: Path) -> Any:
    try:
        import av
    except ImportError as error:
        raise StgaError(f"{path}: reading videos needs the package av (PyAV)") from error
    return av
