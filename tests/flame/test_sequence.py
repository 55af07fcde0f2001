"""Parameter files and the meshes they stand for."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from refusal import refusal
from scipy.spatial.transform import Rotation

from stga_addon import files
from stga_addon.flame import sequence
from stga_addon.flame.forward import (
    change_between,
    changed_by,
    flame_forward,
    neutral_frame,
    parameters_at,
)
from stga_addon.flame.sequence import (
    FRAME_FIELDS,
    PARTS,
    FlameSequence,
    expression_mesh,
    neutral_mesh,
    read_frame,
    read_identity,
    read_motion,
    retimed,
    sequence_mesh,
    strengthened,
    transferred_motion,
)

from .conftest import random_frame


def _arrays(seed, model):
    """A timestep as VHAP writes it: float32 with a leading 1."""
    frame = random_frame(seed, model.n_expression)
    rng = default_rng(seed)
    fields = {name: getattr(frame, name)[None] for name in FRAME_FIELDS}
    fields["shape"] = rng.normal(size=model.n_identity)
    fields["static_offset"] = rng.normal(0, 0.01, (1, len(model.v_template), 3))
    return {name: value.astype(np.float32) for name, value in fields.items()}


def _write(path, arrays):
    np.savez(path, **arrays)
    return path


def test_a_frame_as_written(tmp_path, tiny_flame):
    """Catches a field read into another's place, a lost leading axis, and a loader that insists on
    what real exports leave out."""
    arrays = _arrays(1, tiny_flame)
    path = _write(tmp_path / "00003.npz", arrays)
    frame = read_frame(path, tiny_flame)
    for name in FRAME_FIELDS:
        assert_array_equal(getattr(frame, name), arrays[name][0])
    assert_array_equal(frame.pose[3], arrays["eyes_pose"][0, :3])
    shape, offset = read_identity(path, tiny_flame)
    assert_array_equal(shape, arrays["shape"])
    assert offset is not None
    assert_array_equal(offset, arrays["static_offset"][0])
    assert frame.dynamic_offset is None
    sparse = {name: arrays[name] for name in ("rotation", "translation")}
    short = {"expr": arrays["expr"][0, :2], "shape": arrays["shape"][:3]}
    path = _write(tmp_path / "a.npz", {**sparse, **short})
    frame = read_frame(path, tiny_flame)
    assert_array_equal(frame.expr, [*arrays["expr"][0, :2], 0, 0])
    assert not frame.jaw_pose.any()
    assert not frame.eyes_pose.any()
    shape, offset = read_identity(path, tiny_flame)
    assert_array_equal(shape, [*arrays["shape"][:3], 0, 0, 0, 0, 0])
    assert offset is None


@pytest.mark.parametrize("rows", [160, 280])
def test_offsets_without_and_with_teeth(tmp_path, tiny_flame, rows):
    """Catches offsets of a mesh with 120 teeth vertices more or fewer being refused or shifted."""
    model = replace(tiny_flame, v_template=np.zeros((280 if rows == 160 else 160, 3)))
    given = default_rng(3).normal(size=(1, rows, 3))
    path = _write(tmp_path / "a.npz", {"shape": np.zeros(8), "static_offset": given})
    _, offset = read_identity(path, model)
    assert_array_equal(offset[:160], given[0, :160])
    assert not offset[160:].any()


def test_meshes_of_a_sequence(tiny_flame):
    """Catches which parameters count as head motion and which as expression."""
    rng = default_rng(6)
    shape = rng.normal(size=8)
    offset = rng.normal(0, 0.01, (40, 3))
    sequence = replace(_motion(tiny_flame), shape=shape, static_offset=offset)
    frame = sequence.frame(7)
    zero = np.zeros(3)

    def mesh(**changed):
        new = replace(frame, **changed)
        return flame_forward(tiny_flame, sequence.shape, new, sequence.static_offset)

    still = {"rotation": zero, "translation": zero, "neck_pose": zero}
    assert_array_equal(sequence_mesh(sequence, 7), mesh())
    assert_array_equal(expression_mesh(sequence, 7, "head"), mesh(**still))
    calm = {**still, "jaw_pose": zero, "eyes_pose": np.zeros(6)}
    assert_array_equal(expression_mesh(sequence, 7, "all"), mesh(**calm))
    assert_array_equal(neutral_mesh(sequence), mesh(**calm, expr=np.zeros(4)))
    rest = tiny_flame.shapedirs[:, :, :8] @ sequence.shape + sequence.static_offset
    assert_allclose(neutral_mesh(sequence) - tiny_flame.v_template, rest, atol=1e-14)
    with refusal("zero_pose"):
        expression_mesh(sequence, 7, "neck")


def test_a_motion_is_its_frames(tmp_path, tiny_flame):
    """Catches frames of a motion read from the wrong row, for VHAP's (shape (I,)) and
    GaussianAvatars' files alike."""
    frames = [_arrays(seed, tiny_flame) for seed in (10, 11, 12)]
    moving = {name: np.concatenate([own[name] for own in frames]) for name in FRAME_FIELDS}
    shape = frames[0]["shape"]
    offset = frames[0]["static_offset"]
    dynamic = np.zeros((3, 40, 3))
    dynamic[2] = 0.01
    moving |= {"shape": shape, "static_offset": offset[0], "dynamic_offset": dynamic}
    motion = read_motion(_write(tmp_path / "flame_param.npz", moving), tiny_flame)
    assert motion.timesteps == (0, 1, 2)
    for timestep, arrays in enumerate(frames):
        single = read_frame(_write(tmp_path / f"{timestep}.npz", {**arrays}), tiny_flame)
        single = replace(single, dynamic_offset=dynamic[timestep])
        expected = flame_forward(tiny_flame, shape, single, offset[0])
        assert_allclose(sequence_mesh(motion, timestep), expected, atol=1e-7)
    path = _write(tmp_path / "named.npz", {**moving, "timesteps": np.array([2, 3, 7])})
    named = read_motion(path, tiny_flame)
    assert named.timesteps == (2, 3, 7)
    assert_array_equal(sequence_mesh(named, 7), sequence_mesh(motion, 2))


