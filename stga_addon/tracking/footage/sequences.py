"""Frames of cameras that recorded a sequence each, in step."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from ...capture.images import image_size
from ...capture.model import FPS_LIMIT, View
from ...errors import StgaError
from .clocks import clock_offsets
from .model import Frames, ImageFrames
from .shots import Shot
from .sources import Sources, frame_number
from .video import Video, VideoFrames, read_video


@dataclass(frozen=True)
class FrameRange:
    """Which frames are used: `start`, `start` + `step`, … before `stop` (None: to the end), counted
    from 0.

    offsets  camera -> how many frames later its recording shows the same moment; 0 for those not
             named
    sync     how offsets that are not given are found, "sound", "motion" or "auto" as in
             `clock_offsets`, or "none"
    """

    start: int = 0
    stop: int | None = None
    step: int = 1
    offsets: Mapping[str, int] = field(default_factory=dict)
    sync: str = "none"

    def __post_init__(self) -> None:
        if self.start < 0 or self.step < 1 or (self.stop is not None and self.stop <= self.start):
            stop = "the end" if self.stop is None else self.stop
            raise StgaError(
                f"Frames {self.start} to {stop} in steps of {self.step} are none; "
                "expected at least one"
            )

    def selects(self, timestep: int) -> bool:
        before_stop = self.stop is None or timestep < self.stop
        return before_stop and timestep >= self.start and (timestep - self.start) % self.step == 0


Sequence = Video | list[Path]  # A camera's recording: a video, or images in order


def open_sequence(files: Path | list[Path]) -> Sequence:
    """Index a video; images are taken as they are. Raises StgaError for an unreadable one."""
    return read_video(files) if isinstance(files, Path) else files


def sequence_size(sequence: Sequence) -> tuple[int, int]:
    """(width, height) of the first frame. Raises StgaError where it is no image."""
    return sequence.size if isinstance(sequence, Video) else image_size(sequence[0])


def synchronized(
    sequences: Mapping[str, Sequence],
    shots: Mapping[str, Shot],
    sources: Sources,
    frames: FrameRange,
) -> tuple[dict[str, Frames], float | None, tuple[str, ...]]:
    """Frames of each camera, those of the videos a second (None where none says a plausible
    number), and a sentence for each clock that was compared.

    Timestep t is frame t + offset of a recording. Timesteps of which a video whose rate varies has
    no frame are left out. Raises StgaError where a camera has fewer frames than another, lacks one
    in between, is of another size or has another rate, and where clocks cannot be compared.
    """
    fps, sentences = _frames_per_second(sequences), tuple[str, ...]()
    if frames.sync != "none":
        videos = {name: own for name, own in sequences.items() if isinstance(own, Video)}
        if len(videos) < max(2, len(sequences)) or fps is None:
            raise StgaError(
                f"{sources.root}: expected a video of each of several cameras, "
                "whose clocks --sync compares"
            )
        found, sentences = clock_offsets(videos, fps, frames.sync)
        frames = replace(frames, offsets={**found, **frames.offsets})
    unknown = set(frames.offsets) - set(sequences)
    if unknown:
        raise StgaError(f"Offset for camera {min(unknown)}: expected one of {', '.join(sequences)}")
    recorded, offsets = {}, {name: frames.offsets.get(name, 0) for name in sequences}
    for name, own in sequences.items():  # timestep -> number of the frame, the first of several
        shown = own.timesteps if isinstance(own, Video) else range(len(own))
        pairs = reversed(list(enumerate(shown)))
        recorded[name] = {timestep - offsets[name]: number for number, timestep in pairs}
    first, last = _common_range(sequences, frames, offsets)
    shared = sorted(set.intersection(*(set(own) for own in recorded.values())))
    timesteps = [t for t in shared if first <= t < last and frames.selects(t)]
    if not timesteps:
        raise StgaError(f"Frames from {frames.start} on: the cameras have only {last} in common")
    _require_same_gaps(sequences, offsets, timesteps)
    result: dict[str, Frames] = {}
    for name, own in sequences.items():
        numbers = {t: recorded[name][t] for t in timesteps}
        size, shot, camera = sequence_size(own), shots[name], shots[name].camera
        if size != (camera.width, camera.height):
            raise StgaError(
                f"{own.path if isinstance(own, Video) else own[0]}: has {size[0]} x {size[1]} "
                f"pixels, but {shot.where} has {camera.width} x {camera.height}"
            )
        if isinstance(own, Video):
            result[name] = VideoFrames(own, numbers)
            continue
        files = {t: own[number] for t, number in numbers.items()}
        masks = {t: sources.mask_of(file) for t, file in files.items()}
        result[name] = ImageFrames(
            {t: View(t, 0, camera, shot.label, files[t], masks[t]) for t in timesteps}
        )
    return result, fps, sentences


def _frames_per_second(sequences: Mapping[str, Sequence]) -> float | None:
    videos = {name: own for name, own in sequences.items() if isinstance(own, Video)}
    rates = {name: own.fps for name, own in videos.items() if 0 < own.fps < FPS_LIMIT}
    first = next(iter(rates), None)
    for name, rate in rates.items():
        if first is not None and abs(rate - rates[first]) > 0.01 * rates[first]:
            raise StgaError(
                f"The video of camera {name} has {rate:g} frames a second, "
                f"that of camera {first} {rates[first]:g}; expected one rate"
            )
    return None if first is None else rates[first]


def _common_range(
    sequences: Mapping[str, Sequence], frames: FrameRange, offsets: Mapping[str, int]
) -> tuple[int, int]:
    """Timesteps (first, last + 1) that all cameras have.

    Recordings of different length may start at different moments, so they need a `stop` or offsets.
    """
    lengths = {
        name: own.timesteps[-1] + 1 if isinstance(own, Video) else len(own)
        for name, own in sequences.items()
    }
    longest = max(lengths, key=lambda name: lengths[name])
    for name, length in lengths.items():
        if frames.stop is not None and length - offsets[name] < frames.stop:
            raise StgaError(
                f"Camera {name} has {length} frames; "
                f"expected all up to {frames.stop} and its offset"
            )
        if frames.stop is None and not frames.offsets and length != lengths[longest]:
            raise StgaError(
                f"Camera {name} has {length} frames and camera {longest} {lengths[longest]}; "
                "expected recordings of the same length, offsets, or the number of the last frame"
            )
    first = max(0, *(-offset for offset in offsets.values()))
    return first, min(length - offsets[name] for name, length in lengths.items())


def _require_same_gaps(
    sequences: Mapping[str, Sequence], offsets: Mapping[str, int], timesteps: list[int]
) -> None:
    """Raise StgaError where the numbers in image names say that cameras lack different frames."""
    patterns: dict[str, list[int]] = {}
    for name, sequence in sequences.items():
        if isinstance(sequence, Video):
            continue
        paths = [sequence[t + offsets[name]] for t in timesteps]
        found = [number for number in map(frame_number, paths) if number is not None]
        if len(found) < len(paths) or len(set(found)) < len(found):
            continue
        patterns[name] = [number - found[0] for number in found]
        first = next(iter(patterns))
        for path, own, other in zip(paths, patterns[name], patterns[first], strict=True):
            if own != other:
                raise StgaError(
                    f"{path}: is {own} frames after the first of camera {name}, "
                    f"where camera {first} has one {other} after its first; "
                    "expected no missing frames, or the same ones"
                )
