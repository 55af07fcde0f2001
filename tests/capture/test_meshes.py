"""Tracked meshes: the readers, constant topology, regions and the rigid fit."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from refusal import refusal
from scipy.spatial.transform import Rotation

from stga_addon.capture.camera import look_at
from stga_addon.capture.mesh_geometry import (
    rasterize,
    silhouette,
    weighted_procrustes,
    without_head_motion,
)
from stga_addon.capture.meshes import (
    CACHE_BYTES,
    cached_meshes,
    find_region,
    read_mesh,
    tracked_meshes,
)
from stga_addon.files import write_npz

from . import factory


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb", ".stl"])
def test_order_is_kept(tmp_path, suffix):
    """Catches vertices merged, sorted or dropped, by a mesh with a duplicate and an unused vertex;
    and STL triangles welded by position, which would join lips and eyelids that merely touch."""
    vertices, faces = factory.ball()
    vertices = np.concatenate([vertices[:1], [[1.0, 2.0, 3.0]], vertices])
    faces = faces + 2
    factory.write_mesh(tmp_path / f"mesh{suffix}", vertices, faces)
    read, triangles = read_mesh(tmp_path / f"mesh{suffix}")
    if suffix == ".stl":  # which has no shared vertices
        vertices = vertices[faces].reshape(-1, 3)
        faces = np.arange(faces.size).reshape(-1, 3)
    assert_allclose(read, vertices, atol=1e-7)
    assert_array_equal(triangles, faces)
    assert (read.dtype, triangles.dtype) == (np.float64, np.int32)


def test_obj_dialects(tmp_path):
    """Catches colors, quads, negative indices, line ends and materials that are misread."""
    points = [f"v {i} {i * i} 0 1 0 0" for i in range(5)]
    lines = ["mtllib x.mtl", "o a", *points, "vt 0 0", "vn 0 0 1", "usemtl b", "f 4/1 2/1 1/1"]
    lines += ["usemtl a", "f 1//1 2//1 3//1 4//1", "o b", "f -1 -2\\", " -3", "f 1/1/1 3/1/1 5/1/1"]
    path = tmp_path / "x.obj"
    path.write_bytes("\r\n".join(lines).encode())
    vertices, faces = read_mesh(path)
    assert_array_equal(vertices, [[i, i * i, 0] for i in range(5)])
    assert_array_equal(faces, [[3, 1, 0], [0, 1, 2], [0, 2, 3], [4, 3, 2], [0, 2, 4]])
    three = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\n"
    for before, expected in (("", [0, 1, 2]), ("v 2 0 0\n", [1, 2, 3]), ("", [0, 1, 2])):
        path.write_text(before + three)
        assert_array_equal(read_mesh(path)[1], [expected])


POLYGONS = [(0, 1, 2), (0, 2, 3, 4), (4, 3, 2), (1, 2, 3, 4, 0)]
TRIANGLES = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (4, 3, 2), (1, 2, 3), (1, 3, 4), (1, 4, 0)]
SEAM = [0.1, 0.9] * 5  # Texture coordinates of a vertex differ from polygon to polygon


def ply_of(kind, ending, polygons):
    """A PLY as photogrammetry writes it: a texture's name, an element before the vertices, their
    texture coordinates or colors, triangles mixed with other polygons, and corners' coordinates."""
    lines = ["ply", f"format {kind} 1.0", "comment TextureFile head.png", "obj_info from a scan"]
    lines += ["element camera 1", "property list uchar short view", "element vertex 5"]
    lines += [f"property float {axis}" for axis in "xyz"] + ["property uchar red"]
    lines += [f"element face {len(polygons)}", "property uchar material"]
    lines += ["property list uchar uint vertex_index", "property list uchar float texcoord"]
    head = ending.join([*lines, "end_header", ""]).encode()
    points = [(n, n * n, -n, 7) for n in range(5)]
    if kind == "ascii":
        rows = ["2 5 6", *(" ".join(map(str, row)) for row in points)]
        for n, own in enumerate(polygons):
            seam = SEAM[n : n + 2] * len(own)
            rows.append(" ".join(map(str, [1, len(own), *own, len(seam), *seam])))
        return head + "".join(row + ending for row in rows).encode()
    order = "<" if "little" in kind else ">"
    body = struct.pack(order + "B2h", 2, 5, 6)
    body += b"".join(struct.pack(order + "3fB", *row) for row in points)
    for n, own in enumerate(polygons):
        seam = SEAM[n : n + 2] * len(own)
        body += struct.pack(f"{order}BB{len(own)}I", 1, len(own), *own)
        body += struct.pack(f"{order}B{len(seam)}f", len(seam), *seam)
    return head + body