@pytest.mark.parametrize(
    ("name", "vertices", "most"),
    [
        ("dynamic_offset", 40, 1 << 28),
        ("dynamic_offset", 40, 1),
        ("dynamic_offset", 400, 1),
        ("unused", 40, 1),
    ],
)
def test_offsets_that_pack_to_nothing(tmp_path, tiny_flame, monkeypatch, name, vertices, most):
    """Catches a long motion without offsets refused for how small its file is, and other arrays of
    a small file unpacked because of it."""
    monkeypatch.setattr(files, "MIN_ARRAYS_BYTES", 1 << 18)
    monkeypatch.setattr(sequence, "MAX_OFFSET_BYTES", most)
    path = tmp_path / "long.npz"
    np.savez_compressed(path, expr=np.zeros((4000, 2)), **{name: np.zeros((4000, vertices, 3))})
    if name == "dynamic_offset" and vertices == len(tiny_flame.v_template):
        assert len(read_motion(path, tiny_flame).timesteps) == 4000
        return
    with refusal("long.npz: unpacks to"):
        read_motion(path, tiny_flame)


def test_plain_expression_and_pose_files(tmp_path, tiny_flame):
    """Catches another tracker's names or packing read into the wrong joint, and an identity that is
    insisted on."""
    rng = default_rng(20)
    expr = rng.normal(size=(3, 4))
    pose = rng.normal(0, 0.4, (3, 15))
    path = _write(tmp_path / "a.npz", {"exp": expr[:, :2], "pose": pose[:, :6]})
    short = read_motion(path, tiny_flame)
    frame = short.frame(1)
    assert_array_equal(frame.expr, [*expr[1, :2], 0, 0])
    assert_array_equal(frame.rotation, pose[1, :3])
    assert_array_equal(frame.jaw_pose, pose[1, 3:6])
    others = [frame.neck_pose, frame.eyes_pose, frame.translation, short.shape]
    assert not np.concatenate(others).any()
    path = _write(tmp_path / "b.npz", {"pose": pose, "betas": np.ones((3, 8))})
    joints = read_motion(path, tiny_flame)
    assert_array_equal(joints.frame(2).pose, pose[2].reshape(5, 3))
    assert_array_equal(joints.shape, np.ones(8))
    assert not joints.frame(2).expr.any()
    # an avatar or a model file is no head that never moves
    with refusal(r"other\.npz: has none of expr, rotation"):
        read_motion(_write(tmp_path / "other.npz", {"xyz": np.zeros((4, 3))}), tiny_flame)


