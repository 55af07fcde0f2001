"""Export of all that shows splats in a scene, read back by Blender 5.3 and by others."""

import os
from dataclasses import replace
from typing import NamedTuple

import bpy
import numpy as np
import pytest
import trimesh
from avatar.conftest import random_splats, world_splats
from mathutils import Matrix
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from stga_addon.avatar.file import write_avatar
from stga_addon.avatar.splats import harmonics
from stga_addon.capture.open import open_capture
from stga_addon.export.ply import read_ply, write_ply
from stga_addon.scene import compat
from stga_addon.scene.display.node_builder import Nodes, new_socket, new_tree
from stga_addon.scene.display.splat_attributes import read_attribute

from .session import failure, ops, panel, placed
from .test_operators import expected_world, show_ball, write_ball_avatar

needs_native = pytest.mark.skipif(
    not compat.NATIVE_SPLATS, reason="Blender before 5.3 has no native splats"
)
TURN = Rotation.from_euler("xyz", (0.4, -1.1, 2.0)).as_matrix()
PLACES = {
    "plain": np.eye(3),
    "scaled": 2 * TURN,
    "mirrored": 0.5 * TURN @ np.diag([1, 1, -1]),
    "sheared": TURN @ [[1, 0.5, 0], [0, 2, 0], [0, 0, 0.5]],
}
IMPORTS = {
    "a.ply": ("ply", lambda: bpy.ops.wm.ply_import),
    "a.spz": ("spz", lambda: bpy.ops.wm.spz_import),
    "a.glb": ("gltf", lambda: bpy.ops.import_scene.gltf),
    "a.usdc": ("usd", lambda: bpy.ops.wm.usd_import),
}
DIRECTIONS = default_rng(5).normal(size=(20, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


class Seen(NamedTuple):
    """Of splats where their object stands: position (N, 3), covariance (N, 3, 3), color in
    DIRECTIONS (N, 20, 3), opacity (N,)."""

    xyz: np.ndarray
    covariance: np.ndarray
    color: np.ndarray
    opacity: np.ndarray

    def check(self, expected, is_coarse=False):
        """Whether they are those expected, in float32, or in SPZ's bits."""
        within = 0.07 if is_coarse else 0
        assert_allclose(self.xyz, expected.xyz, atol=2e-6 + within / 1000)
        size = np.abs(expected.covariance).max((1, 2), keepdims=True)
        relative = [each.covariance / size for each in (self, expected)]
        assert_allclose(*relative, atol=1e-5 + 2 * within)
        assert_allclose(self.color, expected.color, atol=1e-5 + within)
        assert_allclose(self.opacity, expected.opacity, atol=2e-6 + within / 20)


def seen(splats, linear, move=(0, 0, 0)):
    turn = Rotation.from_quat(splats.rotation[:, [1, 2, 3, 0]]).as_matrix()
    axes = linear @ (turn * np.exp(splats.log_scale)[:, None])
    left, _, right = np.linalg.svd(linear)
    terms = harmonics(*(DIRECTIONS @ (left @ right)).T)[: splats.sh.shape[1]]
    basis = np.stack([np.broadcast_to(term, 20) for term in terms])
    return Seen(
        splats.xyz @ linear.T + move,
        axes @ axes.transpose(0, 2, 1),
        np.einsum("kd,nkc->ndc", basis, splats.sh),
        1 / (1 + np.exp(-splats.opacity)),
    )


def imported():
    """What the only native splats in the scene are, as Blender evaluates them."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    found = []
    for instance in depsgraph.object_instances:
        if instance.object.type == "POINTCLOUD":
            cloud = instance.object.data
            assert cloud.type == "GAUSSIAN_SPLAT"
            base = read_attribute(cloud, "radiance:base")
            rest = [read_attribute(cloud, f"radiance:sh_{n}") for n in range(15)]
            splats = world_splats(
                read_attribute(cloud, "position"),
                read_attribute(cloud, "rotation"),
                np.log(read_attribute(cloud, "scale")),
                base[:, 3].astype(np.float64),
                np.stack([base[:, :3], *rest], 1),
            )
            matrix = np.array(instance.matrix_world)
            found.append(seen(splats, matrix[:3, :3], matrix[:3, 3]))
    (only,) = found
    return only


def some_splats(degree=3):
    """Within what SPZ keeps: sizes of centimeters, coefficients below 1 however they turn."""
    rng = default_rng(3)
    splats = random_splats(1, 300, 1)
    size = rng.normal(-3, 0.5, (300, 3))
    sh = rng.uniform(-0.35, 0.35, (300, (degree + 1) ** 2, 3))
    return world_splats(splats.xyz, splats.rotation, size, splats.opacities(), sh)


def place(thing, linear):
    """By a parent, without which nothing shears."""
    thing.parent = placed("parent", None)
    thing.matrix_parent_inverse = Matrix(linear.tolist()).to_4x4()


def native_cloud(folder, splats):
    write_ply(folder / "given.ply", splats)
    bpy.ops.wm.ply_import(filepath=str(folder / "given.ply"))
    return bpy.context.object


def instanced(collection):
    empty = placed("instance", None)
    empty.instance_type = "COLLECTION"
    empty.instance_collection = collection
    return empty


def instanced_by_nodes(thing, place):
    mesh = bpy.data.meshes.new("points")
    mesh.from_pydata([place], [], [])
    points = placed("points", mesh)
    tree = points.modifiers.new("points", "NODES").node_group = new_tree("points")
    new_socket(tree, "Geometry", "INPUT", "Geometry")
    new_socket(tree, "Geometry", "OUTPUT", "Geometry")
    nodes = Nodes(tree)
    instance = nodes.object_info(thing, "ORIGINAL")
    instance.inputs["As Instance"].default_value = True
    given = nodes.add("NodeGroupInput").outputs["Geometry"]
    inputs = {"Points": given, "Instance": instance.outputs["Geometry"]}
    made = nodes.out("GeometryNodeInstanceOnPoints", inputs)
    nodes.finish("NodeGroupOutput", {"Geometry": made})


@needs_native
@pytest.mark.parametrize("standing", PLACES)
@pytest.mark.parametrize("name", IMPORTS)
def test_blender_reads_what_it_exports(extension, tmp_path, name, standing):
    """Catches other axes than the importer's, splats and colors that do not turn, scale, shear or
    mirror with their object, and activations that are not those of the format."""
    splats = some_splats()
    linear = PLACES[standing]
    place(native_cloud(tmp_path, splats), linear)
    format, importer = IMPORTS[name]
    ops.export_splats(filepath=tmp_path / name, format=format)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    importer()(filepath=str(tmp_path / name))
    if standing == "sheared" and name == "a.spz":  # whose scales have steps of 6 %
        assert_allclose(imported().xyz, seen(splats, linear).xyz, atol=1e-4)
    else:
        imported().check(seen(splats, linear), is_coarse=name == "a.spz")
    if name in ("a.ply", "a.glb"):
        (read,) = trimesh.load_scene(tmp_path / name).geometry.values()
        turned = read.vertices if name == "a.ply" else read.vertices[:, [0, 2, 1]] * [1, -1, 1]
        assert_allclose(turned, seen(splats, linear).xyz, atol=2e-6)


@needs_native
def test_instances_and_frames_of_others_are_exported(extension, tmp_path):
    """Catches splats of instanced collections and of geometry nodes that are left out, hidden ones
    that are not, degrees of harmonics mixed up, the axes of a PLY, and an animation that is
    exported as it is now."""
    usd = pytest.importorskip("pxr.Usd", reason="the package usd-core is not installed")
    first = native_cloud(tmp_path, some_splats(0))
    hidden = native_cloud(tmp_path, some_splats(1))
    hidden.hide_render = True
    prop = native_cloud(tmp_path, some_splats(2))
    collection = bpy.data.collections.new("props")
    collection.objects.link(prop)
    bpy.context.scene.collection.objects.unlink(prop)
    place(instanced(collection), PLACES["mirrored"])
    instanced_by_nodes(prop, (0, 0, 7))
    scene = bpy.context.scene
    scene.frame_start = 2
    scene.frame_end = 5
    for frame, x in ((3, 0.0), (5, 2.0)):
        first.location.x = x
        first.keyframe_insert("location", frame=frame)
    scene.frame_set(4)
    many = tmp_path / "many"
    ops.export_splats(filepath=many, format="ply-sequence", up="Y")
    ops.export_splats(filepath=tmp_path / "one.ply", format="ply")
    assert scene.frame_current == 4
    files = sorted(path.name for path in many.glob("*.ply"))
    assert files == [f"{frame:05d}.ply" for frame in (2, 3, 4, 5)]
    one = read_ply(tmp_path / "one.ply")
    assert (len(one), one.sh_degree) == (900, 3)
    turned = read_ply(many / "00004.ply")
    assert_array_equal(turned.xyz, one.xyz[:, [0, 2, 1]] * [1, 1, -1])
    expected = (
        seen(some_splats(0), np.eye(3), first.matrix_world.translation),
        seen(some_splats(2), PLACES["mirrored"]),
        seen(some_splats(2), np.eye(3), (0, 0, 7)),
    )
    for index, part in enumerate(expected):
        found = one.rows(np.arange(300 * index, 300 * index + 300))
        seen(found, np.eye(3)).check(part)
    ops.export_splats(filepath=tmp_path / "a.usdc", format="usd")
    stage = usd.Stage.Open(str(tmp_path / "a.usdc"))
    prim = stage.GetPrimAtPath("/Avatar/Splats")
    positions = prim.GetAttribute("positions")
    assert positions.GetTimeSamples() == [2, 3, 4, 5]
    for frame in (2, 3, 4, 5):
        expected = read_ply(many / f"{frame:05d}.ply").xyz
        assert_array_equal(positions.Get(frame), expected)
    assert prim.GetAttribute("scales").GetTimeSamples() == [2]


@pytest.mark.parametrize("display", ["As Trained", "Points", "Native Splats"])
def test_avatars_are_exported_as_they_are_posed(extension, head, tmp_path, display):
    """Catches an export without what only this add-on shows, twice what Blender shows too,
    another frame, size or place, and colors for linear light in another file than USD's."""
    if display == "Native Splats" and not compat.NATIVE_SPLATS:
        pytest.skip("Blender before 5.3 has no native splats")
    avatar = write_ball_avatar(tmp_path / "avatar.npz")
    sh = default_rng(0).normal(0, 0.3, avatar.splats.sh.shape).astype(np.float32)
    avatar = replace(avatar, splats=replace(avatar.splats, sh=sh))
    write_avatar(tmp_path / "avatar.npz", avatar)
    ops.show_avatar(filepath=tmp_path / "avatar.npz")
    capture = open_capture(tmp_path / "capture")
    bpy.context.scene.frame_set(3)
    splats = panel().splats
    ops.choose_display(display=display)
    extension.stga_addon.scene.display.splat_object.set_input(splats, "Size", 1.5)
    ops.export_splats(filepath=tmp_path / "a.ply", format="ply", up="Y")
    expected = expected_world(avatar, capture.mesh(3))
    found = read_ply(tmp_path / "a.ply")
    assert_allclose(found.xyz, expected.xyz, atol=1e-5)
    assert_allclose(found.log_scale, expected.log_scale + np.log(1.5), atol=1e-3)
    assert_allclose(found.sh[:, : expected.sh.shape[1]], expected.sh, atol=1e-4)
    assert_allclose(found.opacity, expected.opacity, atol=1e-3)
    base = np.column_stack([avatar.splats.sh[:, 0] * 0.5, avatar.splats.opacity - 1])
    fitted = replace(avatar, linear_base=base.astype(np.float32))
    extension.stga_addon.scene.display.splat_object.store_linear_base(splats, fitted)
    ops.export_splats(filepath=tmp_path / "b.ply", format="ply", up="Y")
    assert_array_equal(read_ply(tmp_path / "b.ply").sh, found.sh)
    splats.hide_render = True
    with failure("shows no splats in frame 3"):
        ops.export_splats(filepath=tmp_path / "c.ply", format="ply")
    assert not (tmp_path / "c.ply").exists()
    usd = pytest.importorskip("pxr.Usd", reason="the package usd-core is not installed")
    splats.hide_render = False
    bpy.context.scene.frame_start = bpy.context.scene.frame_end = 3
    ops.export_splats(filepath=tmp_path / "a.usdc", format="usd")
    stage = usd.Stage.Open(str(tmp_path / "a.usdc"))
    opacity = stage.GetPrimAtPath("/Avatar/Splats").GetAttribute("opacities").Get(3)
    assert_allclose(opacity, 1 / (1 + np.exp(1 - expected.opacity)), atol=1e-5)


UNWRITABLE = {
    "no ending": ("a", "ply", ""),
    "another ending": ("a.v2", "gltf", r"a\.v2: expected a name that ends in \.glb"),
    "a folder": ("there/", "ply", "there: is a folder; expected the name of a file"),
    "no path": ("", "ply", "export: no path given"),
    "below a file": ("file/a.ply", "ply", "file/a.ply: cannot be written"),
    "frames below a file": ("file/frames", "ply-sequence", "file/frames: cannot be written"),
    "no folder of the system": ("/proc/a.ply", "ply", "/proc/a.ply: cannot be written"),
    "no UTF-8": (os.fsdecode(b"caf\xe9/a.ply"), "ply", "not UTF-8; rename it"),
    "frames where files are": ("file", "ply-sequence", "file: cannot be written"),
}


@pytest.mark.parametrize("case", UNWRITABLE)
def test_what_cannot_be_written_is_one_sentence(extension, tmp_path, case):
    """Catches tracebacks, and files beside the folder that was named."""
    name, format, sentence = UNWRITABLE[case]
    extension.stga_addon.scene.display.splat_object.show_world_splats(some_splats(), "room")
    (tmp_path / "there").mkdir()
    (tmp_path / "file").write_text("")
    place = f"{tmp_path / name}/" if name.endswith("/") else str(tmp_path / name)

    def export():
        ops.export_splats(filepath=place if name else "", format=format)

    if not sentence:
        export()
        assert (tmp_path / "a.ply").is_file()
        return
    with failure(sentence) as error:
        export()
    assert "Traceback" not in str(error.value)
    assert len(str(error.value).strip().splitlines()) == 1
    assert {each.name for each in tmp_path.iterdir()} == {"there", "file"}


@needs_native
def test_modifiers_after_ours_count(extension, head, tmp_path):
    """Catches an avatar that is exported without what other modifiers make of its native splats,
    or twice, and no sentence where it is not shown as native splats."""
    show_ball(tmp_path / "avatar.npz")
    splats = panel().splats
    ops.choose_display(display="Native Splats")
    ops.export_splats(filepath=tmp_path / "a.ply", format="ply")
    plain = read_ply(tmp_path / "a.ply")
    tree = splats.modifiers.new("move", "NODES").node_group = new_tree("move")
    del tree["stga_version"]
    new_socket(tree, "Geometry", "INPUT", "Geometry")
    new_socket(tree, "Geometry", "OUTPUT", "Geometry")
    nodes = Nodes(tree)
    given = nodes.add("NodeGroupInput").outputs["Geometry"]
    moved = nodes.out("GeometryNodeSetPosition", {"Geometry": given, "Offset": (1, 2, 3)})
    nodes.finish("NodeGroupOutput", {"Geometry": moved})
    ops.export_splats(filepath=tmp_path / "b.ply", format="ply")
    found = read_ply(tmp_path / "b.ply")
    offset = np.array(splats.matrix_world)[:3, :3] @ (1, 2, 3)
    assert_allclose(found.xyz, plain.xyz + offset, atol=1e-5)
    assert_allclose(found.sh[:, : plain.sh.shape[1]], plain.sh, atol=1e-4)
    ops.choose_display(display="As Trained")
    ops.export_splats(filepath=tmp_path / "c.ply", format="ply")
    assert_array_equal(read_ply(tmp_path / "c.ply").xyz, plain.xyz)
    message = bpy.context.window_manager.stga_message
    sentence = "exported without move; Native Splats are exported with it"
    assert message == f"{splats.name}: {sentence}"