@pytest.mark.parametrize("kind", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
def test_ply_dialects(tmp_path, capfd, kind, ending):
    """Catches triangles mixed with quads refused, as Blender writes them; vertices split where
    texture coordinates differ, which regions then do not name; and a library's traceback about a
    texture."""
    path = tmp_path / "a.ply"
    for polygons, triangles in ((POLYGONS, TRIANGLES), (TRIANGLES, TRIANGLES)):
        path.write_bytes(ply_of(kind, ending, polygons))
        vertices, faces = read_mesh(path)
        assert_array_equal(vertices, [[n, n * n, -n] for n in range(5)])
        assert_array_equal(faces, triangles)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb", ".stl"])
@pytest.mark.parametrize("kept", [0.0, 0.5, 0.99])
def test_truncated_mesh(tmp_path, suffix, kept):
    """Catches a download that broke off: trimesh itself reads half an STL as an empty mesh."""
    path = tmp_path / f"x{suffix}"
    factory.write_mesh(path, *factory.ball())
    data = path.read_bytes()
    # An OBJ cut at the end of a line is a valid mesh; cut inside of a face it is not.
    end = data.rindex(b"\nf ") + 4 if suffix == ".obj" and kept else int(len(data) * kept)
    path.write_bytes(data[:end])
    with refusal(rf"x\{suffix}: "):
        read_mesh(path)


def test_missing_and_unknown_meshes(tmp_path):
    """Catches a missing file or a foreign format ending in a traceback."""
    with refusal(r"none\.ply: cannot be read"):
        read_mesh(tmp_path / "none.ply")
    with refusal(r"x\.fbx: is not a mesh; expected one of \.obj"):
        read_mesh(tmp_path / "x.fbx")


def test_topology_must_not_change(tmp_path):
    """Catches splats bound to triangles that are other ones in a later frame; the error names the
    file."""
    vertices, faces = factory.ball()
    swapped = faces.copy()
    swapped[[7, 8]] = swapped[[8, 7]]
    files = {number: tmp_path / f"{number}.obj" for number in range(4)}
    more = np.vstack([vertices, [0, 0, 0]])
    for path, triangles in zip(files.values(), (faces, faces[:-1], swapped, faces), strict=True):
        factory.write_mesh(path, more if path == files[3] else vertices, triangles)
    canonical = tmp_path / "neutral.obj"
    mesh = tracked_meshes(files, len(vertices), faces.astype(np.int32), canonical, read_mesh)
    assert_allclose(mesh(0), vertices, atol=1e-9)
    for timestep, message in (
        (1, r"1\.obj: has 319 triangles, but .*neutral\.obj has 320"),
        (2, r"2\.obj: triangle 7 joins vertices"),
        (3, r"3\.obj: has 163 vertices, but .*neutral\.obj has 162"),
        (9, "timestep 9 has no tracked mesh; the capture has 0 to 3"),
    ):
        with refusal(message):
            mesh(timestep)


def test_meshes_are_kept_within_bounds():
    """Catches a mesh parsed again at each visit, a cache that grows with the sequence, or a shared
    array changed."""
    calls = []

    def read(timestep):
        calls.append(timestep)
        return np.full((4, 3), float(timestep))

    vertices = CACHE_BYTES // 24 // 3  # three fit
    mesh = cached_meshes(read, vertices)
    assert [mesh(t)[0, 0] for t in (0, 1, 2, 0, 1, 2)] == [0, 1, 2, 0, 1, 2]
    assert calls == [0, 1, 2]
    mesh(3)
    mesh(0)
    assert calls == [0, 1, 2, 3, 0]
    with pytest.raises(ValueError, match="read-only"):
        mesh(0)[0] = 1


def test_procrustes_as_scipy_has_it():
    """Catches a reflection, a transposed rotation or ignored weights, against scipy's
    align_vectors."""
    random = default_rng(1)
    (source, target) = random.normal(size=(2, 30, 3))
    weights = random.random(30)
    rotation, translation = weighted_procrustes(source, target, weights)
    a = np.average(source, 0, weights)
    b = np.average(target, 0, weights)
    expected, _ = Rotation.align_vectors(target - b, source - a, weights)
    assert_allclose(rotation, expected.as_matrix(), atol=1e-9)
    assert_allclose(rotation @ a + translation, b, atol=1e-12)


def test_moving_jaw_does_not_drag_the_head():
    """Catches least squares, which tilt the skull by the jaw, and 0/0 of no residual."""
    neutral = default_rng(2).normal(size=(2000, 3)) * 0.08
    jaw = neutral[:, 1] < np.quantile(neutral[:, 1], 0.4)
    opened = neutral - np.where(jaw[:, None], [[0.0, 0.02, 0.005]], 0.0)
    for turn, moved, atol in (([0.3, -0.5, 0.1], opened, 1e-5), ([0, np.pi, 0], neutral, 1e-9)):
        rotation = Rotation.from_rotvec(turn).as_matrix()
        fitted = without_head_motion(moved @ rotation.T + [0.1, 0.2, -0.3], neutral)
        assert_allclose(fitted, moved, atol=atol)
    assert_allclose(without_head_motion(neutral, neutral), neutral, atol=1e-12)
    plain = weighted_procrustes(opened, neutral, np.ones(len(neutral)))
    assert np.abs(opened @ plain[0].T + plain[1] - opened).max() > 1e-3


def test_names_and_files(toy, tmp_path):
    """Catches a region of other triangles than those painted, weights of another mesh taken for
    this one's, and a refinement that would train nothing and say so nowhere."""
    assert_array_equal(find_region(toy, "mouth"), toy.regions["mouth"])
    path = tmp_path / "painted.npz"
    weights = np.linspace(0, 1, len(toy.faces))
    write_npz(path, {"weights": weights})
    assert_array_equal(find_region(toy, str(path)), weights >= 0.5)
    triangle = toy.faces[7]
    (tmp_path / "regions.json").write_text(json.dumps({"one": triangle.tolist()}))
    found = find_region(toy, str(tmp_path / "regions.json"))
    assert found[7]
    assert_array_equal(found, np.isin(toy.faces, triangle).all(1))
    for arrays, sentence in (
        ({"weights": np.ones(3, np.float32)}, r"one number from 0 to 1 .* found float32 \(3,\)"),
        ({"weights": np.ones(3, np.int64)}, "expected 'weights', .*found int64"),
        ({"other": np.ones(2)}, "found no such array"),
        ({"weights": np.zeros(len(toy.faces))}, "holds no triangle"),
    ):
        write_npz(path, arrays)
        with refusal(sentence):
            find_region(toy, str(path))


def by_equations(vertices, faces, camera):
    """Like `rasterize`: the barycentric coordinates of each pixel center in each triangle, solved
    for."""
    flat, depth = camera.project(vertices)
    y, x = np.mgrid[: camera.height, : camera.width]
    centers = np.stack([x.ravel() + 0.5, y.ravel() + 0.5, np.ones(x.size)])
    systems = np.concatenate([flat[faces], np.ones((len(faces), 3, 1))], 2).transpose(0, 2, 1)
    centers = np.broadcast_to(centers, (len(faces), *centers.shape))
    inside = np.linalg.solve(systems, centers).transpose(2, 0, 1)
    closeness = np.where((inside >= 0).all(2), (inside / depth[faces]).sum(2), 0)
    nearest = closeness.argmax(1)
    shown = closeness.max(1) > 0
    shape = camera.height, camera.width
    weights = np.where(shown[:, None], inside[np.arange(len(nearest)), nearest], 0)
    return np.where(shown, nearest, -1).reshape(shape), weights.reshape(*shape, 3)


def test_every_pixel_shows_the_nearest_triangle():
    """Catches a triangle that is farther, a gap between neighbors, lines cut off at the image's
    edge, barycentric coordinates of another corner, and a silhouette of other pixels; triangles are
    from a tenth of a pixel to larger than the image."""
    rng = default_rng(0)
    camera = replace(look_at((0.2, 0.1, 2.0), (0, 0, 0), 37, 29, 40.0), cx=17.0, cy=15.5)
    sizes = np.repeat([0.005, 0.05, 0.3, 3.0], [150, 60, 30, 8])
    centers = rng.uniform(-0.7, 0.7, (len(sizes), 1, 3))
    shapes = rng.normal(size=(len(sizes), 3, 3))
    corners = centers + sizes[:, None, None] * shapes
    vertices = corners.reshape(-1, 3)
    faces = np.arange(3 * len(sizes)).reshape(-1, 3)
    in_front = (camera.project(vertices)[1][faces] > 0.05).all(1)
    triangle, weights = rasterize(vertices, faces[in_front], camera)
    expected, expected_weights = by_equations(vertices, faces[in_front], camera)
    assert (expected >= 0).mean() > 0.4
    assert_array_equal(triangle, expected)
    assert_allclose(weights, expected_weights, atol=1e-7)
    assert_array_equal(silhouette(vertices, faces[in_front], camera), expected >= 0)


def test_a_closed_mesh_has_no_holes():
    """Catches pixels between two triangles whose centers lie on the common edge."""
    mesh = trimesh.creation.icosphere(subdivisions=4)
    for turn in np.linspace(0, 1, 7):
        camera = look_at((3 * np.sin(turn), 0, 3 * np.cos(turn)), (0, 0, 0), 64, 64, 64.0)
        shown = rasterize(mesh.vertices, mesh.faces, camera)[0] >= 0
        y, x = np.mgrid[:64, :64] + 0.5 - 32
        assert shown[np.hypot(x, y) < 22].all()
        assert not shown[np.hypot(x, y) > 23].any()
