"""How many frames later a camera's video shows the same moment: from sound, or from motion."""

from collections.abc import Callable, Mapping
from itertools import chain

import numpy as np

from ...errors import StgaError
from .video import Video, VideoFrames, opened_video

SOUND_RATE_HZ, SOUND_HOP = 16000, 32  # Sound is compared by its loudness every 2 ms
MIN_OVERLAP_S = 1.0  # Shared time below which two recordings are not compared
MOTION_SIZE = 32  # Pixels of an image's sides, in which motion is measured
MIN_CORRELATION = 0.2  # Correlation below which nothing is shared
MIN_DISTINCTION = 1.5
"""Times that the best lag's score exceeds that of any farther than NEIGHBORHOOD_S away."""
NEIGHBORHOOD_S = 0.2


def clock_offsets(
    videos: Mapping[str, Video], fps: float, by: str
) -> tuple[dict[str, int], tuple[str, ...]]:
    """Camera -> frames by which its recording shows a moment later than the first camera's, and a
    sentence for each.

    by: "sound"; "motion": how much changes from frame to frame; "auto": sound where all have it.
    Raises StgaError where a video has no sound, or where the recordings do not agree on one offset.
    """
    if by == "auto":
        by = "sound"
        for video in videos.values():
            with opened_video(video.path) as container:
                by = by if container.streams.audio else "motion"
    read: Callable[[Video], tuple[np.ndarray, float]] = _loudness if by == "sound" else _motion
    first, *others = videos
    reference, start = read(videos[first])
    rate = SOUND_RATE_HZ / SOUND_HOP if by == "sound" else fps
    offsets, sentences = {first: 0}, []
    for name in others:
        signal, begins = read(videos[name])
        lag, correlation, distinction = best_lag(reference, signal, rate)
        if correlation < MIN_CORRELATION or distinction < MIN_DISTINCTION:
            raise StgaError(
                f"{videos[name].path}: its {by} does not say when camera {first} recorded the "
                "same; give --offset"
            )
        offsets[name] = round((lag / rate + begins - start) * fps)
        frames = f"{abs(offsets[name])} frames {'later' if offsets[name] >= 0 else 'earlier'}"
        sentences.append(
            f"camera {name}: its recording is {frames} than that of camera {first}, by their {by} "
            f"(correlation {correlation:.2f})"
        )
    return offsets, tuple(sentences)


def best_lag(reference: np.ndarray, signal: np.ndarray, rate: float) -> tuple[int, float, float]:
    """The lag at which signal[t + lag] follows reference[t] most certainly, their correlation there
    (−1 to 1), and how many times its score exceeds all that are farther than NEIGHBORHOOD_S away.

    Signals (N,) and (M,) of `rate` values a second. The score is the correlation over the values
    that both have, MIN_OVERLAP_S at least, times the root of their number: of few values, chance
    makes a high correlation.
    """
    size = len(reference) + len(signal) - 1
    least = min(len(reference), len(signal), round(MIN_OVERLAP_S * rate))

    def sums(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Σ a[t] b[t + lag] for each lag, from −(N − 1) on."""
        return np.fft.irfft(np.fft.rfft(a[::-1], size) * np.fft.rfft(b, size), size)

    one, other = np.ones(len(reference)), np.ones(len(signal))
    count = np.maximum(np.round(sums(one, other)), 1)
    mean, means = sums(reference, other) / count, sums(one, signal) / count
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
        stream, pictures = container.streams.audio[0], container.streams.video[0]
        resampler = AudioResampler(format="flt", layout="mono", rate=SOUND_RATE_HZ)
        parts: list[np.ndarray] = [np.zeros(0, np.float32)]
        begin = None
        for frame in chain(container.decode(stream), [None]):  # which ends the sound
            begin = float(frame.time or 0) if frame and begin is None else begin
            parts += [np.ravel(each.to_ndarray()) for each in resampler.resample(frame)]
        first_picture = video.times[0] * float(pictures.time_base) if video.seekable else 0.0
    sound = np.concatenate(parts).astype(np.float64)
    blocks = sound[: len(sound) // SOUND_HOP * SOUND_HOP].reshape(-1, SOUND_HOP)
    energy = np.log((blocks**2).mean(axis=1) + 1e-7)
    return np.maximum(np.diff(energy, prepend=energy[:1]), 0), (begin or 0.0) - first_picture


def _motion(video: Video) -> tuple[np.ndarray, float]:
    """Mean change of small gray images from one timestep to the next; the first is 0."""
    from PIL import Image

    frames = VideoFrames(video, dict(enumerate(range(len(video.times)))))
    changes, last = [0.0], None
    for number in frames.timesteps:
        image = Image.fromarray(frames.image(number)).convert("L")
        gray = np.asarray(image.resize((MOTION_SIZE,) * 2, Image.Resampling.BOX), np.float64)
        if last is not None:
            changes.append(float(np.abs(gray - last).mean()))
        last = gray
    timesteps = np.array(video.timesteps)
    return np.interp(np.arange(timesteps[-1] + 1), timesteps, changes), 0.0
