"""Deformation of a triangle against what the deformation gradient and the normals say, and colors
and positions that follow it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal, assert_equal
from scipy.spatial.transform import Rotation

from stga_addon.avatar.embedding import face_frames, to_world
from stga_addon.avatar.file import (
    MIN_COLOR_CHANGE,
    MIN_SCALE_CHANGE,
    MIN_SHIFT_M,
    Avatar,
    read_avatar,
    write_avatar,
)
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.avatar.offsets import OFFSETS
from stga_addon.avatar.strain import (
    AVERAGING_ROUNDS,
    MAX_STRAIN,
    MIN_COMPRESSION,
    RANGE_MARGIN,
    deformation,
    edge_neighbors,
    observed_range,
    smoothed_strain,
    strain_basis,
    trained_range,
)
from stga_addon.capture.camera import Camera
from stga_addon.render.render import render, render_avatar

FACES = np.array([[0, 1, 2], [2, 1, 3], [2, 3, 4], [0, 2, 4]], np.int32)


def sheet(seed=0):
    """Five vertices of four triangles in space, edges of a centimeter."""
    flat = np.array([[0, 0, 0], [1, 0.1, 0], [0.4, 1, 0], [1.3, 1.2, 0], [-0.2, 1.8, 0]])
    bumpy = flat + default_rng(seed).normal(0, 0.1, flat.shape)
    return 0.01 * bumpy


NEUTRAL = sheet()
POSED = sheet(3)


def colored(size=0.2, names=("strain_color", "normal_color")):
    """An avatar whose triangles' splats follow signals, by random offsets."""
    splats = lattice_splats(NEUTRAL, FACES, 1, 0, opacity_logit=2.0)
    values = default_rng(0).normal(0, size, (len(names), len(FACES), 3, 3)).astype(np.float32)
    offsets = dict(zip(names, values, strict=True))
    return Avatar(splats, "stga", NEUTRAL.astype(np.float32), FACES, driven_offsets=offsets)


def test_rigid_motion_far_away_does_not_strain():
    """Catches strain of pose instead of expression, and cancellation 100 m from the origin."""
    turned = NEUTRAL @ Rotation.random(random_state=2).as_matrix().T + [100, -50, 20]
    assert np.abs(deformation(strain_basis(NEUTRAL, FACES), turned)[:, :3]).max() < 1e-6


@pytest.mark.parametrize("broken", ["point", "line", "posed point", "torn"])
def test_broken_triangles_stay_finite(broken):
    """Catches division by an area of zero, and colors that explode with a stretch of a thousand."""
    neutral = sheet()
    posed = sheet(3)
    if broken == "point":
        neutral[FACES[1]] = neutral[2]
    if broken == "line":
        neutral[3] = (neutral[1] + neutral[2]) / 2
    if broken == "posed point":
        posed[:] = 0
    if broken == "torn":
        posed *= 1000
    found = deformation(strain_basis(neutral, FACES), posed)
    assert np.isfinite(found).all()
    assert np.abs(found).max() <= 2
    if broken in ("point", "line"):
        assert not found[1].any()


def test_deformation_stays_within_what_was_seen():
    """Catches colors extrapolated beyond the trained expressions, a range of another triangle or
    component, one that clips what was trained, a margin counted from 0 where a mesh at rest is
    clipped to less, and one beyond what may be followed."""
    rng = default_rng(4)
    allowed = trained_range(len(FACES))
    posed = [NEUTRAL + rng.normal(0, 3e-4, NEUTRAL.shape) for _ in range(3)]
    posed.append(0.7 * NEUTRAL)
    basis = strain_basis(NEUTRAL, FACES, allowed)
    every = np.stack([deformation(basis, mesh) for mesh in posed])
    limits = observed_range(basis, posed)
    rest = np.array([-MIN_COMPRESSION, -MIN_COMPRESSION, 0, 0, 0, 0])
    lowest = rest + RANGE_MARGIN * np.minimum((every - rest).min(0), 0)
    highest = rest + RANGE_MARGIN * np.maximum((every - rest).max(0), 0)
    assert_allclose(limits[:, 0], np.maximum(lowest, -MAX_STRAIN), atol=1e-6)
    assert_allclose(limits[:, 1], np.minimum(highest, allowed[:, 1]), atol=1e-6)
    assert limits[:, 0, :2].max() < -MIN_COMPRESSION
    assert (limits[:, 1, :2] == np.float32(-MIN_COMPRESSION)).all()
    limited = strain_basis(NEUTRAL, FACES, limits)
    for mesh, found in zip(posed, every, strict=True):
        assert_array_equal(deformation(limited, mesh), found)
    stronger = NEUTRAL + 4 * (posed[0] - NEUTRAL)
    free, clipped = (
        deformation(basis, stronger) for basis in (strain_basis(NEUTRAL, FACES), limited)
    )
    assert_array_equal(clipped, np.clip(free, limits[:, 0], limits[:, 1]))
    assert (np.abs(free) > np.abs(clipped) + 0.01).any(0)[[0, 1, 3, 4]].all()


