"""Transfer and occlusion, against cast rays."""

import numpy as np

from light.scenes import ball_and_plate, blocked
from stga_addon.capture.mesh_geometry import vertex_normals
from stga_addon.light.harmonics import LAMBERT, basis, even_directions
from stga_addon.light.lamps import LIFT_M
from stga_addon.light.surface import transfer_of


def test_transfer_and_occlusion_are_those_of_cast_rays():
    """Catches depth maps that are mirrored, too coarse, or that let the surface shade itself."""
    vertices, faces = ball_and_plate(2)
    transfer, occlusion = transfer_of(vertices, faces, directions=48)
    normals, sky = vertex_normals(vertices, faces), even_directions(48)
    points = vertices + LIFT_M * normals
    seen = np.stack([~blocked(points, direction, vertices, faces) for direction in sky])
    cosine = np.maximum(sky @ normals.T, 0)
    expected = (seen * cosine).T @ basis(sky) * 4 * np.pi / len(sky)
    np.testing.assert_allclose(occlusion, (seen * cosine).sum(0) / cosine.sum(0), atol=0.12)
    assert np.abs(occlusion - (seen * cosine).sum(0) / cosine.sum(0)).mean() < 0.008
    assert np.abs(transfer - expected).mean() < 0.01
    assert occlusion[:162].min() < 0.7, "the plate hides no sky"


def test_an_open_surface_receives_the_closed_form():
    """Catches harmonics of another order or sign, and a wrong solid angle."""
    vertices, faces = ball_and_plate(3)
    transfer, occlusion = transfer_of(vertices, faces)
    normals = vertex_normals(vertices, faces)
    below = (normals[:, 1] < -0.3) & (np.linalg.norm(vertices, axis=1) < 0.1001)
    assert below.sum() > 100
    np.testing.assert_allclose(transfer[below], basis(normals[below]) * LAMBERT, atol=0.03)
    np.testing.assert_allclose(occlusion[below], 1, atol=0.01)
