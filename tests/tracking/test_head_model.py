"""Head models from GLB files, against trimesh, Blender's exporter and the model that they were made
from."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from flame.small_head import small_head, write_flame
from numpy.testing import assert_allclose, assert_array_equal
from refusal import refusal

from stga_addon.tracking.head_model import read_head_model, shape_arrays, write_linear_model

MESH = small_head(0)
SHAPES = MESH.shapedirs[:, :, [0, 1, -1, -2, -3]]
NAMES = ("identity 0", "identity 1", "jawOpen", "smile", "brow")


def glb(document, data):
    """Bytes of a GLB."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data))
    chunks = (b"JSON", text), (b"BIN\0", data)
    return head + b"".join(struct.pack("<I4s", len(own), kind) + own for kind, own in chunks)


def morphed(corners, moved, **changes):
    """Triangles (3 F, 3) with one morph target, and what is changed of the document."""
    data = corners.astype("<f4").tobytes() + moved.astype("<f4").tobytes()
    half = len(data) // 2
    views = [{"buffer": 0, "byteOffset": half * k, "byteLength": half} for k in range(2)]
    accessors = [
        {"bufferView": k, "componentType": 5126, "count": len(corners), "type": "VEC3"}
        for k in range(2)
    ]
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "targets": [{"POSITION": 1}]}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    return glb(document | changes, data)


def simple(**changes):
    return morphed(np.eye(3), 0.1 * np.ones((3, 3)), **changes)


def blender_head(mesh, faces, names, shapes):
    """A mesh object with shape keys, in Blender's axes, of a model with y up."""
    bpy = pytest.importorskip("bpy", reason="bpy is not installed")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    every = mesh, *(mesh + shape for shape in np.moveaxis(shapes, 2, 0))
    turned = [array[:, [0, 2, 1]] * [1, -1, 1] for array in every]
    data = bpy.data.meshes.new("Head")
    data.from_pydata(turned[0].tolist(), [], faces.tolist())
    head = bpy.data.objects.new("Head", data)
    bpy.context.scene.collection.objects.link(head)
    bpy.context.view_layer.objects.active = head
    for name, points in zip(("Basis", *names), turned, strict=True):
        key = head.shape_key_add(name=name, from_mix=False)
        key.data.foreach_set("co", points.astype(np.float32).ravel())
    return head


def export(path, **options):
    import bpy

    bpy.ops.export_scene.gltf(filepath=str(path), export_format="GLB", export_morph=True, **options)


def assert_same_surface(found, mean, faces, shapes, tolerance=2e-6):
    """The same triangles with the same displacements, in whatever order the vertices are."""
    from scipy.spatial import cKDTree

    # (F, 3, 1 + K) at the centers
    expected = np.concatenate([mean[..., None], shapes], axis=2)[faces].mean(1)
    there = np.concatenate([found.v_template[..., None], found.shapedirs], axis=2)
    there = there[found.faces].mean(1)
    distance, row = cKDTree(there[..., 0]).query(expected[..., 0])
    assert len(there) == len(expected) == len(set(row.tolist()))
    assert distance.max() < 2 * tolerance
    assert_allclose(there[row], expected, atol=tolerance)


