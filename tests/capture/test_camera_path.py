"""Camera paths, compared with cameras that `look_at` places."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from stga_addon.capture.camera import (
    UP,
    central_camera,
    covered_angles,
    look_at,
    orbited,
    to_and_fro,
    turntable,
)

CENTER = np.array([0.1, 0.2, -0.3])


def camera(degrees, height=0.1):
    """At one meter from the axis through the center, counterclockwise from +z seen from above."""
    angle = np.radians(degrees)
    eye = CENTER + np.array([np.sin(angle), height, np.cos(angle)])
    return look_at(tuple(eye), tuple(CENTER), 64, 48, 80.0)


def assert_same_pose(one, other):
    assert_allclose(one.world_to_camera, other.world_to_camera, atol=1e-12)


def test_orbit():
    """Catches another direction or center, a turn that repeats a view, and limits left."""
    for degrees in (0, 30, -100, 180):
        assert_same_pose(orbited(camera(20), CENTER, UP, np.radians(degrees)), camera(20 + degrees))
    full = turntable(camera(10), CENTER, 8, (-np.pi, np.pi))
    for index, each in enumerate(full):
        assert_same_pose(each, camera(10 + 45 * index))
    partial = turntable(camera(10), CENTER, 200, (np.radians(-30), np.radians(60)))
    x, _, z = (np.array([each.position for each in partial]) - CENTER).T
    degrees = np.degrees(np.arctan2(x, z)) - 10
    assert (degrees.min(), degrees.max()) == pytest.approx((-30, 60), abs=0.1)
    assert np.abs(np.diff(np.append(degrees, degrees[0]))).max() < 2


@pytest.mark.parametrize(
    ("angles", "start", "expected"),
    [
        ((-70, -30, 0, 40, 80), 0, (-70, 80)),
        ((-70, -30, 0, 40, 80), -70, (0, 150)),
        ((110, 150, 180, 220, 250), 180, (-70, 70)),
        ((0, 90, 180, 270), 0, (-180, 180)),
        ((30,), 30, (0, 0)),
    ],
)
def test_covered_angles(angles, start, expected):
    """Catches a turntable that shows a side which no camera saw, or leaves out one that they
    did."""
    covered = covered_angles([camera(angle) for angle in angles], camera(start), CENTER)
    assert_allclose(np.degrees(covered), expected, atol=1e-9)


def test_central_camera():
    """Catches a choice by order, or by position in a capture that is off center."""
    assert central_camera([camera(angle) for angle in (80, -70, 5, 40, -30)]) == 2


def test_to_and_fro():
    """Catches a jump from the last timestep to the first, and a timestep shown twice at the turning
    points."""
    assert to_and_fro((3, 5, 8), 9) == [3, 5, 8, 5, 3, 5, 8, 5, 3]
    assert to_and_fro((4,), 3) == [4, 4, 4]
