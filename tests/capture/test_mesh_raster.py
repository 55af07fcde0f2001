"""What a camera sees of a mesh, against one equation per pixel."""

from dataclasses import replace

import numpy as np
import trimesh

from stga_addon.capture.camera import Camera, look_at
from stga_addon.capture.mesh_geometry import rasterize


def by_equations(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Like `rasterize`: the barycentric coordinates of each pixel center in each triangle, solved for."""
    flat, depth = camera.project(vertices)
    y, x = np.mgrid[: camera.height, : camera.width]
    centers = np.stack([x.ravel() + 0.5, y.ravel() + 0.5, np.ones(x.size)])
    systems = np.concatenate([flat[faces], np.ones((len(faces), 3, 1))], 2).transpose(0, 2, 1)
    inside = np.linalg.solve(systems, np.broadcast_to(centers, (len(faces), *centers.shape))).transpose(2, 0, 1)
    closeness = np.where((inside >= 0).all(2), (inside / depth[faces]).sum(2), 0)
    nearest = closeness.argmax(1)
    shown = closeness.max(1) > 0
    shape = camera.height, camera.width
    weights = np.where(shown[:, None], inside[np.arange(len(nearest)), nearest], 0)
    return np.where(shown, nearest, -1).reshape(shape), weights.reshape(*shape, 3)


def test_every_pixel_shows_the_nearest_triangle():
    """Catches a triangle that is farther, a gap between neighbors, lines cut off at the image's edge, and barycentric
    coordinates of another corner; triangles are from a tenth of a pixel to larger than the image."""
    rng = np.random.default_rng(0)
    camera = replace(look_at((0.2, 0.1, 2.0), (0, 0, 0), 37, 29, 40.0), cx=17.0, cy=15.5)
    sizes = np.repeat([0.005, 0.05, 0.3, 3.0], [150, 60, 30, 8])
    corners = rng.uniform(-0.7, 0.7, (len(sizes), 1, 3)) + sizes[:, None, None] * rng.normal(size=(len(sizes), 3, 3))
    vertices, faces = corners.reshape(-1, 3), np.arange(3 * len(sizes)).reshape(-1, 3)
    in_front = (camera.project(vertices)[1][faces] > 0.05).all(1)
    triangle, weights = rasterize(vertices, faces[in_front], camera)
    expected, expected_weights = by_equations(vertices, faces[in_front], camera)
    assert (expected >= 0).mean() > 0.4
    np.testing.assert_array_equal(triangle, expected)
    np.testing.assert_allclose(weights, expected_weights, atol=1e-7)


def test_a_closed_mesh_has_no_holes():
    """Catches pixels between two triangles whose centers lie on the common edge to within rounding."""
    mesh = trimesh.creation.icosphere(subdivisions=4)
    for turn in np.linspace(0, 1, 7):
        camera = look_at((3 * np.sin(turn), 0, 3 * np.cos(turn)), (0, 0, 0), 64, 64, 64.0)
        shown = rasterize(mesh.vertices, mesh.faces, camera)[0] >= 0
        y, x = np.mgrid[:64, :64] + 0.5 - 32
        assert shown[np.hypot(x, y) < 22].all()
        assert not shown[np.hypot(x, y) > 23].any()
