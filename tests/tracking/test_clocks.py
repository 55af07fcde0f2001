"""Offsets of cameras whose clocks differ, from sound and motion."""

import numpy as np
import pytest
from numpy.random import default_rng
from refusal import refusal

from stga_addon.tracking.footage.open import open_footage
from stga_addon.tracking.footage.sequences import FrameRange, best_lag

from .scenes import rig, write_colmap_text

av = pytest.importorskip("av")

SIZE = 64
FPS = 25
SOUND_HZ = 48000
FRAMES = 120


def scene(seed, seconds=12.0):
    """Sound (N,) of speech-like bursts, and a gray level per 1/FPS second."""
    rng = default_rng(seed)
    loudness = np.repeat(rng.random(round(seconds * 12)) ** 4, SOUND_HZ // 12)
    sound = loudness * rng.normal(0, 0.3, len(loudness))
    return sound, np.round(rng.uniform(30, 220, round(seconds * FPS)))


def write_camera(path, sound, levels, start, seed, codec="pcm_s16le"):
    """A recording of FRAMES frames from frame `start` of the scene on, with noise of its own; sound
    None: silent."""
    rng = default_rng(seed)
    with av.open(str(path), "w") as container:
        video = container.add_stream("libx264", rate=FPS, options={"crf": "16"})
        video.width = SIZE
        video.height = SIZE
        video.pix_fmt = "yuv420p"
        if sound is not None:
            audio = container.add_stream(codec, rate=SOUND_HZ, layout="mono")
        for level in levels[start : start + FRAMES]:
            pixels = np.clip(level + rng.normal(0, 6, (SIZE, SIZE, 3)), 0, 255).astype(np.uint8)
            container.mux(video.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(video.encode())
        if sound is None:
            return
        first = start * SOUND_HZ // FPS
        part = sound[first : first + FRAMES * SOUND_HZ // FPS]
        part = np.clip(0.4 * part + rng.normal(0, 0.01, len(part)), -1, 1)
        for at in range(0, len(part), 1024):
            block = (32767 * part[at : at + 1024]).astype(np.int16)[None]
            frame = av.AudioFrame.from_ndarray(block, format="s16", layout="mono")
            frame.sample_rate = SOUND_HZ
            frame.pts = at
            container.mux(audio.encode(frame))
        container.mux(audio.encode())


def footage(folder, starts, silent=(), codec="pcm_s16le", suffix=".mkv", seeds=(5, 5, 5)):
    names = "abc"[: len(starts)]
    for number, (name, start) in enumerate(zip(names, starts, strict=True)):
        sound, levels = scene(seeds[number])
        heard = None if name in silent else sound
        write_camera(folder / f"{name}{suffix}", heard, levels, start, number, codec)
    labels = [f"{name}.png" for name in names]
    write_colmap_text(folder / "sparse/0", rig(len(starts), SIZE, SIZE), labels)
    return folder


@pytest.mark.parametrize(
    ("silent", "sync", "codec", "suffix"),
    [
        ((), "sound", "pcm_s16le", ".mkv"),
        ((), "auto", "aac", ".mp4"),
        (("b",), "auto", "pcm_s16le", ".mkv"),
    ],
)
def test_clocks_that_differ(tmp_path, silent, sync, codec, suffix):
    """Catches an offset with the wrong sign, one that ignores where sound begins, and silence that
    stops it."""
    folder = footage(tmp_path, (20, 33, 9), silent, codec, suffix)
    found = open_footage(folder, frames=FrameRange(sync=sync))
    for camera, start in zip(found.cameras, (20, 33, 9), strict=True):
        assert camera.frames.numbers[found.timesteps[0]] + start == 33
    by = "motion" if silent else "sound"
    assert [f"by their {by}" in sentence for sentence in found.warnings] == [True, True]
    assert "camera b: its recording is 13 frames earlier than that of camera a" in found.warnings[0]


def test_recordings_that_share_nothing(tmp_path):
    """Catches an offset that is made up."""
    footage(tmp_path, (20, 20), seeds=(5, 6))
    for sync in ("sound", "motion"):
        with refusal(rf"b.mkv: its {sync} does not say when camera a recorded the same"):
            open_footage(tmp_path, frames=FrameRange(sync=sync))


def test_sound_that_is_asked_for_and_missing(tmp_path):
    """Catches a traceback, motion used where sound was asked for, and a given offset that is
    replaced."""
    footage(tmp_path, (20, 33), silent="b")
    with refusal(r"b.mkv: has no sound; expected it for --sync sound"):
        open_footage(tmp_path, frames=FrameRange(sync="sound"))
    found = open_footage(tmp_path, frames=FrameRange(sync="motion", offsets={"b": -3}))
    assert [camera.frames.numbers[5] for camera in found.cameras] == [5, 2]


def test_correlation_against_numpy():
    """Catches sums over what two signals do not share: against numpy's coefficient at each lag."""
    rng = default_rng(3)
    reference = rng.normal(5, 1, 300)
    signal = rng.normal(-2, 3, 260)
    signal[40:240] += 2.5 * reference[100:300]
    lag, correlation, distinction = best_lag(reference, signal, 60.0)
    expected = {}
    for shift in range(-240, 201):
        low = max(0, -shift)
        high = min(300, 260 - shift)
        if high - low >= 60:
            found = np.corrcoef(reference[low:high], signal[low + shift : high + shift])[0, 1]
            expected[shift] = found * np.sqrt(high - low)
    assert lag == max(expected, key=expected.get) == -60
    assert correlation == pytest.approx(expected[lag] / np.sqrt(240), abs=1e-9)
    rival = max(value for shift, value in expected.items() if abs(shift - lag) > 12)
    assert distinction == pytest.approx(expected[lag] / rival, rel=1e-6)
