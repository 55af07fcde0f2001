"""Irradiance of lights against closed forms, shadows against cast rays and single lookups."""

import os
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rays import distances

from light.scenes import ball_and_plate, blocked
from stga_addon.capture.mesh_geometry import vertex_normals
from stga_addon.light import array_kernels, lamps
from stga_addon.light.lamps import LIFT_M, Lamps, ShadowMap, head_bounds, light_rows, light_view
from stga_addon.light.values import Caster, Light, Lighting
from stga_addon.raster.cpu import shadow
from stga_addon.raster.kernel_cache import prefers_numba
from stga_addon.worker.launch import CACHE_VARIABLE

NO_FACES = np.zeros((0, 3), np.int32)
AROUND = np.array([[-0.1, -0.1, -0.1], [0.1, 0.1, 0.1]])
UP = np.array([[0.0, 0.0, 1.0]])


def irradiance(light):
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
    """Catches shadow maps that shade the surface itself, miss the plate, or put it elsewhere."""
    light = Light(kind, np.ones(3), (0.3, 0.8, 0.2), direction=(-0.3, -1, 0.1))
    vertices, faces = ball_and_plate(3)
    normals = vertex_normals(vertices, faces)
    points = vertices + LIFT_M * normals
    to_light = -np.broadcast_to(light.direction, points.shape)
    if light.kind == "point":
        to_light = light.position - points
        to_light = to_light / np.linalg.norm(to_light, axis=1, keepdims=True)
    facing = (normals * to_light).sum(1) > 0.1
    expected = ~blocked(points, to_light, vertices, faces)[facing]
    assert 0.02 < (~expected).sum() / len(facing) < 0.5
    lights = Lighting(lights=(light,)), Lighting(lights=(light,), shadows=False)
    lamps = [Lamps(lighting, vertices, faces) for lighting in lights]
    found, without = (each.irradiance(points, normals)[facing, 0] for each in lamps)
    lit = found / without
    assert (np.abs(lit - expected) > 0.5).mean() < 0.02
    assert np.abs(lit - expected).mean() < 0.04


def test_another_object_throws_its_shadow():
    """Catches casters ignored or elsewhere, and a large wall's depth of its corners' mean."""
    vertices, faces = ball_and_plate(2)
    ball = faces[(faces < 162).all(1)]
    sun = Lighting(lights=(Light("sun", np.ones(3), direction=(0, -1, 0)),))
    top = np.array([[0.0, 0.1 + LIFT_M, 0.0]])
    up = np.array([[0.0, 1.0, 0.0]])
    wall = Caster(np.array([[-1.0, 1, -1], [1, 1, -1], [0, 1, 1]]), np.array([[0, 1, 2]]))
    for casters, expected in (([], 1), ([wall], 0)):
        found = Lamps(sun, vertices[:162], ball, casters).irradiance(top, up)[0, 0]
        assert found == pytest.approx(expected, abs=1e-3)
    lamp = Light("point", np.ones(3), (0, 0, 1))
    corners = np.array([[0.0, 0.4, 0.9], [-0.3, -0.2, 0.1], [0.3, -0.2, 0.1]])
    wall = Caster(corners, np.array([[0, 1, 2]]))
    found = ShadowMap(AROUND, NO_FACES, lamp, [wall]).depth
    view = light_view(head_bounds(AROUND), lamp)
    y, x = (np.indices(found.shape) + 0.5 - view.size / 2) / view.scale
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ view.axes.T
    expected = distances(lamp.position, rays[..., None, :], corners[None])[..., 0]
    drawn = np.isfinite(found)
    assert (drawn != np.isfinite(expected)).mean() < 0.01 < drawn.mean()
    drawn &= np.isfinite(expected)
    assert np.ptp(expected[drawn]) > 0.1
    assert_allclose(found[drawn], expected[drawn], rtol=1e-4)