def test_a_face_of_a_body(tmp_path, tiny_flame):
    """Catches a body's joints taken for the head's: BEAT2's files, as its trainers write them, hold
    SMPL-X's 55 joints, among them the head (15), the jaw (22) and the eyes."""
    body = default_rng(21).normal(0, 0.2, (3, 165))
    arrays = {
        "betas": np.zeros(8),
        "poses": body,
        "expressions": np.ones((3, 4)),
        "trans": np.ones((3, 3)),
        "model": np.array("smplx2020"),
        "gender": np.array("neutral"),
        "mocap_frame_rate": np.array(30),
    }
    motion = read_motion(_write(tmp_path / "beat.npz", arrays), tiny_flame)
    frame = motion.frame(1)
    joints = body[1].reshape(55, 3)
    assert_array_equal(frame.neck_pose, joints[15])
    assert_array_equal(frame.jaw_pose, joints[22])
    assert_array_equal(frame.eyes_pose, joints[23:25].ravel())
    assert_array_equal(frame.expr, np.ones(4))
    assert not frame.rotation.any()
    assert any("SMPL-X" in text for text in motion.warnings)


def _matrices(vectors):
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()


def _between(first, second, share):
    start, end = (Rotation.from_rotvec(vectors.reshape(-1, 3)) for vectors in (first, second))
    return (start * (start.inv() * end) ** share).as_matrix()


def _motion(model, timesteps=(2, 3, 7)):
    frames = {timestep: random_frame(timestep, 4) for timestep in timesteps}
    return FlameSequence(model, np.zeros(8), None, timesteps, frames.__getitem__)


def _assert_same(frame, other):
    for name in ("expr", "translation"):
        assert_allclose(getattr(frame, name), getattr(other, name), atol=1e-12)
    for name in ("rotation", "neck_pose", "jaw_pose", "eyes_pose"):
        both = (_matrices(getattr(own, name)) for own in (frame, other))
        assert_allclose(*both, atol=1e-12)


def test_parameters_between_timesteps_against_scipy():
    """Catches another order, sign or half angle of quaternions, 0/0, the long way round, and
    rotations near half a turn, whose axis-angles are opposites: as of heads that face -z, or of a
    world whose y points down."""
    rng = default_rng(1)
    values = rng.normal(0, 1.5, (2, 40, 4 + 18))
    values[1, 1, 4:-3] = values[0, 1, 4:-3] = 0
    half = np.array([np.pi, 0, 0]), np.array([0, np.pi, 0])
    for row, turn in enumerate(half, start=2):
        near = [turn * (1 - 0.02), -turn * (1 - 0.03) + [0, 0, 0.02]]
        values[:, row, 4:-3] = np.tile(near, (1, 5))
    for share in (0.0, 0.3, 1.0):
        for first, second in values.swapaxes(0, 1):
            both = np.stack([first, second])
            found = parameters_at(np.array([2 + 4 * share]), np.array([2, 6]), both)
            expected = _between(first[4:-3], second[4:-3], share)
            assert_allclose(_matrices(found[0, 4:-3]), expected, atol=1e-12)
            rest = np.r_[:4, -3:0]
            mixed = (1 - share) * first[rest] + share * second[rest]
            assert_allclose(found[0, rest], mixed, atol=1e-12)
    start, end = values
    again = changed_by(start, change_between(start, end))
    for own in (start, end, again):
        own[:, 4:-3] = Rotation.from_rotvec(own[:, 4:-3].reshape(-1, 3)).as_rotvec().reshape(40, 15)
    assert_allclose(again, end, atol=1e-9)
    assert_array_equal(changed_by(start, change_between(start, start)), start)


def test_the_same_speed_gives_the_frames_and_what_lies_between(tiny_flame):
    """Catches frames shifted by gaps in the timesteps, keyframes that are resampled although
    nothing asked for it, and a last frame lost to rounding (0.1 is not a tenth)."""
    motion = _motion(tiny_flame)
    frames = retimed(motion)
    assert len(frames) == 6  # timesteps 2 to 7
    for index, timestep in ((0, 2), (1, 3), (5, 7)):
        _assert_same(frames[index], motion.frame(timestep))
    start = motion.frame(3)
    end = motion.frame(7)
    between = frames[2]
    assert_allclose(between.expr, 0.75 * start.expr + 0.25 * end.expr, atol=1e-12)
    (alone,) = retimed(_motion(tiny_flame, (5,)), 0.5)
    _assert_same(alone, random_frame(5, 4))
    for step, count in ((0.5, 11), (2.0, 3), (2.5, 3), (0.1, 51), (60 / 24, 3)):
        assert len(retimed(motion, step)) == count
        if 5 % step < 1e-9:
            _assert_same(retimed(motion, step)[-1], motion.frame(7))


