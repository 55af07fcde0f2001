"""What a capture filmed, in words."""

from dataclasses import replace

import numpy as np

from stga_addon.capture.filmed import describe_filmed, filmed_directions
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
    across, up = filmed_directions(capture, [0]).T
    order = np.argsort(across)
    np.testing.assert_allclose(across[order], AZIMUTHS_DEG, atol=4)
    np.testing.assert_allclose(up[order], ELEVATIONS_DEG, atol=6)
    described = describe_filmed(capture)
    assert " on its right to " in described
    assert "mouthSmile" in described


def test_shoulders_are_no_expression(tmp_path):
    """Catches a torso that turns below the head as a face that moves by decimeters."""
    unpack_capture(tmp_path)
    capture = open_capture(tmp_path)
    lowest = capture.neutral[:, 1] < np.quantile(capture.neutral[:, 1], 0.05)
    shift = {timestep: 0.1 * number for number, timestep in enumerate(capture.timesteps)}

    def shrugged(timestep, pose):
        away = np.where(lowest, shift[timestep], 0)[:, None] * [0, 1, 0]
        return capture.neutral + away

    assert describe_filmed(replace(capture, expression_mesh=shrugged)).endswith("one expression")
