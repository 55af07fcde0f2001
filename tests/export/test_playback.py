"""At how many frames per second a capture plays."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from capture import factory

from stga_addon.capture.open import open_capture
from stga_addon.export.playback import DEFAULT_FPS, playback_fps


@pytest.mark.parametrize(
    ("timesteps", "fps", "in_a_row", "at_their_numbers"),
    [
        (range(5), 60.0, 60.0, 60.0),
        (range(1, 30, 3), 60.0, 20.0, 60.0),
        ([0, 1, 2, 3, 9, 10, 11], 50.0, 50.0, 50.0),
        ([7], 60.0, 60.0, 60.0),
        (range(1, 30, 3), None, DEFAULT_FPS, DEFAULT_FPS),
    ],
)
def test_rate_of_a_capture(tmp_path: Path, timesteps, fps, in_a_row, at_their_numbers) -> None:
    """Catches every third frame of a recording played three times too fast, or too slowly where frames are numbered."""
    capture = replace(open_capture(factory.write_mesh_capture(tmp_path / "ball")), timesteps=tuple(timesteps), fps=fps)
    assert playback_fps(capture) == pytest.approx(in_a_row)
    assert playback_fps(capture, numbered=True) == pytest.approx(at_their_numbers)
    assert playback_fps(capture, 12.5) == playback_fps(None, 12.5, numbered=True) == 12.5
    assert np.isclose(playback_fps(None), DEFAULT_FPS)
