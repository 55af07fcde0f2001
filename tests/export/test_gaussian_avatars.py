"""The GaussianAvatars pair: its exact layout, the change of convention, and the way back."""

from dataclasses import replace

import numpy as np
import pytest
from avatar.conftest import random_mesh, random_splats
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from refusal import refusal
from scipy.spatial.transform import Rotation

from stga_addon.avatar.embedding import face_frames, to_world
from stga_addon.avatar.file import Avatar
from stga_addon.avatar.offsets import OFFSETS
from stga_addon.avatar.strain import trained_range
from stga_addon.export.ply import (
    in_convention,
    read_ply,
    read_vertices,
    splats_of,
    write_gaussian_avatars,
)
from stga_addon.flame.forward import FlameFrame
from stga_addon.flame.model import FlameModel
from stga_addon.flame.sequence import FlameSequence, neutral_mesh, read_motion, sequence_mesh

VERTICES = 20
IDENTITY = 6
EXPRESSION = 4
PROPERTIES = [
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{i}" for i in range(45)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "binding_0"),
]
PLY_HEADER = b"ply\nformat binary_little_endian 1.0\nelement vertex 50\n"
PLY_HEADER += "".join(f"property float {name}\n" for name in PROPERTIES).encode() + b"end_header\n"


@pytest.fixture
def sequence():
    """A moving model of twenty vertices; a gap in its timesteps, one dynamic offset."""
    rng = np.random.default_rng(5)
    template, faces = random_mesh(5, VERTICES)
    model = FlameModel(
        v_template=template,
        shapedirs=rng.normal(size=(VERTICES, 3, IDENTITY + EXPRESSION)) * 0.01,
        n_identity=IDENTITY,
        posedirs=rng.normal(size=(VERTICES, 3, 36)) * 0.001,
        j_regressor=np.full((5, VERTICES), 1 / VERTICES),
        parents=np.array([-1, 0, 1, 1, 1]),
        weights=rng.dirichlet(np.ones(5), VERTICES),
        faces=faces,
    )

    def float32(*shape):
        return rng.normal(size=shape).astype(np.float32).astype(np.float64) * 0.25

    sizes = (EXPRESSION, 3, 3, 3, 3, 6)
    frames = {timestep: FlameFrame(*map(float32, sizes)) for timestep in (0, 2, 5)}
    frames[2] = replace(frames[2], dynamic_offset=float32(VERTICES, 3))
    offset = float32(VERTICES, 3)
    return FlameSequence(model, float32(IDENTITY), offset, (0, 2, 5), frames.__getitem__)


def avatar_on(sequence, convention):
    neutral = neutral_mesh(sequence).astype(np.float32)
    faces = sequence.model.faces
    splats = random_splats(6, 50, len(faces), sh_degree=3)
    return Avatar(replace(splats, unbound=np.zeros(50, bool)), convention, neutral, faces)


def test_motion_holds_every_array_the_viewer_asks_for(tmp_path, sequence):
    """Catches a missing dynamic offset, float64, timesteps out of order, or None turned into an
    object array."""
    write_gaussian_avatars(tmp_path, avatar_on(sequence, "stga"), sequence)
    with np.load(tmp_path / "flame_param.npz", allow_pickle=False) as data:
        arrays = dict(data)
    assert {name: array.shape for name, array in arrays.items()} == {
        "shape": (IDENTITY,),
        "expr": (3, EXPRESSION),
        **dict.fromkeys(("rotation", "neck_pose", "jaw_pose", "translation"), (3, 3)),
        "eyes_pose": (3, 6),
        "static_offset": (VERTICES, 3),
        "dynamic_offset": (3, VERTICES, 3),
    }
    assert {array.dtype for array in arrays.values()} == {np.dtype("float32")}
    assert_array_equal(arrays["jaw_pose"][2], sequence.frame(5).jaw_pose)
    assert_array_equal(arrays["dynamic_offset"][1], sequence.frame(2).dynamic_offset)
    assert not arrays["dynamic_offset"][[0, 2]].any()
    bare = replace(sequence, static_offset=None)
    write_gaussian_avatars(tmp_path, avatar_on(bare, "stga"), bare)
    with np.load(tmp_path / "flame_param.npz", allow_pickle=False) as data:
        assert_array_equal(data["static_offset"], np.zeros((VERTICES, 3)))


def bound_splats(path):
    """Splats in the "gaussian_avatars" convention, with triangles by binding_0."""
    vertices = read_vertices(path)
    splats = splats_of(path, vertices, print)
    return replace(splats, face=vertices["binding_0"].astype(np.int32))


