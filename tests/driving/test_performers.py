"""The table of performers: what a kind of recording needs to drive a head."""

import numpy as np
from refusal import refusal

from stga_addon.driving import performers
from stga_addon.driving.open_motion import check_motion
from stga_addon.driving.performance import COLUMN, COUNT, Performance
from stga_addon.driving.performers import Performer, performer_of, read_performance
from stga_addon.jobs.convert_motion import ConvertMotion
from stga_addon.jobs.perform import perform


def heard(path, report):
    """A jaw as open as the file's bytes say, 50 times a second."""
    levels = np.frombuffer(path.read_bytes(), np.uint8) / 255
    weights = levels[:, None] * (np.arange(COUNT) == COLUMN["jawOpen"])
    return Performance(np.arange(len(levels)) / 50, weights, None, 50.0)


def test_a_row_is_all_that_a_kind_of_recording_needs(tmp_path, monkeypatch):
    """Catches a conversion, a check or an advice that knows videos by name and not the table."""
    path = tmp_path / "voice.wav"
    path.write_bytes(bytes(range(0, 250, 10)))
    assert performer_of(path) is None
    known = {**performers.PERFORMERS, ".wav": Performer("a sound", heard, False)}
    monkeypatch.setattr(performers, "PERFORMERS", known)
    with refusal("stga drive makes a motion of a sound"):
        check_motion(path)
    perform(ConvertMotion(path, tmp_path / "voice.csv"))
    jaw = read_performance(tmp_path / "voice.csv").weights[:, COLUMN["jawOpen"]]
    np.testing.assert_allclose(jaw, np.arange(0, 250, 10) / 255, atol=1e-6)
