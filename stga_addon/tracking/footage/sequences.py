"""Frames of cameras that recorded a sequence each, in step."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ...capture.images import image_size
from ...capture.model import FPS_LIMIT, View
from ...errors import StgaError
from .image_frames import ImageFrames
from .model import Frames
from .shots import Shot
from .sources import Sources, frame_number
from .video import Video, VideoFrames, read_video, video_size


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
                f"Frames {self.start} to {stop} in steps of {self.step} are none; expected at least one"
            )

    def selects(self, timestep: int) -> bool:
        before_stop = self.stop is None or timestep < self.stop
        return before_stop and timestep >= self.start and (timestep - self.start) % self.step == 0


Sequence = Video | list[Path]
"""A camera's recording: a video, or images in order."""


def open_sequence(files: Path | list[Path]) -> Sequence:
    """Index a video; images are taken as they are. Raises StgaError where the video cannot be
    read."""
    return read_video(files) if isinstance(files, Path) else files


def recorded_size(files: Path | list[Path]) -> tuple[int, int]:
    """(width, height) of the first frame, without an index of the video. Raises StgaError as
    `open_sequence` does."""
    return video_size(files) if isinstance(files, Path) else image_size(files[0])


def sequence_size(sequence: Sequence) -> tuple[int, int]:
    """(width, height) of the first frame. Raises StgaError where it is no image."""
    return sequence.size if isinstance(sequence, Video) else image_size(sequence[0])


def frames_per_second(sequences: Mapping[str, Sequence]) -> float | None:
    """Of the videos; None where none says a plausible one. Raises StgaError for videos of different
    rates."""
    rates = {
        name: s.fps
        for name, s in sequences.items()
        if isinstance(s, Video) and 0 < s.fps < FPS_LIMIT
    }
    first = next(iter(rates), None)
    for name, rate in rates.items():
        if first is not None and abs(rate - rates[first]) > 0.01 * rates[first]:
            raise StgaError(
                f"The video of camera {name} has {rate:g} frames a second, that of camera {first} {rates[first]:g}; "
                "expected one rate"
            )
    return None if first is None else rates[first]


def synchronized(
    sequences: Mapping[str, Sequence],
    shots: Mapping[str, Shot],
    sources: Sources,
    frames: FrameRange,
) -> dict[str, Frames]:
    """Frames of each camera; timestep t is frame t + offset of its recording. Timesteps of which a
    video whose rate varies has no frame are left out.

    Raises StgaError where a camera has fewer frames than another, lacks one in between, or is of
    another size.
    """
    unknown = set(frames.offsets) - set(sequences)
    if unknown:
        raise StgaError(f"Offset for camera {min(unknown)}: expected one of {', '.join(sequences)}")
    first, last = _common_range(sequences, frames)
    recorded = {name: _numbers(sequence) for name, sequence in sequences.items()}
    shared = set.intersection(
        *(
            {number - frames.offsets.get(name, 0) for number in own}
            for name, own in recorded.items()
        )
    )
    timesteps = [t for t in sorted(shared) if first <= t < last and frames.selects(t)]
    if not timesteps:
        raise StgaError(f"Frames from {frames.start} on: the cameras have only {last} in common")
    _require_same_gaps(sequences, frames, timesteps)
    result = {}
    for name, sequence in sequences.items():
        numbers = {t: recorded[name][t + frames.offsets.get(name, 0)] for t in timesteps}
        result[name] = _frames(sequence, numbers, shots[name], sources)
    return result


def _numbers(sequence: Sequence) -> dict[int, int]:
    """Timestep, without offset -> number of the frame, the first of several."""
    if not isinstance(sequence, Video):
        return dict(enumerate(range(len(sequence))))
    return {timestep: number for number, timestep in reversed(list(enumerate(sequence.timesteps)))}


def _common_range(sequences: Mapping[str, Sequence], frames: FrameRange) -> tuple[int, int]:
    """Timesteps (first, last + 1) that all cameras have.

    Recordings of different length may start at different moments, so they need a `stop` or offsets.
    """
    lengths = {
        name: s.timesteps[-1] + 1 if isinstance(s, Video) else len(s)
        for name, s in sequences.items()
    }
    longest = max(lengths, key=lambda name: lengths[name])
    for name, length in lengths.items():
        if frames.stop is not None and length - frames.offsets.get(name, 0) < frames.stop:
            raise StgaError(
                f"Camera {name} has {length} frames; expected all up to {frames.stop} and its offset"
            )
        if frames.stop is None and not frames.offsets and length != lengths[longest]:
            raise StgaError(
                f"Camera {name} has {length} frames and camera {longest} {lengths[longest]}; expected recordings of "
                "the same length, offsets, or the number of the last frame"
            )
    first = max(0, *(-frames.offsets.get(name, 0) for name in lengths))
    return first, min(length - frames.offsets.get(name, 0) for name, length in lengths.items())


def _require_same_gaps(
    sequences: Mapping[str, Sequence], frames: FrameRange, timesteps: list[int]
) -> None:
    """Raise StgaError where the numbers in image names say that cameras lack different frames."""
    patterns: dict[str, list[int]] = {}
    for name, sequence in sequences.items():
        if isinstance(sequence, Video):
            continue
        paths = [sequence[t + frames.offsets.get(name, 0)] for t in timesteps]
        found = [number for number in map(frame_number, paths) if number is not None]
        if len(found) < len(paths) or len(set(found)) < len(found):
            continue
        patterns[name] = [number - found[0] for number in found]
        first = next(iter(patterns))
        for path, own, other in zip(paths, patterns[name], patterns[first], strict=True):
            if own != other:
                raise StgaError(
                    f"{path}: is {own} frames after the first of camera {name}, where camera {first} has one "
                    f"{other} after its first; expected no missing frames, or the same ones"
                )


def _frames(sequence: Sequence, numbers: dict[int, int], shot: Shot, sources: Sources) -> Frames:
    size, camera = sequence_size(sequence), shot.camera
    if size != (camera.width, camera.height):
        path = sequence.path if isinstance(sequence, Video) else sequence[0]
        expected = f"{camera.width} x {camera.height}"
        raise StgaError(
            f"{path}: has {size[0]} x {size[1]} pixels, but {shot.where} has {expected}"
        )
    if isinstance(sequence, Video):
        return VideoFrames(sequence, numbers)
    views = {
        t: View(t, 0, camera, shot.label, sequence[number], sources.mask_of(sequence[number]))
        for t, number in numbers.items()
    }
    return ImageFrames(views)