def test_pair_reads_back_to_the_same_moving_splats(tmp_path, sequence):
    """Catches a motion or binding changed on the way: world splats are the same; an extra or
    misplaced property: the viewer counts them by prefix; and splats bound to triangles that the
    motion does not have."""
    avatar = avatar_on(sequence, "gaussian_avatars")
    other = replace(avatar, faces=avatar.faces[::-1].copy())
    with refusal("triangles"):
        write_gaussian_avatars(tmp_path / "out", other, sequence)
    assert not (tmp_path / "out").exists()
    write_gaussian_avatars(tmp_path, avatar, sequence)
    content = (tmp_path / "point_cloud.ply").read_bytes()
    assert content.startswith(PLY_HEADER)
    rows = np.frombuffer(content[len(PLY_HEADER) :], "<f4").reshape(50, 63)
    assert_array_equal(rows[:, 9 + 15 + 2], avatar.splats.sh[:, 3, 1])
    splats = bound_splats(tmp_path / "point_cloud.ply")
    motion = read_motion(tmp_path / "flame_param.npz", sequence.model)
    for name in ("xyz", "rotation", "log_scale", "opacity", "sh", "face", "unbound"):
        found = getattr(splats, name)
        expected = getattr(avatar.splats, name)
        assert_array_equal(found, expected, err_msg=name)
        assert found.dtype == expected.dtype
    for mine, timestep in zip(motion.timesteps, sequence.timesteps, strict=True):
        expected = sequence_mesh(sequence, timestep)
        assert_allclose(sequence_mesh(motion, mine), expected, atol=1e-12)
    with refusal("binding_0: these splats lie in the frames"):
        read_ply(tmp_path / "point_cloud.ply")  # whose picture would be splats of meters


def viewer_world(row, corners):
    """Position (3,) and covariance (3, 3) of one splat on its triangle, by definition."""
    p, q, r = corners
    first = (q - p) / norm(q - p)
    normal = np.cross(q - p, r - p)
    normal = normal / norm(normal)
    third = np.cross(first, normal)
    size = (norm(q - p) + abs(third @ (r - p))) / 2
    turn = np.column_stack([first, normal, third])
    own = Rotation.from_quat(row.rotation[0].astype(np.float64), scalar_first=True).as_matrix()
    axes = size * turn @ own * np.exp(row.log_scale[0].astype(np.float64))
    return turn @ row.xyz[0].astype(np.float64) * size + (p + q + r) / 3, axes @ axes.T


@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
def test_colors_are_those_of_the_neutral_mesh(tmp_path, sequence, convention):
    """Catches driven colors in a pair, by a least compression that is not 0."""
    avatar = avatar_on(sequence, convention)
    rng = np.random.default_rng(1)
    shape = len(avatar.faces), 3, 3
    driven = {name: rng.normal(0, 0.2, shape).astype(np.float32) for name in OFFSETS}
    limits = trained_range(len(avatar.faces))
    avatar = replace(avatar, driven_offsets=driven, strain_range=limits)
    assert np.abs(avatar.frames(avatar.neutral).color).max() < 1e-5
    write_gaussian_avatars(tmp_path, avatar, sequence)
    written = bound_splats(tmp_path / "point_cloud.ply").sh
    assert_array_equal(written, avatar.splats.sh)


def test_avatar_of_the_other_convention_stands_where_it_stood(tmp_path, sequence):
    """Catches a conversion only nearly right, by the viewer's own arithmetic."""
    avatar = avatar_on(sequence, "stga")
    write_gaussian_avatars(tmp_path, avatar, sequence)
    splats = bound_splats(tmp_path / "point_cloud.ply")
    neutral = avatar.neutral.astype(np.float64)
    world = to_world(avatar.splats, face_frames(neutral, avatar.faces, neutral, "stga"))
    assert_array_equal(splats.face, avatar.splats.face)
    assert_array_equal(splats.sh, avatar.splats.sh)
    turns = Rotation.from_quat(world.rotation, scalar_first=True).as_matrix()
    axes = turns * np.exp(world.log_scale)[:, None]
    for i, face in enumerate(splats.face):
        position, covariance = viewer_world(splats.rows([i]), neutral[avatar.faces[face]])
        expected = axes[i] @ axes[i].T
        assert_allclose(position, world.xyz[i], atol=2e-6)
        assert_allclose(covariance, expected, atol=5e-6 * np.abs(covariance).max())


def test_conversion_there_and_back_keeps_precision_far_from_the_origin(sequence):
    """Catches a detour through world coordinates, which costs digits far away."""
    avatar = avatar_on(sequence, "stga")
    far = replace(avatar, neutral=avatar.neutral + np.float32(64))
    splats = in_convention(far, "gaussian_avatars")
    there = replace(far, splats=splats, convention="gaussian_avatars")
    back = in_convention(there, "stga")
    assert_allclose(back.xyz, avatar.splats.xyz, rtol=1e-5, atol=1e-6)
    assert_allclose(back.log_scale, avatar.splats.log_scale, atol=1e-5)
    assert in_convention(far, "stga") is far.splats
