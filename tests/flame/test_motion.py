"""Motions at another speed and strength, against rotations by scipy."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from stga_addon.flame.forward import FlameFrame, flame_forward, neutral_frame
from stga_addon.flame.model import FlameModel
from stga_addon.flame.quaternions import continuous, from_axis_angle, slerp, to_axis_angle
from stga_addon.flame.sequence import (
    PARTS,
    ROTATIONS,
    FlameSequence,
    retimed,
    sequence_mesh,
    strengthened,
    transferred_motion,
)

from .conftest import random_frame


def _matrices(vectors: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()


def _motion(model: FlameModel, timesteps: tuple[int, ...] = (2, 3, 7)) -> FlameSequence:
    frames = {timestep: random_frame(timestep, 4) for timestep in timesteps}
    return FlameSequence(model, np.zeros(8), None, timesteps, frames.__getitem__)


def _assert_same(frame: FlameFrame, other: FlameFrame) -> None:
    for name in ("expr", "translation"):
        np.testing.assert_allclose(getattr(frame, name), getattr(other, name), atol=1e-12)
    for name in ROTATIONS:
        np.testing.assert_allclose(_matrices(getattr(frame, name)), _matrices(getattr(other, name)), atol=1e-12)


def test_quaternions_against_scipy() -> None:
    # Catches a wrong order, sign or half angle, and division by zero at small angles.
    rng = np.random.default_rng(0)
    vectors = np.concatenate([rng.normal(0, 1.2, (50, 3)), rng.normal(0, 1e-9, (5, 3)), np.zeros((1, 3))])
    made = from_axis_angle(vectors)
    expected = Rotation.from_rotvec(vectors).as_quat()[:, [3, 0, 1, 2]]
    np.testing.assert_allclose(np.abs((made * expected).sum(1)), 1, atol=1e-14)
    np.testing.assert_allclose(_matrices(to_axis_angle(made)), _matrices(vectors), atol=1e-14)
    np.testing.assert_allclose(_matrices(to_axis_angle(-made)), _matrices(vectors), atol=1e-14)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_slerp_against_scipy(share: float) -> None:
    # Catches interpolation the long way round, at uneven speed, or that is undefined between equal rotations.
    rng = np.random.default_rng(1)
    for a, b in [*rng.normal(0, 1.5, (30, 2, 3)), np.zeros((2, 3)), np.full((2, 3), 0.4)]:
        made = slerp(from_axis_angle(a), -from_axis_angle(b), np.array(share))
        expected = Slerp([0, 1], Rotation.from_rotvec([a, b]))(share).as_matrix()
        np.testing.assert_allclose(_matrices(to_axis_angle(made))[0], expected, atol=1e-12)


def test_continuous_changes_signs_only() -> None:
    # Catches a step that runs through zero when its ends are interpolated one number at a time.
    turning = from_axis_angle(np.outer((0.6 * np.arange(20) + np.pi) % (2 * np.pi) - np.pi, [0, 1, 0]))
    made = continuous(turning)
    np.testing.assert_array_equal(np.abs(made), np.abs(turning))
    assert ((made[1:] * made[:-1]).sum(1) > 0).all()


def test_the_same_speed_gives_the_frames_and_what_lies_between(tiny_flame: FlameModel) -> None:
    # Catches frames shifted by gaps in the timesteps, and keyframes that are resampled although nothing asked for it.
    motion = _motion(tiny_flame)
    frames = retimed(motion)
    assert len(frames) == 6  # timesteps 2 to 7
    for index, timestep in ((0, 2), (1, 3), (5, 7)):
        _assert_same(frames[index], motion.frame(timestep))
    start, end, between = motion.frame(3), motion.frame(7), frames[2]
    np.testing.assert_allclose(between.expr, 0.75 * start.expr + 0.25 * end.expr, atol=1e-12)
    expected = Slerp([3, 7], Rotation.from_rotvec([start.jaw_pose, end.jaw_pose]))(4).as_matrix()
    np.testing.assert_allclose(_matrices(between.jaw_pose)[0], expected, atol=1e-12)
    right = Slerp([3, 7], Rotation.from_rotvec([start.eyes_pose[3:], end.eyes_pose[3:]]))(4).as_matrix()
    np.testing.assert_allclose(_matrices(between.eyes_pose)[1], right, atol=1e-12)


@pytest.mark.parametrize(("step", "count"), [(0.5, 11), (2.0, 3), (2.5, 3), (0.1, 51), (60 / 24, 3)])
def test_speeds(tiny_flame: FlameModel, step: float, count: int) -> None:
    # Catches a last frame lost to rounding (0.1 is not a tenth), and steps counted in frames of the wrong side.
    motion = _motion(tiny_flame)
    frames = retimed(motion, step)
    assert len(frames) == count
    if 5 % step < 1e-9:
        _assert_same(frames[-1], motion.frame(7))


def test_one_timestep_is_one_frame(tiny_flame: FlameModel) -> None:
    # Catches an index beyond the only frame.
    motion = _motion(tiny_flame, (5,))
    (frame,) = retimed(motion, 0.5)
    _assert_same(frame, motion.frame(5))


def test_strength(tiny_flame: FlameModel) -> None:
    # Catches a head that drifts to the origin, or faces elsewhere, when only its movement should shrink.
    frames = retimed(_motion(tiny_flame))
    for whole, same in zip(frames, strengthened(frames, 1.0), strict=True):
        _assert_same(whole, same)
    still = strengthened(frames, 0.0)[3]
    zero: dict[str, Any] = {name: np.zeros_like(getattr(still, name)) for name in ("expr", *ROTATIONS[1:])}
    _assert_same(still, replace(frames[0], **zero))
    half = strengthened(frames, 0.5)[3]
    np.testing.assert_allclose(half.expr, frames[3].expr / 2)
    np.testing.assert_allclose(half.jaw_pose, frames[3].jaw_pose / 2, atol=1e-12)
    np.testing.assert_allclose(half.translation, (frames[0].translation + frames[3].translation) / 2)
    middle = Slerp([0, 1], Rotation.from_rotvec([frames[0].rotation, frames[3].rotation]))(0.5).as_matrix()
    np.testing.assert_allclose(_matrices(half.rotation)[0], middle, atol=1e-12)


def test_driven_by_the_neutral_mesh_alone(tiny_flame: FlameModel) -> None:
    # Catches joints of the mean face, and the other person's identity or offsets on this one.
    rng = np.random.default_rng(3)
    shape, offset = rng.normal(size=8), rng.normal(0, 0.01, (40, 3))
    motion = replace(_motion(tiny_flame), shape=rng.normal(size=8), static_offset=np.ones((40, 3)))
    motion = replace(motion, frame=lambda t: replace(random_frame(t, 4), dynamic_offset=np.ones((40, 3))))
    neutral = flame_forward(tiny_flame, shape, neutral_frame(tiny_flame), offset)
    expected = flame_forward(tiny_flame, shape, random_frame(7, 4), offset)
    np.testing.assert_allclose(sequence_mesh(transferred_motion(motion, neutral), 7), expected, atol=1e-12)


def test_parts_are_all_the_fields() -> None:
    # Catches a field of a frame that no part switches.
    assert {name for fields in PARTS.values() for name in fields} == {"expr", "translation", *ROTATIONS}
