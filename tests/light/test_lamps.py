"""Irradiance of lights against closed forms (and in tests/blender/test_light.py against Cycles),
shadows against cast rays."""

import numpy as np
import pytest

from light.scenes import ball_and_plate, blocked
from stga_addon.capture.mesh_geometry import vertex_normals
from stga_addon.light.lamps import LIFT_M, Lamps, ShadowMap, head_bounds, light_view
from stga_addon.light.values import Caster, Light, Lighting

NO_FACES = np.zeros((0, 3), np.int32)
AROUND = np.array([[-0.1, -0.1, -0.1], [0.1, 0.1, 0.1]])
UP = np.array([[0.0, 0.0, 1.0]])


def irradiance(light: Light) -> float:
    lamps = Lamps(Lighting(lights=(light,)), AROUND, NO_FACES)
    return float(lamps.irradiance(np.zeros((1, 3)), UP)[0, 1])


def test_units_are_blenders():
    """Catches a wrong factor of π, and a cosine or distance that is left out."""
    sun = Light("sun", np.ones(3) * 3, direction=(-1, 0, -1))
    assert irradiance(sun) == pytest.approx(3 * np.sqrt(0.5), rel=1e-5)
    square = 0.25 + 0.25 + 4
    expected = 100 / (4 * np.pi) / square * 2 / np.sqrt(square)
    point = Light("point", np.ones(3) * 100, (0.5, 0.5, 2))
    assert irradiance(point) == pytest.approx(expected, rel=1e-5)
    small = Light("area", np.ones(3) * 100, (0, 0, 2), size=(0.01, 0.01))
    assert irradiance(small) == pytest.approx(100 / np.pi / 4, rel=1e-4)


@pytest.mark.parametrize("kind", ["sun", "point"])
def test_shadows_are_those_of_cast_rays(kind):
    """Catches shadow maps in which the surface shades itself, that miss the plate, or put its
    shadow elsewhere."""
    light = Light(kind, np.ones(3), (0.3, 0.8, 0.2), direction=(-0.3, -1, 0.1))
    vertices, faces = ball_and_plate(3)
    normals = vertex_normals(vertices, faces)
    points = vertices + LIFT_M * normals
    to_light = -np.broadcast_to(light.direction, points.shape)
    if light.kind == "point":
        to_light = light.position - points
        to_light = to_light / np.linalg.norm(to_light, axis=1, keepdims=True)
    facing = (normals * to_light).sum(1) > 0.1
    rays = zip(points, to_light, strict=True)
    expected = np.array([not blocked(p[None], d, vertices, faces)[0] for p, d in rays])[facing]
    assert 0.02 < (~expected).sum() / len(facing) < 0.5
    lights = Lighting(lights=(light,)), Lighting(lights=(light,), shadows=False)
    lamps = [Lamps(lighting, vertices, faces) for lighting in lights]
    found, without = (each.irradiance(points, normals)[facing, 0] for each in lamps)
    lit = found / without
    assert (np.abs(lit - expected) > 0.5).mean() < 0.02
    assert np.abs(lit - expected).mean() < 0.04


def test_another_object_throws_its_shadow():
    """Catches casters that are ignored, or drawn in another space than the head."""
    vertices, faces = ball_and_plate(2)
    ball = faces[(faces < 162).all(1)]
    sun = Lighting(lights=(Light("sun", np.ones(3), direction=(0, -1, 0)),))
    top = np.array([[0.0, 0.1 + LIFT_M, 0.0]])
    up = np.array([[0.0, 1.0, 0.0]])
    wall = Caster(np.array([[-1.0, 1, -1], [1, 1, -1], [0, 1, 1]]), np.array([[0, 1, 2]]))
    for casters, expected in (([], 1), ([wall], 0)):
        found = Lamps(sun, vertices[:162], ball, casters).irradiance(top, up)[0, 0]
        assert found == pytest.approx(expected, abs=1e-3)


def test_depth_of_a_large_triangle():
    """Catches a wall from near a lamp to the head whose depth is that of its corners' mean and not
    of its plane."""
    lamp = Light("point", np.ones(3), (0, 0, 1))
    corners = np.array([[0.0, 0.4, 0.9], [-0.3, -0.2, 0.1], [0.3, -0.2, 0.1]])
    wall = Caster(corners, np.array([[0, 1, 2]]))
    found = ShadowMap(AROUND, NO_FACES, lamp, [wall]).depth
    view = light_view(head_bounds(AROUND), lamp)
    y, x = (np.indices(found.shape) + 0.5 - view.size / 2) / view.scale
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ view.axes.T
    normal = np.cross(*(corners[1:] - corners[0]))
    expected = (corners[0] - lamp.position) @ normal / (rays @ normal)
    drawn = np.isfinite(found)
    assert drawn.mean() > 0.1
    assert np.ptp(expected[drawn]) > 0.1
    np.testing.assert_allclose(found[drawn], expected[drawn], rtol=1e-4)
