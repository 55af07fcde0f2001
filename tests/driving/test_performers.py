"""The table of performers: what a kind of recording needs to drive a head."""

import wave

import numpy as np
from refusal import refusal

from stga_addon.driving import performers
from stga_addon.driving.open_motion import check_motion
from stga_addon.driving.performance import COLUMN, COUNT, Performance
from stga_addon.driving.performers import Performer, performer_of, read_performance
from stga_addon.jobs.convert_motion import ConvertMotion
from stga_addon.jobs.perform import perform


def heard(path, report):
    """A jaw that opens as a 16-bit sound is loud, 50 times a second."""
    with wave.open(str(path)) as sound:
        rate = sound.getframerate()
        values = np.frombuffer(sound.readframes(sound.getnframes()), "<i2") / 32768
    loudness = np.sqrt((values.reshape(-1, rate // 50) ** 2).mean(axis=1))
    weights = np.zeros((len(loudness), COUNT))
    weights[:, COLUMN["jawOpen"]] = loudness / loudness.max()
    return Performance(np.arange(len(loudness)) / 50, weights, np.zeros((len(loudness), 3)), 50.0)


def test_a_row_is_all_that_a_kind_of_recording_needs(tmp_path, monkeypatch):
    """Catches a conversion, a check or an advice that knows videos by name and not the table."""
    path = tmp_path / "voice.wav"
    envelope = np.repeat(np.sin(np.linspace(0, np.pi, 25)), 160)
    tone = envelope * np.sin(np.arange(4000) * 0.5)
    with wave.open(str(path), "wb") as sound:
        sound.setnchannels(1)
        sound.setsampwidth(2)
        sound.setframerate(8000)
        sound.writeframes((30000 * tone).astype("<i2").tobytes())
    assert performer_of(path) is None
    known = {**performers.PERFORMERS, ".wav": Performer("a sound", heard, False)}
    monkeypatch.setattr(performers, "PERFORMERS", known)
    with refusal("stga drive makes a motion of a sound"):
        check_motion(path)
    perform(ConvertMotion(path, tmp_path / "voice.csv"))
    jaw = read_performance(tmp_path / "voice.csv").weights[:, COLUMN["jawOpen"]]
    np.testing.assert_allclose(jaw, envelope[::160], atol=0.02)
