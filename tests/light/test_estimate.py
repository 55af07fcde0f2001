"""A capture's light from colors made with a known one; occlusion against cast rays."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from light.scenes import ball_and_plate, blocked
from stga_addon.capture.mesh_geometry import vertex_normals
from stga_addon.light.estimate import (
    HARD_RESIDUAL,
    dark_triangles,
    fit_light,
    recorded_irradiance,
    roughness_of,
)
from stga_addon.light.harmonics import LAMBERT, basis, even_directions, rotated, uniform
from stga_addon.light.lamps import LIFT_M
from stga_addon.light.surface import Bounce, transfer_of

SKIN = np.array([0.5, 0.36, 0.25])


def soft_light():
    light = uniform((0.6, 0.6, 0.6))
    light[1:4] = [[0.3] * 3, [0.5] * 3, [-0.2] * 3]
    return light


@pytest.fixture(scope="module")
def received():
    """(F, 9) transfer of the triangles of a ball under a plate."""
    vertices, faces = ball_and_plate(3)
    return np.asarray(transfer_of(vertices, faces, 96)[0][faces].mean(1), np.float64)


def recorded(received, light, turns=None):
    """Colors (T, F, 3) of spotted skin with highlights, and transfer (T, F, 9)."""
    rng = np.random.default_rng(1)
    albedo = SKIN * rng.uniform(0.9, 1.1, (len(received), 1))
    albedo[rng.random(len(received)) < 0.15] *= 0.2
    posed = np.stack([received @ rotated(np.eye(9), turn) for turn in turns or [np.eye(3)]])
    colors = albedo / np.pi * (posed @ light)
    colors *= rng.normal(1, 0.02, colors.shape)
    colors[:, rng.random(len(received)) < 0.05] += 0.3
    colors[:, rng.random(len(received)) < 0.2] = np.nan
    return np.maximum(colors, 1e-3), posed


def test_a_soft_light_is_found_despite_spots_and_highlights(received):
    """Catches light drawn to brows and highlights, that turns along, or a lamp taken for soft."""
    turn = Rotation.from_euler("y", 25, degrees=True).as_matrix()
    light = soft_light()
    found, residual = fit_light(*recorded(received, light, [np.eye(3), turn, turn.T]))
    normals = even_directions(200)
    have, want = (np.maximum(basis(normals) * LAMBERT @ each, 0)[:, 1] for each in (found, light))
    have *= want.mean() / have.mean()
    assert np.abs(have - want).mean() < 0.03 * want.mean()
    assert residual < HARD_RESIDUAL / 2
    known, _ = fit_light(*recorded(received, light), light)
    assert_array_equal(known, light)
    vertices, faces = ball_and_plate(3)
    normals = vertex_normals(vertices, faces)[faces].mean(1)
    toward = np.array([0.9, 0.1, 0.3]) / np.linalg.norm([0.9, 0.1, 0.3])
    lit = np.maximum(normals @ toward, 0) + 0.05
    colors = (SKIN / np.pi * 3 * lit[:, None])[None]
    _, residual = fit_light(np.maximum(colors, 1e-3), received[None])
    assert residual > HARD_RESIDUAL


def test_what_is_rarely_seen_is_lit_as_when_it_is_seen():
    """Catches teeth whose colors are divided by the light in a closed mouth."""
    vertices, faces = ball_and_plate(2)
    direct = np.stack([np.full((len(vertices), 3), 0.1), np.full((len(vertices), 3), 2.0)])
    cameras = np.full((2, len(faces)), 4)
    hidden = vertices[faces].mean(1)[:, 0] < 0
    cameras[0, hidden] = 0
    cameras[:, vertices[faces].mean(1)[:, 0] < -0.08] = 0
    open_sky = Bounce(vertices, faces, np.ones(len(vertices)))
    found = recorded_irradiance(direct, cameras, faces, open_sky)
    at = vertices[:, 0]
    assert_allclose(found[at > 0.03], (0.1 + 2.0) / 2)
    assert_allclose(found[(at < -0.03) & (at > -0.07)], 2.0, rtol=1e-3)
    assert_allclose(found[at < -0.098], (0.1 + 2.0) / 2)  # never seen


def test_light_that_skin_reflects_has_no_unit():
    """Catches cells over a mesh in millimeters that would fill all memory, and skin there that
    reflects none of the light of its neighbors."""
    vertices, faces = ball_and_plate(4)
    half_open = np.full(len(vertices), 0.5)
    above = vertices[:, 1:2] > 0
    arriving = np.where(above, 1.0, 0.2) * np.ones(3)
    meters, large = (Bounce(scale * vertices, faces, half_open) for scale in (1, 1000))
    found = large.light(arriving)
    assert found.sum() == pytest.approx(meters.light(arriving).sum(), rel=0.05)
    edge = (np.abs(vertices[:, 1]) < 0.002) & (vertices[:, 1] <= 0)
    assert (found[edge] > 1.2 * found.min(0)).all()


def test_eyeballs_are_found(shared_data):
    """Catches eyes without a highlight of their own, and skin that is taken for one."""
    from stga_addon.capture.open import open_capture

    capture = open_capture(shared_data / "studio_head")
    wet = roughness_of(capture.neutral, capture.faces) > 0
    eyes = np.zeros(len(wet), bool)
    eyes[capture.faces[capture.regions["left_eye"] | capture.regions["right_eye"]]] = True
    assert wet.sum() > 100
    assert eyes[wet].mean() > 0.95


def test_transfer_and_occlusion_are_those_of_cast_rays():
    """Catches depth maps that are mirrored, coarse or shade themselves, and another solid angle."""
    vertices, faces = ball_and_plate(2)
    transfer, occlusion = transfer_of(vertices, faces, directions=48)
    normals = vertex_normals(vertices, faces)
    sky = even_directions(48)
    points = vertices + LIFT_M * normals
    seen = np.stack([~blocked(points, direction, vertices, faces) for direction in sky])
    cosine = np.maximum(sky @ normals.T, 0)
    expected = (seen * cosine).T @ basis(sky) * 4 * np.pi / len(sky)
    apart = np.abs(occlusion - (seen * cosine).sum(0) / cosine.sum(0))
    assert apart.max() < 0.12 and apart.mean() < 0.008  # noqa: PT018
    assert np.abs(transfer - expected).mean() < 0.01
    assert occlusion[:162].min() < 0.7, "the plate hides no sky"
    vertices, faces = ball_and_plate(3)
    transfer, occlusion = transfer_of(vertices, faces)
    normals = vertex_normals(vertices, faces)
    below = (normals[:, 1] < -0.3) & (np.linalg.norm(vertices, axis=1) < 0.1001)
    assert below.sum() > 100
    assert_allclose(transfer[below], basis(normals[below]) * LAMBERT, atol=0.03)
    assert_allclose(occlusion[below], 1, atol=0.01)


def test_dark_triangles_are_hair():
    """Catches hair in bright light that counts as skin, skin in the dark as hair, and a nose or
    triangles that no view shows."""
    albedo = np.array([0.4, 0.4, 0.08, 0.08, 0.4, 0.4])
    light = np.array([1.0, 1.0, 3.0, 0.5, 0.1, 1.0])
    color = np.tile((albedo * light)[None, :, None], (2, 1, 3))
    color[0, 1] = color[:, 5] = np.nan
    nose = np.arange(6) < 2
    received = np.tile(light[:, None], 3)
    found = dark_triangles(color, received, nose)
    assert found.tolist() == [False, False, True, True, False, False]
    for unknown in (None, np.arange(6) == 5):
        assert not dark_triangles(color, received, unknown).any()
