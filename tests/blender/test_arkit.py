"""Face performances: Apply Motion, face sliders, and heads with ARKit's shape keys."""

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Euler
from numpy.testing import assert_allclose

from stga_addon.driving.head_map import head_map
from stga_addon.driving.inverse import write_performance
from stga_addon.driving.performance import ARKIT_SHAPES, COLUMN, Performance
from stga_addon.driving.performers import read_performance
from stga_addon.flame.forward import FlameFrame, flame_forward
from stga_addon.scene.arrays import evaluated_vertices
from stga_addon.scene.rig.head import rig_of
from stga_addon.scene.rig.keyframes import Placement
from stga_addon.scene.rig.motion import apply_motion, sample_pose

from .captures import import_small_head, mesh_at
from .session import failure, ops, panel

pytestmark = [pytest.mark.usefixtures("extension"), pytest.mark.slow]
TOLERANCE_M = 1e-5
RNG = np.random.default_rng(4)


@pytest.fixture
def scene(tmp_path):
    """The small head of another identity with its own motion; a performance of 7 rows, 30 Hz."""
    expr = RNG.normal(0, 0.3, (3, 10))
    own = import_small_head(tmp_path, expr=expr, jaw_pose=np.zeros((3, 3)))
    weights = RNG.random((7, 52)) * (RNG.random((7, 52)) < 0.4)
    weights[0] = 0
    head = RNG.normal(0, 0.2, (7, 3))
    write_performance(tmp_path / "take.csv", Performance(np.arange(7) / 30, weights, head, 30.0))
    bpy.context.scene.render.fps = 30
    given = {"weights": weights, "turns": head, "take": tmp_path / "take.csv"}
    return SimpleNamespace(own=own, map=head_map(own, "demo"), **given)


def posed(scene, weights, turn=None):
    take = Performance(np.zeros(1), weights[None], None if turn is None else turn[None], 30.0)
    return flame_forward(scene.own.model, scene.own.shape, scene.map.frames(take)[0])


def expected(scene, row):
    return posed(scene, scene.weights[row], scene.turns[row])


def test_apply_a_performance(scene):
    """Catches a performance at another rate or place than asked for, or on another identity."""
    assert ops.apply_motion(filepath=scene.take, start=10) == {"FINISHED"}
    for row in (0, 3, 6):
        assert_allclose(mesh_at(10 + row), expected(scene, row), atol=TOLERANCE_M)
    assert bpy.context.scene.frame_end >= 16
    ops.apply_motion(filepath=scene.take, start=10, speed=0.5, place="strip")
    assert_allclose(mesh_at(16), expected(scene, 3), atol=TOLERANCE_M)
    ops.apply_motion(filepath=scene.take, start=10, fps=30)  # timecodes that were taken as 60
    assert_allclose(mesh_at(22), expected(scene, 6), atol=TOLERANCE_M)


def test_sliders(scene):
    """Catches a slider other than the map's, that stops own motion or needs Python."""
    before = [mesh_at(frame) for frame in range(3)]
    assert ops.add_arkit_controls() == {"FINISHED"}
    head = panel().head
    model = scene.own.model
    keys = head.data.shape_keys
    assert set(ARKIT_SHAPES) <= set(keys.key_blocks.keys())
    assert all(driver.driver.is_simple_expression for driver in keys.animation_data.drivers)
    for frame in range(3):
        assert_allclose(mesh_at(frame), before[frame], atol=1e-7)
    zero = np.zeros(3)
    neutral = FlameFrame(np.zeros(10), zero, zero, zero, zero, np.zeros(6))
    apply_motion(head, [neutral], Placement(1, "neutral"))
    bpy.context.scene.frame_set(1)
    keys.animation_data.action = None
    cases = ["mouthSmileLeft"], ["jawOpen", "mouthPucker"], ["jawOpen", "mouthClose"]
    for names in (*cases, ["eyeLookUpLeft"]):
        weights = np.array([float(name in names) for name in ARKIT_SHAPES])
        for name, weight in zip(ARKIT_SHAPES, weights.tolist(), strict=True):
            keys.key_blocks[name].value = weight
        bpy.context.view_layer.update()
        assert_allclose(evaluated_vertices(head), posed(scene, weights), atol=1e-5)
        found = sample_pose(head, model)
        again = flame_forward(model, scene.own.shape, found)
        assert_allclose(again, posed(scene, weights), atol=1e-5)
    bone = rig_of(head).pose.bones["jaw"]
    keys.key_blocks["jawOpen"].value = 0.5
    bone.rotation_quaternion = Euler((0.1, 0, 0)).to_quaternion()
    bpy.context.view_layer.update()
    both = 0.1 + 0.5 * scene.map.jaw[COLUMN["jawOpen"], 0]
    assert sample_pose(head, model).jaw_pose[0] == pytest.approx(both, abs=1e-5)