def test_the_range_is_in_the_file_and_in_renderings(tmp_path):
    """Catches driven colors or their range lost in the file, and a range that frames ignore."""
    stretched = (1.1 * NEUTRAL).astype(np.float32)
    limits = np.zeros((len(FACES), 2, 6), np.float32)
    avatar = replace(colored(), strain_range=limits)
    write_avatar(tmp_path / "a.npz", avatar)
    found = read_avatar(tmp_path / "a.npz")
    assert_equal(found.driven_offsets, avatar.driven_offsets)
    assert_array_equal(found.strain_range, limits)
    assert np.abs(colored().frames(stretched).color).max() > 0.01
    assert not found.frames(stretched).color.any()


def test_baking_keeps_the_picture():
    """Catches a world PLY that forgets the colors of a deformed frame, or counts them twice."""
    avatar = colored()
    posed = sheet(4)
    pose = np.eye(4)
    pose[:3, 3] = [-0.005, -0.008, 0.1]
    camera = Camera(48, 48, 150.0, 150.0, 24.0, 24.0, pose)
    white = (1.0, 1.0, 1.0)
    drawn = render_avatar(avatar, posed, camera, white)
    baked = to_world(avatar.splats, avatar.frames(posed))
    assert_allclose(render(baked, camera, white), drawn, atol=2e-5)
    plain = replace(avatar, driven_offsets={})
    assert np.abs(render_avatar(plain, posed, camera, white) - drawn).max() > 0.05
    undeformed = face_frames(posed, FACES, NEUTRAL)
    assert_array_equal(to_world(avatar.splats, undeformed).sh, avatar.splats.sh)


def following():
    """An avatar without driven colors whose triangles' splats move by millimeters with strain."""
    return colored(3e-3, ["strain_position"])


def test_neighbors_share_an_edge():
    """Catches triangles that touch at a corner only, an edge of three triangles, and one that is
    its own neighbor."""
    fan = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4], [4, 1, 5], [5, 6, 7], [8, 8, 9]])
    lists = edge_neighbors(fan)
    found = [sorted(part.tolist()) for part in np.split(lists.indices, lists.indptr[1:-1])]
    assert found == [[1, 2], [0, 2], [0, 1, 3], [2], [], []]


def finned_sheet(seed=0):
    """Vertices and triangles of a mesh with a boundary, an edge of three triangles, and a vertex
    without any."""
    faces = np.concatenate([FACES[[2, 0]], [[2, 1, 5]], FACES[[3, 1]]])
    return np.concatenate([sheet(seed), [[0.01, 0.006, 0.012], [1, 1, 1]]]), faces


def test_strain_is_averaged_over_whatever_touches():
    """Catches lists of another vertex or triangle, a weight that is not one over their length, and
    a wrong dual basis, factor or transposed map of E = ½(FᵀF − I): plain loops over a mesh with a
    boundary, an edge of three triangles, and a vertex that no triangle touches."""
    (neutral, faces) = finned_sheet()
    (posed, _) = finned_sheet(3)
    axes = []
    tensors = []
    for face in faces:
        first = neutral[face[1]] - neutral[face[0]]
        second = neutral[face[2]] - neutral[face[0]]
        normal = np.cross(first, second)
        along, across = (v / norm(v) for v in (first, np.cross(normal, first)))
        axes.append((along, across))
        moved = np.stack([posed[face[1]] - posed[face[0]], posed[face[2]] - posed[face[0]]], 1)
        gradient = moved @ np.linalg.pinv(np.stack([first, second], 1))
        plane = np.outer(along, along) + np.outer(across, across)
        tensors.append((gradient.T @ gradient - plane) / 2)
    at_vertex = [
        np.mean([t for t, face in zip(tensors, faces, strict=True) if v in face], 0)
        for v in range(6)
    ]
    for f, (along, across) in enumerate(axes):
        mean = np.mean([at_vertex[v] for v in faces[f]], 0)
        pairs = (along, along), (across, across), (along, across)
        expected = 5 * np.array([a @ mean @ b for a, b in pairs])
        assert np.abs(expected).max() > 0.1
        found = deformation(strain_basis(neutral, faces), posed)[f, :3]
        assert_allclose(found, np.clip(expected, -MAX_STRAIN, MAX_STRAIN), atol=1e-5)


