"""Irradiance of lights against closed forms and Blender's path tracer, shadows against cast
rays."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from light.scenes import ball_and_plate, blocked
from stga_addon.capture.mesh_geometry import vertex_normals
from stga_addon.light.lamps import LIFT_M, Lamps, ShadowMap, head_bounds, light_view
from stga_addon.light.values import Caster, Light, Lighting

NO_FACES = np.zeros((0, 3), np.int32)
AROUND = np.array([[-0.1, -0.1, -0.1], [0.1, 0.1, 0.1]])
UP = np.array([[0.0, 0.0, 1.0]])
TILTED = Light(
    "area", np.ones(3) * 40, (0.3, 0.2, 0.6), direction=(-0.3, -0.2, -0.6), size=(0.4, 0.3)
)
CASES = {
    "sun": Light("sun", np.ones(3) * 3, direction=(-1, 0, -1)),
    "point": Light("point", np.ones(3) * 100, (0.5, 0.5, 2)),
    "spot": Light(
        "spot", np.ones(3) * 100, (0, 0, 2), direction=(0.25, 0, -1), cone=1.0, blend=0.6
    ),
    "area": TILTED,
    "disk": Light(
        "area", np.ones(3) * 40, (0, 0.2, 0.8), direction=(0, 0, -1), size=(0.5, 0.5),
        shape="ellipse",
    ),
}  # fmt: skip


def irradiance(light: Light) -> float:
    lamps = Lamps(Lighting(lights=(light,)), AROUND, NO_FACES)
    return float(lamps.irradiance(np.zeros((1, 3)), UP)[0, 1])


def test_units_are_blenders():
    """Catches a wrong factor of π, and a cosine or distance that is left out."""
    assert irradiance(CASES["sun"]) == pytest.approx(3 * np.sqrt(0.5), rel=1e-5)
    square = 0.25 + 0.25 + 4
    expected = 100 / (4 * np.pi) / square * 2 / np.sqrt(square)
    assert irradiance(CASES["point"]) == pytest.approx(expected, rel=1e-5)
    small = Light("area", np.ones(3) * 100, (0, 0, 2), size=(0.01, 0.01))
    assert irradiance(small) == pytest.approx(100 / np.pi / 4, rel=1e-4)


PATH_TRACER = """
import json, sys
import bpy, mathutils, numpy as np
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.engine, scene.cycles.samples, scene.cycles.max_bounces = "CYCLES", 256, 0
scene.cycles.use_denoising = False
scene.render.resolution_x = scene.render.resolution_y = 8
scene.view_settings.view_transform, scene.render.image_settings.file_format = "Raw", "OPEN_EXR"
scene.world = bpy.data.worlds.new("w")
scene.world.use_nodes = True
scene.world.node_tree.nodes["Background"].inputs[1].default_value = 0
mesh = bpy.data.meshes.new("plane")
mesh.from_pydata([(-.01, -.01, 0), (.01, -.01, 0), (.01, .01, 0), (-.01, .01, 0)], [],
    [(0, 1, 2, 3)])
scene.collection.objects.link(bpy.data.objects.new("plane", mesh))
material = bpy.data.materials.new("white")
material.use_nodes = True
nodes = material.node_tree.nodes
nodes.clear()
white, out = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
white.inputs[0].default_value = (1, 1, 1, 1)
material.node_tree.links.new(white.outputs[0], out.inputs[0])
mesh.materials.append(material)
camera = bpy.data.cameras.new("c")
camera.type, camera.ortho_scale = "ORTHO", 0.004
scene.camera = bpy.data.objects.new("c", camera)
scene.camera.location = (0, 0, 0.5)
scene.collection.objects.link(scene.camera)
found = {}
for name, values in json.loads(sys.argv[1]).items():
    lamp = bpy.data.lights.new(name, values["kind"].upper())
    for key, value in values["settings"].items():
        setattr(lamp, key, value)
    ob = bpy.data.objects.new(name, lamp)
    scene.collection.objects.link(ob)
    z = -mathutils.Vector(values["direction"]).normalized()
    x = mathutils.Vector(values["tangent"]).normalized()
    ob.matrix_world = mathutils.Matrix((x, z.cross(x), z)).transposed().to_4x4()
    ob.matrix_world.translation = values["position"]
    scene.render.filepath = sys.argv[2]
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(sys.argv[2])
    found[name] = float(np.array(image.pixels[:]).reshape(8, 8, 4)[..., 1].mean() * np.pi)
    bpy.data.images.remove(image)
    bpy.data.objects.remove(ob)
print("FOUND" + json.dumps(found))
"""


def blender_light(light: Light) -> dict:
    across = np.cross(light.direction, (0.0, 1.0, 0.0))
    settings = {"energy": float(light.color[1])}
    if light.kind == "area":
        shape = "ELLIPSE" if light.shape == "ellipse" else "RECTANGLE"
        settings |= {"shape": shape, "size": light.size[0], "size_y": light.size[1]}
    if light.kind == "spot":
        settings |= {"spot_size": light.cone, "spot_blend": light.blend, "shadow_soft_size": 0.0}
    if light.kind == "point":
        settings |= {"shadow_soft_size": 0.0}
    vectors = {"direction": light.direction, "position": light.position, "tangent": across}
    lists = {name: vector.tolist() for name, vector in vectors.items()}
    return {"kind": light.kind, "settings": settings, **lists}


@pytest.mark.nightly
def test_irradiance_is_the_path_tracers(tmp_path):
    """Catches a light whose fall-off, cone or area differs from what Cycles shows, beyond 2 %."""
    pytest.importorskip("bpy")
    wanted = json.dumps({name: blender_light(light) for name, light in CASES.items()})
    command = [sys.executable, "-c", PATH_TRACER, wanted, str(tmp_path / "x.exr")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parent)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.split("FOUND")[1].splitlines()[0])
    for name, light in CASES.items():
        turned = replace(light, tangent=np.cross(light.direction, (0.0, 1.0, 0.0)))
        assert irradiance(turned) == pytest.approx(found[name], rel=0.02), name


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
