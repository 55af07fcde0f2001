"""Frames of cameras that recorded a sequence each, synchronized by given offsets, or by offsets
found in sound or motion."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import numpy as np

from ...capture.images import image_size
from ...capture.model import FPS_LIMIT, View, evenly_spread
from ...errors import StgaError
from .model import Frames, ImageFrames
from .shots import Shot
from .sources import Sources, frame_number
from .video import Video, VideoFrames, opened_video, read_video

SOUND_RATE_HZ = 16000
"""Rate at which sound is resampled."""
SOUND_HOP = 32
"""Samples of each value of loudness, by which sound is compared: 2 ms."""
MIN_OVERLAP_S = 1.0
"""Common time below which two recordings are not compared."""
MOTION_SIZE = 32
"""Side in pixels of the images in which motion is measured."""
MIN_CORRELATION = 0.2
"""Correlation below which recordings have nothing in common."""
MIN_DISTINCTION = 1.5
"""Times that the best lag's score exceeds that of any farther than NEIGHBORHOOD_S away."""
NEIGHBORHOOD_S = 0.2


@dataclass(frozen=True)
class FrameRange:
    """Frames that are used: `start`, `start` + `step`, … before `stop` (None: to the end), counted
    from 0.

    offsets  camera -> how many frames later its recording shows the same moment; 0 for those not
             named
    sync     how offsets that are not given are found, "sound", "motion" or "auto" as in
             `clock_offsets`, or "none"
    most     at most so many of the frames are used, evenly spread; None: all
    """

    start: int = 0
    stop: int | None = None
    step: int = 1
    offsets: Mapping[str, int] = field(default_factory=dict)
    sync: str = "none"
    most: int | None = None

    def __post_init__(self) -> None:
        if self.start < 0 or self.step < 1 or (self.stop is not None and self.stop <= self.start):
            stop = "the end" if self.stop is None else self.stop
            raise StgaError(
                f"Frames {self.start} to {stop} in steps of {self.step} are none; expected at "
                "least one"
            )

    def chosen(self, timesteps: Iterable[int]) -> list[int]:
        """Those of ascending timesteps that are used."""
        found = [t for t in timesteps if t >= self.start and (t - self.start) % self.step == 0]
        found = [t for t in found if self.stop is None or t < self.stop]
        return found if self.most is None else evenly_spread(found, self.most)


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
    """Frames of each camera, those of the videos a second (None where none has a plausible number),
    and a sentence for each clock that was compared.

    Timestep t is frame t + offset of a recording. Timesteps of which a video whose rate varies has
    no frame are left out. Raises StgaError where a camera has fewer frames than another, lacks one
    in between, is of another size or has another rate, and where clocks cannot be compared.
    """
    fps = _frames_per_second(sequences)
    sentences = tuple[str, ...]()
    if frames.sync != "none":
        videos = {
            name: sequence for name, sequence in sequences.items() if isinstance(sequence, Video)
        }
        if len(videos) < max(2, len(sequences)) or fps is None:
            raise StgaError(
                f"{sources.root}: expected a video of each of several cameras, whose clocks "
                "--sync compares"
            )
        found, sentences = clock_offsets(videos, fps, frames.sync)
        frames = replace(frames, offsets={**found, **frames.offsets})
    unknown = set(frames.offsets) - set(sequences)
    if unknown:
        raise StgaError(f"Offset for camera {min(unknown)}: expected one of {', '.join(sequences)}")
    recorded = {}
    offsets = {name: frames.offsets.get(name, 0) for name in sequences}
    for (
        name,
        sequence,
    ) in sequences.items():  # timestep -> number of the frame, the first of several
        numbered = sequence.timesteps if isinstance(sequence, Video) else range(len(sequence))
        pairs = reversed(list(enumerate(numbered)))
        recorded[name] = {timestep - offsets[name]: number for number, timestep in pairs}
    first, last = _common_range(sequences, frames, offsets)
    shared = sorted(set.intersection(*(set(frame_numbers) for frame_numbers in recorded.values())))
    timesteps = frames.chosen(t for t in shared if first <= t < last)
    if not timesteps:
        raise StgaError(f"Frames from {frames.start} on: the cameras have only {last} in common")
    _require_same_gaps(sequences, offsets, timesteps)
    result: dict[str, Frames] = {}
    for name, sequence in sequences.items():
        numbers = {t: recorded[name][t] for t in timesteps}
        if isinstance(sequence, Video):
            result[name] = VideoFrames(sequence, numbers)
            continue
        views = {}
        shot = shots[name]
        for t, number in numbers.items():
            mask = sources.mask_of(sequence[number])
            views[t] = View(t, 0, shot.camera, shot.label, sequence[number], mask)
        result[name] = ImageFrames(views)
    return result, fps, sentences