def test_smoothed_strain_is_averaged_over_edges():
    """Catches another weight or number of rounds, and a mesh at rest that is not zero."""
    (neutral, faces) = finned_sheet()
    (posed, _) = finned_sheet(3)
    basis = strain_basis(neutral, faces, trained_range(len(faces)))
    deformed = deformation(basis, posed)
    average = np.zeros((len(faces), len(faces)))
    for f in range(len(faces)):
        members = [g for g in range(len(faces)) if len(set(faces[f]) & set(faces[g])) >= 2]
        average[f, members] = 1 / len(members)
    moved = deformed[:, :3] - [-MIN_COMPRESSION, -MIN_COMPRESSION, 0]
    expected = np.linalg.matrix_power(average, AVERAGING_ROUNDS) @ moved
    assert_allclose(smoothed_strain(basis, deformed), expected, atol=1e-6)
    assert np.abs(expected).max() > 0.1
    turned = neutral @ Rotation.from_rotvec([0.3, 1, -2]).as_matrix().T
    assert_allclose(smoothed_strain(basis, deformation(basis, turned)), 0, atol=1e-6)


@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
def test_colors_follow_strain_and_normals(convention):
    """Catches coefficients of another triangle, signal or component, normals in the triangle's own
    axes, or of the posed mesh only, one of two colors that is lost, and the capture's light that
    stays where other light takes its place: plain loops."""
    avatar = replace(colored(), convention=convention)
    basis = strain_basis(NEUTRAL, FACES)
    smoothed = smoothed_strain(basis, deformation(basis, POSED))
    by_strain, by_normal = avatar.driven_offsets.values()
    for f, (a, b, c) in enumerate(FACES):
        normals = [np.cross(m[b] - m[a], m[c] - m[a]) for m in (POSED, NEUTRAL)]
        after, before = (normal / norm(normal) for normal in normals)
        skin = sum(smoothed[f, k] * by_strain[f, k] for k in range(3))
        light = sum((after - before)[k] * by_normal[f, k] for k in range(3))
        assert np.abs(light).max() > 1e-3
        assert_allclose(avatar.frames(POSED).color[f], skin + light, atol=1e-6)
        assert_allclose(avatar.without_light.frames(POSED).color[f], skin, atol=1e-6)
    assert_allclose(avatar.frames(NEUTRAL).color, 0, atol=1e-6)


@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
def test_positions_follow_strain(convention):
    """Catches a shift in other axes or units than the splats', and a mesh at rest that moves."""
    avatar = replace(following(), convention=convention)
    basis = strain_basis(NEUTRAL, FACES)
    smoothed = smoothed_strain(basis, deformation(basis, POSED)).astype(np.float64)
    moves = avatar.driven_offsets["strain_position"]
    shift = [sum(smoothed[f, k] * moves[f, k] for k in range(3)) for f in range(len(FACES))]
    xyz = avatar.splats.xyz + np.array(shift)[avatar.splats.face]
    shifted = replace(avatar.splats, xyz=xyz.astype(np.float32))
    plain = face_frames(POSED, FACES, NEUTRAL, convention)
    baked = to_world(avatar.splats, avatar.frames(POSED))
    assert_allclose(baked.xyz, to_world(shifted, plain).xyz, atol=1e-7)
    assert_array_equal(baked.rotation, to_world(shifted, plain).rotation)
    assert np.abs(baked.xyz - to_world(avatar.splats, plain).xyz).max() > 1e-4
    still = to_world(avatar.splats, face_frames(NEUTRAL, FACES, NEUTRAL, convention))
    rest = to_world(avatar.splats, avatar.frames(NEUTRAL))
    assert_allclose(rest.xyz, still.xyz, atol=1e-7)


def test_positions_stay_near_where_the_mesh_is_torn():
    """Catches positions that leave with strain beyond its range, and NaN of triangles without
    area."""
    avatar = following()
    farthest = MAX_STRAIN * np.abs(avatar.driven_offsets["strain_position"]).sum((1, 2))
    torn = 1000 * sheet(2)
    flat = NEUTRAL * [1, 0, 0]
    far = NEUTRAL + 100.0
    torn[1] = torn[0]
    for posed in (torn, flat, far, np.zeros_like(NEUTRAL)):
        plain = face_frames(posed, FACES, NEUTRAL)
        moved = avatar.frames(posed)
        away = norm(moved.origin - plain.origin, axis=1)
        assert np.isfinite(moved.origin).all()
        assert (away <= farthest * plain.scale + 1e-9).all()
    away = avatar.frames(far).origin - face_frames(far, FACES, NEUTRAL).origin
    assert norm(away, axis=1).max() < 1e-7  # strain of float32