@pytest.mark.parametrize("sparse", [False, True], ids=["dense", "sparse"])
def test_a_glb_that_blender_exports(tmp_path, sparse):
    """Catches wrong axes, units or sparse accessors, vertices that stay split at the seams of
    normals, and a scene whose nodes are placed otherwise than another reader places them."""
    trimesh = pytest.importorskip("trimesh")
    head = blender_head(MESH.v_template, MESH.faces, NAMES, SHAPES)
    head.scale = (10, 10, 10)  # the exporter writes it as the node's transform
    head.data.transform(__import__("mathutils").Matrix.Scale(0.1, 4), shape_keys=True)
    for polygon in head.data.polygons:
        polygon.use_smooth = False
    export(tmp_path / "head.glb", export_try_sparse_sk=sparse, export_try_omit_sparse_sk=False)
    found = read_head_model(tmp_path / "head.glb")
    assert found.layout == "mesh"
    assert (found.model.n_identity, found.model.n_expression) == (2, 3)
    assert len(found.model.v_template) == len(np.unique(MESH.faces))
    assert len(found.model.faces) == len(MESH.faces)
    assert_same_surface(found.model, MESH.v_template, MESH.faces, SHAPES)
    head.rotation_euler = (0.3, -0.2, 0.5)
    export(tmp_path / "head.glb")
    theirs = trimesh.load(tmp_path / "head.glb", process=False).to_geometry().vertices
    ours = read_head_model(tmp_path / "head.glb").model.v_template
    for one, other in ((ours.min(0), theirs.min(0)), (ours.max(0), theirs.max(0))):
        assert_allclose(one, other, atol=1e-6)


@pytest.mark.slow
def test_a_real_head_with_57_expressions(shared_data, tmp_path):
    """Catches limits that a model of real size exceeds: ICT-FaceKit's, through Blender's exporter
    and back."""
    ict = np.load(shared_data / "ict_facekit_light.npz")
    mean = 0.01 * ict["neutral"]
    shapes = 0.01 * np.moveaxis(ict["expr"], 0, 2)
    blender_head(mean, ict["tris"], ict["expr_names"].tolist(), shapes)
    export(tmp_path / "head.glb", export_normals=False)  # which take the longest
    found = read_head_model(tmp_path / "head.glb").model
    assert (found.n_identity, found.n_expression) == (0, 57)
    assert_same_surface(found, mean.astype(float), ict["tris"], shapes.astype(float), 1e-5)


def test_seams_are_merged_and_kept_where_a_target_parts_them(tmp_path):
    """Catches lips that are glued where they touch."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [1, 0, 0], [0, -1, 0]])
    moved = np.zeros((6, 3))
    moved[3:, 1] = [0, -0.1, -0.1]
    (tmp_path / "a.glb").write_bytes(morphed(corners, moved))
    found = read_head_model(tmp_path / "a.glb").model
    assert len(found.v_template) == 5  # the first corner is one, the second parts
    assert found.faces.tolist() == [[0, 1, 2], [0, 3, 4]]


def test_shape_keys_become_a_linear_model(tmp_path):
    """Catches shape keys in Blender's axes or object space, and those relative to others, in the
    model's file."""
    pytest.importorskip("bpy", reason="bpy is not installed")
    from stga_addon.scene.rig.head import shape_key_model

    head = blender_head(MESH.v_template, MESH.faces, NAMES, SHAPES)
    head.location = (0, 0, 0.3)
    blocks = head.data.shape_keys.key_blocks
    added = blocks["jawOpen"].data
    offsets = np.empty(3 * len(added))
    added.foreach_get("co", offsets)
    both = head.shape_key_add(name="both", from_mix=False)
    both.data.foreach_set("co", offsets)
    both.relative_key = blocks["jawOpen"]  # so that it moves nothing by itself
    __import__("bpy").context.view_layer.update()
    write_linear_model(tmp_path / "head.npz", shape_arrays(*shape_key_model(head)))
    found = read_head_model(tmp_path / "head.npz").model
    assert_allclose(found.v_template, MESH.v_template + np.array([0, 0.3, 0]), atol=1e-6)
    assert_array_equal(found.faces, MESH.faces)
    assert (found.n_identity, found.n_expression) == (2, 4)
    assert_allclose(found.shapedirs[:, :, :5], SHAPES, atol=1e-6)
    assert_allclose(found.shapedirs[:, :, 5], 0, atol=1e-6)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_flame_model_of_huge_numbers(tmp_path):
    """Catches an overflow in the fit for numbers that no head has."""
    write_flame(replace(MESH, shapedirs=1e300 * MESH.shapedirs), tmp_path / "head.npz")
    with refusal(r"head.npz: shapedirs reaches .*, expected at most 100"):
        read_head_model(tmp_path / "head.npz")