def test_strength(tiny_flame):
    """Catches a head that drifts to the origin, or faces elsewhere, when only its movement should
    shrink, and a field of a frame that no part of a motion switches."""
    assert {name for fields in PARTS.values() for name in fields} == set(FRAME_FIELDS)
    frames = retimed(_motion(tiny_flame))
    for whole, same in zip(frames, strengthened(frames, 1.0), strict=True):
        _assert_same(whole, same)
    still = strengthened(frames, 0.0)[3]
    calm = {"expr": np.zeros(4), "neck_pose": np.zeros(3), "jaw_pose": np.zeros(3)}
    _assert_same(still, replace(frames[0], **calm, eyes_pose=np.zeros(6)))
    half = strengthened(frames, 0.5)[3]
    assert_allclose(half.expr, frames[3].expr / 2)
    assert_allclose(half.jaw_pose, frames[3].jaw_pose / 2, atol=1e-12)
    middle = (frames[0].translation + frames[3].translation) / 2
    assert_allclose(half.translation, middle)
    middle = _between(frames[0].rotation, frames[3].rotation, 0.5)
    assert_allclose(_matrices(half.rotation), middle, atol=1e-12)


def test_driven_by_the_neutral_mesh_alone(tiny_flame):
    """Catches joints of the mean face, and the other person's identity or offsets on this one."""
    rng = default_rng(3)
    ones = np.ones((40, 3))
    shape = rng.normal(size=8)
    offset = rng.normal(0, 0.01, (40, 3))
    motion = replace(_motion(tiny_flame), shape=rng.normal(size=8), static_offset=ones)
    motion = replace(motion, frame=lambda t: replace(random_frame(t, 4), dynamic_offset=ones))
    neutral = flame_forward(tiny_flame, shape, neutral_frame(tiny_flame), offset)
    expected = flame_forward(tiny_flame, shape, random_frame(7, 4), offset)
    found = sequence_mesh(transferred_motion(motion, neutral), 7)
    assert_allclose(found, expected, atol=1e-12)


JOINTS_OF = ("rotation", "neck_pose", "jaw_pose", "eyes_pose")


def _as_metrical_tracker_writes(frames):
    """Arrays by its names: two rows of the jaw's and eyes' matrices, R and t of the head."""

    def matrices(name):
        vectors = np.stack([getattr(frame, name) for frame in frames])
        turns = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
        return turns.reshape(len(frames), -1, 3, 3)

    two_rows = {name: matrices(name)[:, :, :2].reshape(len(frames), -1) for name in JOINTS_OF}
    return {
        "exp": np.stack([frame.expr for frame in frames]),
        "shape": np.zeros((len(frames), 4)),
        "eyes": 1.5 * two_rows["eyes_pose"],  # networks give them without their length
        "neck": matrices("neck_pose")[:, 0],
        "jaw": two_rows["jaw_pose"],
        "R": matrices("rotation")[:, 0],
        "t": np.stack([frame.translation for frame in frames]),
        "eyelids": np.ones((len(frames), 2)),
    }


def test_rotations_by_matrices_and_their_rows(tmp_path, tiny_flame):
    """Catches a motion refused for how its rotations are written, one that is read transposed, and
    a guess that nobody hears of."""
    frames = [random_frame(seed, tiny_flame.n_expression) for seed in range(4)]
    arrays = _as_metrical_tracker_writes(frames)
    path = _write(tmp_path / "metrical.npz", arrays)
    motion = read_motion(path, tiny_flame)
    for timestep, frame in enumerate(frames):
        found = motion.frame(timestep)
        assert_allclose(found.parameters, frame.parameters, atol=1e-6)
    told = [text.removeprefix(f"{path}: ") for text in motion.warnings]
    begin = ["eyes, jaw: rotations of six", "R and t are read as", "eyelids is not read"]
    assert [text[: len(own)] for text, own in zip(told, begin, strict=True)] == begin
    first = {name: own[0] for name, own in arrays.items()}
    single = {"expr": first["exp"], "rotation": first["R"], "translation": first["t"]}
    single |= {"neck_pose": first["neck"][None], "jaw_pose": first["jaw"][None]}
    single |= {"eyes_pose": first["eyes"]}
    found = read_frame(_write(tmp_path / "00000.npz", single), tiny_flame)
    assert_allclose(found.parameters, frames[0].parameters, atol=1e-6)


@pytest.mark.parametrize("value", [2 * np.eye(3), np.diag([1, 1, -1]), np.zeros((3, 3))])
def test_matrices_that_are_no_rotations(tmp_path, tiny_flame, value):
    """Catches a scaled or mirrored matrix taken for a rotation."""
    arrays = {"expr": np.zeros((2, 3)), "rotation": np.stack([np.eye(3), value])}
    with refusal(r"rotation has shape .*, but holds no rotations"):
        read_motion(_write(tmp_path / "a.npz", arrays), tiny_flame)