@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
@pytest.mark.parametrize("name", OFFSETS)
def test_only_what_shows_is_kept(name, convention):
    """Catches coefficients taken for invisible by another range, signal or unit than poses have."""
    rng = default_rng(4)
    limits = rng.random((len(FACES), 2, 6)).astype(np.float32) * [[-2], [0.5]]
    tiny = replace(colored().splats, log_scale=np.full_like(colored().splats.log_scale, -30.0))
    unit = face_frames(NEUTRAL, FACES, NEUTRAL, convention).scale
    shares = []
    divisor = 10 * unit if name == "strain_position" else 1.0
    for exponent in np.linspace(-3, 1, 41):
        sizes = 10**exponent * rng.random(len(FACES)) / divisor
        coefficients = sizes[:, None, None] * rng.normal(0, 0.2, (len(FACES), 3, 3))
        whole = Avatar(
            tiny,
            convention,
            NEUTRAL.astype(np.float32),
            FACES,
            strain_range=limits.astype(np.float32),
            driven_offsets={name: coefficients.astype(np.float32)},
        )
        pruned = whole.with_limited_offsets
        is_kept = pruned.driven_offsets[name].any((1, 2))
        assert_array_equal(
            pruned.driven_offsets[name][is_kept], whole.driven_offsets[name][is_kept]
        )
        shares.append(is_kept.mean())
        for _ in range(20):
            posed = (NEUTRAL * rng.uniform(0.4, 1.5, 3)) @ Rotation.random(rng=rng).as_matrix()
            ours = pruned.frames(posed)
            theirs = whole.frames(posed)
            assert abs(ours.color - theirs.color).max(initial=0) < MIN_COLOR_CHANGE
            assert abs(np.log(ours.scale / theirs.scale)).max() < MIN_SCALE_CHANGE
            plain = face_frames(posed, FACES, NEUTRAL, convention)
            away = norm(ours.origin - theirs.origin, axis=1)
            assert (away < np.sqrt(3) * MIN_SHIFT_M * plain.scale / unit).all()
    assert shares[0] < 0.3
    assert shares[-1] == 1


@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
def test_no_pose_blows_a_splat_up(convention):
    """Catches a disc over half the face: strains that no filmed pose combines, each within its own
    range, of coefficients that training has left free; and small splats that no longer grow."""
    rng = default_rng(5)
    splats = colored().splats
    unit = face_frames(NEUTRAL, FACES, NEUTRAL, convention).scale[splats.face]
    size = 10 ** rng.uniform(-5, -2, len(splats))
    splats = replace(
        splats, log_scale=np.log(size / unit)[:, None].astype(np.float32) - np.float32([0, 1, 2])
    )
    coefficients = np.zeros((len(FACES), 3, 3), np.float32)
    coefficients[:, :, 0] = rng.normal(0, 2, (len(FACES), 3))
    avatar = Avatar(
        splats,
        convention,
        NEUTRAL.astype(np.float32),
        FACES,
        strain_range=np.tile(np.float32([[-1], [1]]), (len(FACES), 1, 6)),
        driven_offsets={"strain_scale": coefficients},
    )
    limited = avatar.with_limited_offsets
    most = np.zeros((2, len(splats)))
    for _ in range(200):
        posed = NEUTRAL + rng.normal(0, 0.3, NEUTRAL.shape) * np.ptp(NEUTRAL, axis=0)
        plain = face_frames(posed, FACES, NEUTRAL, convention).scale
        for row, own in enumerate((avatar, limited)):
            growth = (own.frames(posed).scale / plain)[splats.face]
            most[row] = np.maximum(most[row], growth)
    bound = np.maximum(3.0, 0.015 / size)
    assert (most[0] > 1.5 * bound).any()
    assert (most[1] <= bound * 1.001).all()
    least = np.full(len(FACES), np.inf)
    np.minimum.at(least, splats.face, bound)
    fits = np.abs(coefficients).sum((1, 2)) < np.log(least)  # in any pose
    assert fits.any()
    assert_array_equal(limited.driven_offsets["strain_scale"][fits], coefficients[fits])
