"""Motion of one person on another's head."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.driving.open_motion import (
    MotionOptions,
    adapted,
    exchanged_neutral,
    led_back,
    outside,
    quiet_neutral,
    quiet_weights,
    trained_range,
)
from stga_addon.driving.performance import Performance, relative_to
from stga_addon.flame.forward import FlameFrame

ZERO = np.zeros(3)
FRAME = FlameFrame(np.zeros(4), ZERO, ZERO, ZERO, ZERO, np.zeros(6))


def talking(bias, count=60):
    """Quiet for a third of the time, on top of what a face leaves in the coefficients."""
    time = np.arange(count)
    moves = np.where(time < count // 3, 0, np.sin(time))[:, None] * [2.0, -1.0, 0.5, 0.0]
    return [
        replace(FRAME, expr=bias + row, jaw_pose=np.array([0.1 * max(row[0], 0), 0, 0]))
        for row in moves
    ]


def test_the_performers_own_face_is_left_out():
    """Catches a neutral from the middle of speech, or with the other's face in it."""
    bias = np.array([1.5, -0.7, 0.3, 2.0])
    own = np.array([0.2, 0.0, -0.1, 0.0])
    frames = talking(bias)
    theirs = quiet_neutral(frames)
    assert_allclose(theirs["face"], bias)
    assert_allclose(theirs["jaw"], 0)
    moved = exchanged_neutral(frames, theirs, quiet_neutral(talking(own)))
    for frame, expected in zip(moved, talking(own), strict=True):
        assert_allclose(frame.expr, expected.expr, atol=1e-12)
        assert_allclose(frame.jaw_pose, expected.jaw_pose, atol=1e-12)
    frames = talking(bias, 3000)
    shuffled = [frames[row] for row in np.random.default_rng(0).permutation(len(frames))]
    assert_allclose(quiet_neutral(shuffled)["face"], bias, atol=1e-12)


@pytest.mark.parametrize("choice", ["quiet", "first", "calibrated"])
def test_a_motion_begins_on_the_heads_own_face(choice):
    """Catches a head that is put at rest on coefficients of zero, where it was never seen."""
    own = talking(np.array([0.2, 0.0, -0.1, 0.4]))
    own[0] = replace(own[0], expr=own[0].expr + 1)
    trained = trained_range(own)
    rest = np.zeros(4) if choice == "calibrated" else np.array([1.0, 2.0, 3.0, 4.0])
    moved, _ = adapted(talking(rest), MotionOptions(neutral=choice), trained)
    expected = own[0].expr if choice == "first" else own[1].expr
    assert_allclose(moved[0].expr, expected, atol=1e-12)
    change = talking(rest)[-1].expr - rest
    assert_allclose(moved[-1].expr - moved[0].expr, change, atol=1e-12)


def test_a_resting_face_that_is_not_zero():
    """Catches a calibrated performance that no longer closes the eyes, or starts with a smile."""
    weights = np.zeros((50, 52))
    weights[:, 3] = 0.2
    weights[10:15, 3] = 1.0
    take = Performance(np.arange(50) / 30, weights, None, 30.0)
    rest = quiet_weights(take)
    assert rest[3] == 0.2
    changed = relative_to(take, Performance(np.zeros(1), rest[None], None, 30.0)).weights[:, 3]
    assert_allclose(changed[:10], 0)
    assert_allclose(changed[10:15], 1)


def test_led_back_to_what_was_trained():
    """Catches a motion changed where it was trained, led beyond the range, or cut off."""
    trained = trained_range(talking(np.zeros(4), 200))
    inside = talking(np.zeros(4))
    for before, after in zip(inside, led_back(inside, trained), strict=True):
        assert_allclose(after.expr, before.expr, atol=0.05)
    wild = [replace(FRAME, expr=np.array([scale, 0, 0, 0])) for scale in (0.0, 4.0, 8.0, 100.0)]
    assert outside(wild, trained)["face"][0] == 0
    assert_allclose(outside(wild, trained)["face"][2], 3.0, rtol=0.05)
    assert not outside(wild, trained)["jaw"].any()
    led = [frame.expr[0] for frame in led_back(wild, trained)]
    assert led == sorted(led)
    assert 2.0 < led[1] < led[2] < led[3] <= 2.0 * 1.25 + 0.01
    half = led_back(wild, trained, 0.5)[2].expr[0]
    assert half == (8.0 + led[2]) / 2
    assert_array_equal(led_back(wild, trained, 0.0)[3].expr, wild[3].expr)
