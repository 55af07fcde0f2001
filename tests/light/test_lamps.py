"""Irradiance of lights against closed forms, shadows against cast rays, NumPy against Numba."""

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
from stga_addon.raster.cpu import shade, shadow
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
        np.ones(3) * 5,
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
    assert lamps.kernels("shade") is array_kernels
    (tmp_path / "cpu_0").mkdir()
    (tmp_path / "cpu_0/image_loss.image_loss-10.py311.nbi").touch()
    assert lamps.kernels("shade") is shade
    assert lamps.kernels("shadow") is shadow
    monkeypatch.setattr("stga_addon.raster.kernel_cache.find_spec", lambda name: None)
    assert lamps.kernels("shade") is array_kernels


def test_lights():
    """Catches a light that Blender's Python computes otherwise than training's."""
    rng = np.random.default_rng(0)
    points = rng.normal(0, 0.1, (500, 3)).astype(np.float32)
    normals = rng.normal(0, 1, points.shape)
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    rows = [light_rows(light, np.zeros(3), n - 1) for n, light in enumerate(LIGHTS)]
    table = np.concatenate(rows)
    lit = rng.random((3, 500), np.float32)
    roughness = rng.choice(np.float32([0, 0.2, 0.45]), 500)
    rest = np.float32([0.1, 0.2, 0.7]), roughness, np.full(500, 0.04, np.float32), table, lit
    found = [np.zeros((4, 500, 3), np.float32)[:2] for _ in range(2)]
    for arrays, add in zip(found, (shade.add_lights, array_kernels.add_lights), strict=True):
        add(points, normals, *rest, *arrays)
    assert found[0].max() > 0.5
    assert_allclose(found[1], found[0], rtol=2e-3, atol=2e-5)


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
    for step in (0.0, 1.0, 2.0):
        lit = [np.empty(len(places), np.float32) for _ in range(2)]
        for one, kernels in zip(lit, (shadow, array_kernels), strict=True):
            kernels.lit_fractions(depth[0], places, bias, np.float32(step), one)
        assert 0.05 < lit[0].mean() < 0.95
        assert_allclose(lit[1], lit[0], atol=1e-5)