def _frames_per_second(sequences: Mapping[str, Sequence]) -> float | None:
    rates = {
        name: sequence.fps for name, sequence in sequences.items() if isinstance(sequence, Video)
    }
    rates = {name: rate for name, rate in rates.items() if 0 < rate < FPS_LIMIT}
    first, common = next(iter(rates.items()), ("", None))
    for name, rate in rates.items():
        if common is not None and abs(rate - common) > 0.01 * common:
            raise StgaError(
                f"The video of camera {name} has {rate:g} frames a second, that of camera "
                f"{first} {common:g}; expected one rate"
            )
    return common


def _common_range(
    sequences: Mapping[str, Sequence], frames: FrameRange, offsets: Mapping[str, int]
) -> tuple[int, int]:
    """Timesteps (first, last + 1) that all cameras have. Recordings of different length may start
    at different moments, so they need a `stop` or offsets."""
    lengths = {
        name: sequence.timesteps[-1] + 1 if isinstance(sequence, Video) else len(sequence)
        for name, sequence in sequences.items()
    }
    longest = max(lengths, key=lambda name: lengths[name])
    for name, length in lengths.items():
        has = f"Camera {name} has {length} frames"
        if frames.stop is not None and length - offsets[name] < frames.stop:
            raise StgaError(f"{has}; expected all up to {frames.stop} and its offset")
        if frames.stop is None and not frames.offsets and length != lengths[longest]:
            has += f" and camera {longest} {lengths[longest]}"
            raise StgaError(
                f"{has}; expected recordings of the same length, offsets, or the number of the "
                "last frame"
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
        for path, gap, other in zip(paths, patterns[name], patterns[first], strict=True):
            if gap != other:
                raise StgaError(
                    f"{path}: is {gap} frames after the first of camera {name}, where camera "
                    f"{first} has one {other} after its first; expected no missing frames, or "
                    "the same ones"
                )


def clock_offsets(
    videos: Mapping[str, Video], fps: float, by: str
) -> tuple[dict[str, int], tuple[str, ...]]:
    """Camera -> frames by which its recording shows a moment later than the first camera's, and a
    sentence for each. by: "sound"; "motion": how much changes from frame to frame; "auto": sound
    where all have it. Raises StgaError where a video has no sound, or where the recordings do not
    agree on one offset."""
    if by == "auto":
        by = "sound"
        for video in videos.values():
            with opened_video(video.path) as container:
                by = by if container.streams.audio else "motion"
    read: Callable[[Video], tuple[np.ndarray, float]] = _loudness if by == "sound" else _motion
    first, *others = videos
    reference, start = read(videos[first])
    rate = SOUND_RATE_HZ / SOUND_HOP if by == "sound" else fps
    offsets = {first: 0}
    sentences = []
    for name in others:
        signal, begins = read(videos[name])
        lag, correlation, distinction = best_lag(reference, signal, rate)
        if correlation < MIN_CORRELATION or distinction < MIN_DISTINCTION:
            raise StgaError(
                f"{videos[name].path}: its {by} does not say when camera {first} recorded the "
                "same; give --offset"
            )
        offsets[name] = round((lag / rate + begins - start) * fps)
        sentences.append(
            f"camera {name}: its recording is {abs(offsets[name])} frames "
            f"{'later' if offsets[name] >= 0 else 'earlier'} than that of camera {first}, by "
            f"their {by} (correlation {correlation:.2f})"
        )
    return offsets, tuple(sentences)


def best_lag(reference: np.ndarray, signal: np.ndarray, rate: float) -> tuple[int, float, float]:
    """The lag with the highest score of signal[t + lag] against reference[t], their correlation
    there (−1 to 1), and the ratio of its score to the best one farther away than NEIGHBORHOOD_S.

    Signals (N,) and (M,) of `rate` values a second. The score is the correlation over the values
    that both have, MIN_OVERLAP_S at least, times the root of their number: of few values, chance
    makes a high correlation.
    """
    size = len(reference) + len(signal) - 1
    least = min(len(reference), len(signal), round(MIN_OVERLAP_S * rate))

    def sums(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Σ a[t] b[t + lag] for each lag, starting at −(N − 1)."""
        return np.fft.irfft(np.fft.rfft(a[::-1], size) * np.fft.rfft(b, size), size)

    one = np.ones(len(reference))
    other = np.ones(len(signal))
    count = np.maximum(np.round(sums(one, other)), 1)
    mean = sums(reference, other) / count
    means = sums(one, signal) / count
    shared = sums(reference, signal) / count - mean * means
    spread = sums(reference**2, other) / count - mean**2
    spread = spread * (sums(one, signal**2) / count - means**2)
    known = (count >= least) & (spread > 1e-6 * reference.var() * signal.var())
    correlation = np.where(known, shared / np.sqrt(np.maximum(spread, 1e-30)), -1.0)
    score = correlation * np.sqrt(count)
    best = int(score.argmax())
    far = np.abs(np.arange(size) - best) > NEIGHBORHOOD_S * rate
    distinction = float(score[best]) / max(float(score[far].max(initial=0.0)), 1e-3)
    return best - (len(reference) - 1), float(correlation[best]), distinction


def _loudness(video: Video) -> tuple[np.ndarray, float]:
    """Rise of loudness every SOUND_HOP samples; seconds by which it begins after the pictures."""
    from av import AudioResampler

    with opened_video(video.path) as container:
        if not container.streams.audio:
            raise StgaError(f"{video.path}: has no sound; expected it for --sync sound")
        stream = container.streams.audio[0]
        pictures = container.streams.video[0]
        resampler = AudioResampler(format="flt", layout="mono", rate=SOUND_RATE_HZ)
        energies: list[np.ndarray] = [np.zeros(0)]
        rest = np.zeros(0)
        begin = None
        for frame in chain(container.decode(stream), [None]):  # which ends the sound
            begin = float(frame.time or 0) if frame and begin is None else begin
            parts = [np.ravel(each.to_ndarray()) for each in resampler.resample(frame)]
            rest = np.concatenate([rest, *parts])
            blocks = rest[: len(rest) // SOUND_HOP * SOUND_HOP].reshape(-1, SOUND_HOP)
            energies.append(np.log((blocks**2).mean(axis=1) + 1e-7))
            rest = rest[blocks.size :]
        first_picture = video.times[0] * float(pictures.time_base) if video.seekable else 0.0
    energy = np.concatenate(energies)
    return np.maximum(np.diff(energy, prepend=energy[:1]), 0), (begin or 0.0) - first_picture


def _motion(video: Video) -> tuple[np.ndarray, float]:
    """Mean change of small gray images from one timestep to the next; the first is 0."""
    from PIL import Image

    frames = VideoFrames(video, dict(enumerate(range(len(video.times)))))
    changes = [0.0]
    last = None
    for number in frames.timesteps:
        image = Image.fromarray(frames.image(number)).convert("L")
        gray = np.asarray(image.resize((MOTION_SIZE,) * 2, Image.Resampling.BOX), np.float64)
        if last is not None:
            changes.append(float(np.abs(gray - last).mean()))
        last = gray
    timesteps = np.array(video.timesteps)
    return np.interp(np.arange(timesteps[-1] + 1), timesteps, changes), 0.0
