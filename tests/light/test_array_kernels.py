"""NumPy's kernels against Numba's."""

import subprocess
import sys

import numpy as np
import pytest

from stga_addon.light import array_kernels
from stga_addon.light.lamps import head_bounds, light_rows, light_view
from stga_addon.light.values import Light
from stga_addon.raster.cpu import shade, shadow

from .scenes import ball_and_plate

LIGHTS = (
    Light("sun", np.array([1.0, 2.0, 3.0]), direction=(-0.3, -1, 0.1), angle=0.1),
    Light("point", np.ones(3), (0.3, 0.8, 0.2), radius=0.1, specular=0.5),
    Light(
        "spot", np.ones(3) * 5, (0.0, 0.9, 0.2), direction=(0.1, -1, 0), cone=0.3, blend=0.5,
        casts_shadow=False,
    ),
    Light(
        "area", np.ones(3), (0.5, 0.5, 0.2), direction=(-1, -1, 0), size=(0.3, 0.4),
        shape="ellipse", diffuse=0.7,
    ),
)  # fmt: skip


def test_a_light_loads_no_numba():
    """Catches seconds of compiling at the first light in Blender, whose window stands still."""
    script = (
        "import sys, numpy as np\n"
        "from stga_addon.light.lamps import Lamps\n"
        "from stga_addon.light.values import Light, Lighting\n"
        "sun = Light('sun', np.ones(3), direction=(0.0, 0.0, -1.0))\n"
        "mesh, faces = np.eye(3), np.array([[0, 1, 2]], np.int32)\n"
        "lamps = Lamps(Lighting(np.zeros((9, 3)), (sun,)), mesh, faces)\n"
        "assert lamps.irradiance(mesh, np.eye(3)).any()\n"
        "assert 'numba' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_lights():
    """Catches a kind of light, highlight, cone or shadow that Blender's Python computes otherwise
    than training's."""
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
    np.testing.assert_allclose(found[1], found[0], rtol=2e-3, atol=2e-5)


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
    for step in (0.0, 2.0):
        lit = [np.empty(len(places), np.float32) for _ in range(2)]
        for one, kernels in zip(lit, (shadow, array_kernels), strict=True):
            kernels.lit_shares(depth[0], places, bias, np.float32(step), one)
        assert 0.05 < lit[0].mean() < 0.95
        np.testing.assert_allclose(lit[1], lit[0], atol=1e-5)