LIGHTS = (
    Light("sun", np.array([1.0, 2.0, 3.0]), direction=(-0.3, -1, 0.1), angle=0.1),
    Light("point", np.ones(3), (0.3, 0.8, 0.2), radius=0.1, specular=0.5),
    Light(
        "spot",
        np.ones(3) * 50,
        (0.0, 0.9, 0.2),
        direction=(0.1, -1, 0),
        cone=0.3,
        blend=0.5,
        casts_shadow=False,
    ),
    Light(
        "area",
        np.ones(3),
        (0.5, 0.5, 0.2),
        direction=(-1, -1, 0),
        size=(0.3, 0.4),
        shape="ellipse",
        diffuse=0.7,
    ),
)


@pytest.mark.parametrize("imports", ["sys", "sys, numba"])
def test_a_light_compiles_no_kernels(tmp_path, imports):
    """Catches seconds of compiling at the first light in Blender, whose window stands still, and
    other last bits because something else has loaded Numba."""
    script = (
        f"import {imports}, numpy as np\n"
        "from stga_addon.light.lamps import Lamps\n"
        "from stga_addon.light.values import Light, Lighting\n"
        "sun = Light('sun', np.ones(3), direction=(0.0, 0.0, -1.0))\n"
        "mesh, faces = np.eye(3), np.array([[0, 1, 2]], np.int32)\n"
        "lamps = Lamps(Lighting(np.zeros((9, 3)), (sun,)), mesh, faces)\n"
        "assert lamps.irradiance(mesh, np.eye(3)).any()\n"
        "assert 'stga_addon.raster.cpu' not in sys.modules\n"
    )
    folders = {"NUMBA_CACHE_DIR": str(tmp_path / "own"), CACHE_VARIABLE: str(tmp_path)}
    subprocess.run([sys.executable, "-c", script], check=True, env={**os.environ, **folders})


def test_compiled_kernels_are_used(tmp_path, monkeypatch):
    """Catches slow lights beside compiled kernels, or by those of Blender's own process."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(lamps, "prefers_numba", prefers_numba.__wrapped__)
    assert lamps.depth_kernel() is array_kernels.add_depths
    (tmp_path / "cpu_0").mkdir()
    (tmp_path / "cpu_0/image_loss.image_loss-10.py311.nbi").touch()
    assert lamps.depth_kernel() is shadow.add_depths
    monkeypatch.setattr("stga_addon.raster.kernel_cache.find_spec", lambda name: None)
    assert lamps.depth_kernel() is array_kernels.add_depths


def unit(vector):
    return vector / np.linalg.norm(vector)


def glossy(normal, to_light, to_eye, square):
    """A GGX lobe times the cosine of the light: Walter et al. 2007, equation 33; Heitz 2014,
    equation 99."""
    half = unit(to_light + to_eye)
    cosine = np.clip(normal @ half, 1e-6, 1)
    tangent = np.tan(np.arccos(cosine))
    distribution = square / (np.pi * cosine**4 * (square + tangent**2) ** 2)
    eye = max(normal @ to_eye, 0.05)
    cosines = np.array([normal @ to_light, eye])
    hidden = (np.sqrt(1 + square * (1 / cosines**2 - 1)) - 1) / 2
    fresnel = 0.04 + 0.96 * (1 - to_eye @ half) ** 5
    return distribution * fresnel / (1 + hidden.sum()) / (4 * eye)


def arriving(light, place, point):
    """Unit vector to a light, and its strength without shadows; a disk's or square's place."""
    if light.kind == "sun":
        return -unit(np.array(light.direction)), 1.0, np.tan(light.angle / 2)
    away = place - point
    distance = np.linalg.norm(away)
    strength = 1 / (np.pi if light.kind == "area" else 4 * np.pi) / distance**2
    along = -(away / distance) @ unit(np.array(light.direction))
    if light.kind == "area":
        strength *= max(along, 0)
    elif light.kind == "spot":
        edge = np.cos(light.cone / 2)
        inside = np.clip((along - edge) / ((1 - edge) * light.blend), 0, 1)
        strength *= 3 * inside**2 - 2 * inside**3
    return away / distance, strength, light.radius / distance


@pytest.mark.parametrize("light", LIGHTS, ids=[light.kind for light in LIGHTS])
def test_lights(light):
    """Catches a cosine, factor or shadow that a light's irradiance or highlight lacks."""
    rng = np.random.default_rng(0)
    points = rng.normal(0, 0.1, (60, 3))
    normals = np.stack([unit(row) for row in rng.normal(0, 1, points.shape)])
    rows = light_rows(light, np.zeros(3), 0)
    lit = rng.random((1, 60), np.float32)
    roughness = rng.choice([0, 0.2, 0.45], 60)
    eye = np.array([0.1, 0.2, 0.7])
    given = array_kernels.Surface(*(np.float32(each) for each in (points, normals, roughness)))
    found = array_kernels.shaded(given, np.float32(eye), 0.04, rows, lit)
    expected = np.zeros((2, 60, 3))
    for n, (point, normal) in enumerate(zip(points, normals, strict=True)):
        for row in rows.astype(float):
            to_light, strength, width = arriving(light, row[1:4], point)
            width = row[15] / np.linalg.norm(row[1:4] - point) if light.kind == "area" else width
            facing = max(normal @ to_light, 0)
            irradiance = light.color / len(rows) * strength * lit[0, n] * facing
            expected[0, n] += light.diffuse * irradiance
            if roughness[n] and facing:
                square = min(roughness[n] ** 4 + width**2 / 8, 1)
                gloss = glossy(normal, to_light, unit(eye - point), square) / facing
                expected[1, n] += light.specular * irradiance * gloss
    assert expected[0].max() > 0.02
    assert expected[1].max() > 1e-4
    for each, known in zip(found, expected, strict=True):
        assert_allclose(each, known, rtol=2e-3, atol=2e-3 * known.max())