def test_a_performance_on_sliders(scene):
    """Catches keyframes that add up with the head's own, or stay after another motion."""
    ops.add_arkit_controls()
    keys = panel().head.data.shape_keys.key_blocks
    for start, place in ((10, "action"), (20, "strip")):
        options = {"start": start, "place": place, "sliders": True}
        assert ops.apply_motion(filepath=scene.take, **options) == {"FINISHED"}
        bpy.context.scene.frame_set(start + 3)
        for name in ("jawOpen", "mouthFunnel", "browInnerUp"):
            assert keys[name].value == pytest.approx(scene.weights[3, COLUMN[name]], abs=1e-5)
        assert not any(abs(keys[f"expr_{k:03d}"].value) > 1e-6 for k in range(10))
        found = sample_pose(panel().head, scene.own.model)
        turned = flame_forward(scene.own.model, scene.own.shape, found)
        assert_allclose(turned, expected(scene, 3), atol=1e-5)
    assert ops.apply_motion(filepath=scene.take, start=10) == {"FINISHED"}
    assert_allclose(mesh_at(13), expected(scene, 3), atol=TOLERANCE_M)


def test_curves_come_back_from_an_action(scene, tmp_path):
    """Catches exported curves that do something else than those the action was made of."""
    weights = np.zeros((7, 52))
    names = "jawOpen", "mouthSmileLeft", "browInnerUp", "eyeLookUpLeft", "mouthPucker"
    for column, name in enumerate(names):
        weights[:, COLUMN[name]] = np.linspace(0, 0.3 + 0.1 * column, 7)
    plain = Performance(np.arange(7) / 30, weights, scene.turns, 30.0)
    write_performance(tmp_path / "plain.csv", plain)
    ops.apply_motion(filepath=tmp_path / "plain.csv", start=1)
    bpy.context.scene.frame_start = 1
    bpy.context.scene.frame_end = 7
    assert ops.export_performance(filepath=tmp_path / "back.csv") == {"FINISHED"}
    back = read_performance(tmp_path / "back.csv")
    assert back.fps == pytest.approx(30, rel=1e-3)
    found, wanted = map(scene.map.parameters, (back.weights, weights))
    assert_allclose(found, wanted, atol=0.02)
    assert_allclose(back.head, scene.turns, atol=1e-4)


def test_a_head_with_shape_keys(scene, tmp_path):
    """Catches a head with ARKit's shapes in its own spelling that cannot be driven."""
    from capture.factory import write_mesh_capture

    ops.import_capture(directory=write_mesh_capture(tmp_path / "ball"))
    bpy.context.scene.render.fps = 30
    head = panel().head
    if head.data.shape_keys is None:
        head.shape_key_add(name="Basis")
    for name in ("JawOpen", "mouthSmile_L"):
        head.shape_key_add(name=name, from_mix=False).value = 0
    keys = head.data.shape_keys.key_blocks
    jaw, smile = (scene.weights[3, COLUMN[name]] for name in ("jawOpen", "mouthSmileLeft"))
    gains = {"shape_gains": "jawOpen=0.25, mouthSmileLeft=0", "face_gain": 2.0}
    for options, found in (({"strength": 0.5}, (0.5, 0.5)), (gains, (0.25, 0))):
        done = ops.apply_motion(filepath=scene.take, start=1, **options)
        assert done == {"FINISHED"}
        bpy.context.scene.frame_set(4)
        assert keys["JawOpen"].value == pytest.approx(found[0] * jaw, abs=1e-5)
        assert keys["mouthSmile_L"].value == pytest.approx(found[1] * smile, abs=1e-5)
    with failure("'jawOpne' names none of face, jaw, eyes, head"):
        ops.apply_motion(filepath=scene.take, shape_gains="jawOpne=1")
