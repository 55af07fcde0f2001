"""What a capture filmed, in words and as a picture."""

from dataclasses import replace

import numpy as np
import pytest

from stga_addon.capture.coverage import (
    ONE_EXPRESSION,
    CaptureCoverage,
    capture_coverage,
    directions_picture,
    observed_directions,
)
from stga_addon.capture.open import open_capture
from stga_addon.development.demo.capture import unpack_capture

AZIMUTHS_DEG = np.linspace(-70, 70, 9)
ELEVATIONS_DEG = np.where(np.arange(9) % 2, -9.0, 8.0)
"""Of the demo's cameras about the head, which looks straight ahead at its first timestep."""


def test_directions_and_expressions(tmp_path):
    """Catches left and right or up and down exchanged, directions in the world instead of the
    head's, and expressions that are not named, or named of a take that has but one."""
    unpack_capture(tmp_path)
    capture = open_capture(tmp_path)
    across, up = observed_directions(capture, [0]).T
    order = np.argsort(across)
    np.testing.assert_allclose(across[order], AZIMUTHS_DEG, atol=4)
    np.testing.assert_allclose(up[order], ELEVATIONS_DEG, atol=6)
    described = capture_coverage(capture).text
    assert " on its right to " in described
    assert "mouthSmile" in described


@pytest.mark.parametrize(
    ("across", "up", "text", "expected"),
    [
        ((-50, 100), 0, "9 moments", "for its right"),
        ((-20, 20), 0, "9 moments", "for its right and left"),
        ((-100, 100), 5, ONE_EXPRESSION, "the face talking"),
        ((-100, 100), 5, "9 moments", ""),
    ],
)
def test_what_to_film_next(across, up, text, expected):
    """Catches a side that is said to be missing and was filmed, or the other one; and a picture
    whose left is the head's right, or whose front looks up."""
    degrees = np.arange(across[0], across[1] + 1, 15.0)
    seen = CaptureCoverage(np.stack([degrees, np.full(len(degrees), up)], 1), text)
    assert expected in seen.next_take
    assert bool(seen.next_take) == bool(expected)
    picture = directions_picture(tuple(seen.cells))
    green = picture[..., 1] > 0.61
    rows, columns = np.nonzero(green & (picture[..., 0] < 0.2)) - np.array([[79.5], [79.5]])
    found = np.degrees(np.arctan2(columns, -rows))
    assert abs(found.min() - across[0]) < 15
    assert abs(found.max() - across[1]) < 15


def test_shoulders_are_no_expression(tmp_path):
    """Catches a torso that turns below the head as a face that moves by decimeters."""
    unpack_capture(tmp_path)
    capture = open_capture(tmp_path)
    lowest = capture.neutral[:, 1] < np.quantile(capture.neutral[:, 1], 0.05)
    shift = {timestep: 0.1 * number for number, timestep in enumerate(capture.timesteps)}

    def shrugged(timestep, pose):
        away = np.where(lowest, shift[timestep], 0)[:, None] * [0, 1, 0]
        return capture.neutral + away

    assert capture_coverage(replace(capture, expression_mesh=shrugged)).text.endswith(
        "one expression"
    )