@pytest.mark.parametrize("light", LIGHTS[:2], ids=["sun", "point"])
def test_shadow_maps(light):
    """Catches texels that only one of the kernels draws, or looks up beside its place."""
    vertices, faces = ball_and_plate(3)
    points = light_view(head_bounds(vertices), light, 256).project(vertices)
    depth = [np.full((256, 256), np.inf, np.float32) for _ in range(2)]
    for one, kernels in zip(depth, (shadow, array_kernels), strict=True):
        kernels.add_depths(points, faces, one)
    assert np.isfinite(depth[0]).mean() > 0.2
    assert (np.isfinite(depth[0]) != np.isfinite(depth[1])).mean() < 1e-3
    both = np.isfinite(depth[0]) & np.isfinite(depth[1])
    assert np.abs(depth[0][both] - depth[1][both]).mean() < 1e-6
    outside = np.float32([[-1e6, -1e6, 0.1], [300, 128, 0.1], [0.2, 0.1, 5]])
    places = np.concatenate([points, outside])
    bias = np.random.default_rng(0).uniform(0, 0.006, len(places)).astype(np.float32)
    for reach in (0, 1, 2):
        taps = (-reach, 0, reach) if reach else (0,)
        shifts = [(x, y) for x in taps for y in taps]
        expected = [looked_up(depth[0], places + np.array([x, y, 0]), bias) for x, y in shifts]
        lit = array_kernels.lit_fractions(depth[0], places, bias, reach)
        assert 0.05 < lit.mean() < 0.95
        assert_allclose(lit, np.mean(expected, axis=0), atol=1e-4)


def looked_up(depth, places, bias):
    """Fraction of four texels around each place that are no nearer, by bilinear weights."""
    corner = np.floor(places[:, :2] - 0.5)
    x, y = (places[:, :2] - 0.5 - corner).T
    found = np.zeros(len(places))
    for right in (0, 1):
        for lower in (0, 1):
            column, row = (corner + np.array([right, lower])).T
            inside = (column >= 0) & (row >= 0) & (column < len(depth)) & (row < len(depth))
            texel = [np.where(inside, axis, 0).astype(int) for axis in (row, column)]
            is_lit = ~inside | (places[:, 2] - bias <= depth[tuple(texel)])
            found += is_lit * abs(1 - right - x) * abs(1 - lower - y)
    return found
