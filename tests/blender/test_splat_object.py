"""Splat objects against the numpy embedding, on a head that shape keys animate."""

from dataclasses import replace
from itertools import combinations

import bpy
import mathutils
import numpy as np
import pytest
from avatar.conftest import splats_of
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from refusal import refusal

from stga_addon.avatar.embedding import CONVENTIONS, face_areas, to_world
from stga_addon.avatar.file import Avatar
from stga_addon.avatar.offsets import COLOR, OFFSETS, POSITION, SCALE
from stga_addon.avatar.splats import SH_C0
from stga_addon.avatar.strain import at_rest, edge_neighbors
from stga_addon.development.demo.in_blender import evaluated_splats
from stga_addon.scene import compat, tags
from stga_addon.scene.arrays import evaluated_vertices
from stga_addon.scene.display import splat_nodes
from stga_addon.scene.display.node_builder import find_tree
from stga_addon.scene.display.splat_attributes import (
    DISPLAY_COLOR,
    RELIT_COLOR,
    avatar_attributes,
    read_attribute,
    write_attributes,
)
from stga_addon.scene.display.splat_nodes import POINTS, QUADS
from stga_addon.scene.display.splat_object import (
    can_update,
    get_input,
    set_input,
    show_avatar,
    show_world_splats,
    stored_avatar,
    triangles_hint,
    update_splats,
)

from .session import placed, point_clouds, reopen

FRAMES = (1, 5, 9)


def sphere(rings=12, segments=16):
    """Head-sized triangles (V, 3), (F, 3) off the origin, from random first corners."""
    rng = default_rng(0)
    around = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    theta, phi = np.meshgrid(np.linspace(0.2, np.pi - 0.2, rings), around)
    ball = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
    i, j = np.meshgrid(np.arange(segments), np.arange(rings - 1), indexing="ij")
    a = i * rings + j
    b = (i + 1) % segments * rings + j
    halves = np.stack([a, b, b + 1], -1), np.stack([a, b + 1, a + 1], -1)
    faces = np.concatenate([half.reshape(-1, 3) for half in halves])
    turn = rng.integers(0, 3, len(faces))
    faces = np.take_along_axis(faces, (np.arange(3) + turn[:, None]) % 3, axis=1)
    return 0.1 * ball.reshape(-1, 3) + [0.3, 1.0, 0.2], faces.astype(np.int32)


def random_splats(faces, count, degree=1, extent=0.01):
    rng = default_rng(1)
    return splats_of(
        rng.normal(0, extent, (count, 3)),
        rotation=rng.normal(0, 1, (count, 4)) * 3,
        log_scale=rng.normal(-7, 0.5, (count, 3)),
        opacity=rng.normal(0, 2, count),
        sh=rng.normal(0, 0.4, (count, (degree + 1) ** 2, 3)),
        face=rng.integers(0, faces, count),
    )


def animated_head(neutral, faces):
    """Mesh object under a turned parent; two shape keys move it over FRAMES."""
    rng = default_rng(2)
    mesh = bpy.data.meshes.new("head")
    mesh.from_pydata(neutral.tolist(), [], faces.tolist())
    head = bpy.data.objects.new("head", mesh)
    root = bpy.data.objects.new("root", None)
    root.rotation_euler = (np.pi / 2, 0, 0.3)
    head.parent = root
    for thing in (head, root):
        bpy.context.scene.collection.objects.link(thing)
    head.shape_key_add(name="Basis")
    for name, first in (("a", 0.0), ("b", 1.0)):
        key = head.shape_key_add(name=name)
        moved = (neutral + rng.normal(0, 0.004, neutral.shape)).astype(np.float32)
        key.data.foreach_set("co", moved.ravel())
        for frame, value in zip(FRAMES, (first, 0.6, 1 - first), strict=True):
            key.value = value
            key.keyframe_insert("value", frame=frame)
    return head


def show_on_head(avatar):
    """Its splats on an animated head, and the head."""
    head = animated_head(avatar.neutral, avatar.faces)
    return show_avatar(avatar, head), head


def avatar_of(convention, count=3000, **grid):
    neutral, faces = sphere(**grid)
    extent = 0.01 if convention == "stga" else 0.8
    splats = random_splats(len(faces), count, extent=extent)
    return Avatar(splats, convention, neutral.astype(np.float32), faces)


def same_rotation(a, b):
    """Largest angle in radians between two sets of quaternions, whose signs mean nothing."""
    a, b = (q / norm(q, axis=-1, keepdims=True) for q in (a, b))
    sign = np.sign(np.sum(a * b, axis=-1, keepdims=True))
    return float(2 * norm(a - sign * b, axis=-1).max())


def assert_follows(shown, head, avatar):
    """The evaluated splats against `to_world` on the head; their positions."""
    expected = to_world(avatar.splats, avatar.frames(evaluated_vertices(head)))
    xyz, rotation, scale = evaluated_splats(shown)
    assert np.abs(xyz - expected.xyz).max() < 1e-5
    assert same_rotation(rotation, expected.rotation) < 1e-3
    assert_allclose(scale, np.exp(expected.log_scale), rtol=2e-3)
    return xyz


def displayed_colors(shown):
    """(N, 3) scene-linear colors of the splats as points."""
    set_input(shown, splat_nodes.DISPLAY, POINTS)
    (points,) = point_clouds()
    return read_attribute(points, DISPLAY_COLOR)[:, :3]


def linear(srgb):
    srgb = np.clip(srgb, 0, 1)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def active_camera(location=(0.0, 0.0, 0.0)):
    camera = placed("camera", bpy.data.cameras.new("camera"))
    camera.location = location
    bpy.context.scene.camera = camera
    return camera


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_colors_follow_the_active_camera(degree):
    """Catches harmonics of another order, sign or space, and colors that stay."""
    harmonics = pytest.importorskip("stga_addon.raster.cpu.splat_block")
    avatar = avatar_of("stga", 400)
    sh = default_rng(3).normal(0, 0.3, (400, (degree + 1) ** 2, 3)).astype(np.float32)
    avatar = replace(avatar, splats=replace(avatar.splats, sh=sh))
    shown, _ = show_on_head(avatar)
    camera = active_camera((-0.8, 0.5, 0.9))
    camera.keyframe_insert("location", frame=1)
    camera.location = (0.3, -0.9, 1.2)
    camera.keyframe_insert("location", frame=5)
    bpy.context.scene.frame_set(1)
    before = displayed_colors(shown)
    bpy.context.scene.frame_set(5)
    at = np.linalg.inv(np.array(shown.matrix_world, np.float64)) @ [*camera.location, 1]
    direction = evaluated_splats(shown)[0] - at[:3]
    direction /= norm(direction, axis=-1, keepdims=True)
    basis = np.zeros((400, 16), np.float32)
    for row, (x, y, z) in zip(basis, direction.astype(np.float32), strict=True):
        row[:] = harmonics.basis(x, y, z)
    seen = 0.5 + np.einsum("nk,nkc->nc", basis[:, : sh.shape[1]], sh)
    assert_allclose(displayed_colors(shown), linear(seen), atol=2e-4)
    assert np.abs(displayed_colors(shown) - before).max() > 0.1
    set_input(shown, splat_nodes.VIEW_DEPENDENT, False)
    assert_allclose(displayed_colors(shown), linear(0.5 + SH_C0 * sh[:, 0]), atol=2e-6)


def driven_avatar(convention, names=tuple(OFFSETS), seed=6, count=1500):
    """Splats that follow the deformation, on a mesh with boundaries, an edge of three triangles and
    a line for a triangle.

    Within their ranges of strain, some triangles at rest have another strain than 0; small turns
    leave the range of normals.
    """
    avatar = avatar_of(convention, count)
    rng = default_rng(seed)
    neutral = avatar.neutral.copy()
    faces = avatar.faces
    neutral[faces[7, 2]] = neutral[faces[7, 1]]
    fin = np.append(faces[100, :2], len(neutral))
    neutral = np.append(neutral, [1.2 * neutral[faces[100, 0]] - 0.2 * neutral.mean(0)], axis=0)
    faces = np.append(faces, [fin], axis=0).astype(np.int32)
    lowest = [[-2, -0.3], [-0.3, -0.02]]
    highest = [[-0.3, 2], [0.02, 0.3]]
    ends = [rng.uniform(*np.repeat(each, 3, 0).T, (len(faces), 6)) for each in (lowest, highest)]
    moves = 0.004 if convention == "stga" else 0.3
    sizes = {POSITION: moves, SCALE: 0.1, COLOR: 0.5}
    units = [sizes[OFFSETS[name].target] for name in names]
    values = [rng.normal(0, unit, (len(faces), 3, 3)).astype(np.float32) for unit in units]
    for name, each in zip(names, values, strict=True):
        if OFFSETS[name].target == SCALE:
            # Nodes keep the size of what has no area in the neutral mesh.
            each[face_areas(neutral, faces) == 0] = 0
    splats = replace(avatar.splats, face=rng.integers(0, len(faces), count).astype(np.int32))
    avatar = replace(avatar, splats=splats, neutral=neutral.astype(np.float32), faces=faces)
    limits = np.stack(ends, 1).astype(np.float32)
    offsets = dict(zip(names, values, strict=True))
    return replace(avatar, strain_range=limits, driven_offsets=offsets)


@pytest.mark.parametrize(
    "names", [("strain_position",), ("strain_color",), ("normal_color",), tuple(OFFSETS)]
)
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_splats_follow_the_deformation(convention, names, tmp_path):
    """Catches wrong axes, corner or unit, a transform ignored, strain, normals or coefficients
    other than numpy's, and trees that fail once saved."""
    avatar = driven_avatar(convention, names)
    is_all = len(names) == len(OFFSETS)
    splats = replace(avatar.splats, sh=avatar.splats.sh[:, :1])
    avatar = replace(avatar, splats=splats, antialiased=is_all)
    # at a boundary, inside, an edge of three
    assert {2, 3, 4} <= set(edge_neighbors(avatar.faces).counts.tolist())
    head = animated_head(avatar.neutral, avatar.faces)
    head.location = (0.1, 0.2, 0.3)
    show_avatar(avatar, head)
    reopen(tmp_path / "a.blend")
    shown = bpy.data.objects["head splats"]
    head = bpy.data.objects["head"]
    assert_allclose(shown.matrix_world, head.matrix_world, atol=1e-6)
    stored = stored_avatar(shown)
    assert set(stored.driven_offsets) == set(names)
    assert stored.antialiased == avatar.antialiased == is_all
    assert_array_equal(stored.strain_range, avatar.strain_range)
    set_input(shown, splat_nodes.DISPLAY, POINTS)
    unmoved = replace(avatar, driven_offsets={})
    for frame in FRAMES:
        bpy.context.scene.frame_set(frame)
        posed = evaluated_vertices(head)
        frames, plain, again = (each.frames(posed) for each in (avatar, unmoved, stored))
        assert_array_equal(again.origin, frames.origin)
        assert_array_equal(again.color, frames.color)
        moved = np.median(norm(frames.origin - plain.origin, axis=1))
        assert moved > 3e-4 if "strain_position" in names else moved == 0
        assert np.abs(frames.deformation[:, :3]).max() > 0.5
        clipped = (frames.deformation[:, None, 3:] == avatar.strain_range[:, :, 3:]).any(1)
        assert 0.2 < clipped.mean() < 0.8
        assert_follows(shown, head, avatar)
        expected = 0.5 + SH_C0 * to_world(avatar.splats, frames).sh[:, 0]
        assert_allclose(displayed_colors(shown), linear(expected), atol=1e-3)
    bpy.context.scene.frame_set(FRAMES[0])
    head.shape_key_clear()
    assert np.abs(at_rest(avatar.strain_range)).max() > 0.2
    assert_follows(shown, head, unmoved)
    expected = linear(0.5 + SH_C0 * avatar.splats.sh[:, 0])
    assert_allclose(displayed_colors(shown), expected, atol=1e-4)


@pytest.mark.parametrize("names", [(), ("strain_position",)])
def test_splats_follow_a_subdivided_head(names):
    """Catches splats on other triangles where a modifier has divided those of the head."""
    avatar = driven_avatar("stga", names)
    shown, head = show_on_head(avatar)
    subdivision = head.modifiers.new("subdivision", "SUBSURF")
    subdivision.subdivision_type = "SIMPLE"
    bpy.context.scene.frame_set(5)
    found = evaluated_splats(shown)[0]
    subdivision.show_viewport = False
    bpy.context.view_layer.update()
    assert_allclose(found, evaluated_splats(shown)[0], atol=1e-6)


@pytest.mark.parametrize("names", [(), ("strain_position",)])
@pytest.mark.parametrize("kind", ["DECIMATE", "REMESH", "WELD"])
def test_a_head_of_other_triangles_shows_no_splats(kind, names):
    """Catches splats that are scattered where a modifier has made other triangles."""
    shown, head = show_on_head(driven_avatar("stga", names))
    set_input(shown, splat_nodes.DISPLAY, POINTS)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    assert sum(len(cloud.points) for cloud in point_clouds()) > 0
    assert triangles_hint(shown, depsgraph) is None
    changed = head.modifiers.new("other", kind)
    for name, value in {"voxel_size": 0.005, "ratio": 0.7, "merge_threshold": 0.02}.items():
        if hasattr(changed, name):
            setattr(changed, name, value)
    bpy.context.view_layer.update()
    assert sum(len(cloud.points) for cloud in point_clouds()) == 0
    if kind != "REMESH":
        assert "check its modifiers" in triangles_hint(shown, depsgraph)


def two_avatars():
    """Two on the same mesh."""
    first, second = (driven_avatar("stga", ("strain_position",), seed) for seed in (6, 7))
    return first, replace(second, neutral=first.neutral, faces=first.faces)


def test_updated_splats_follow_strain_anew():
    """Catches new splats shown with the strain coefficients of the first ones, or with colors that
    Relight Frame has found for those."""
    first, second = two_avatars()
    shown, head = show_on_head(first)
    bpy.context.scene.frame_set(5)
    assert_follows(shown, head, first)
    assert can_update(shown, second)
    color = np.ones(4 * len(first.splats), np.float32)
    write_attributes(shown.data, {RELIT_COLOR: ("FLOAT_COLOR", "color", color)}, "POINT")
    shown.data[tags.RELIT_FRAME] = 1
    update_splats(shown, avatar_attributes(second))
    assert RELIT_COLOR not in shown.data.attributes
    assert tags.RELIT_FRAME not in shown.data
    assert_follows(shown, head, second)
    stored = stored_avatar(shown).driven_offsets["strain_position"]
    assert_array_equal(stored, second.driven_offsets["strain_position"])
    assert not can_update(shown, replace(second, driven_offsets={}))
    assert not can_update(shown, driven_avatar("stga"))
    set_input(shown, splat_nodes.NEUTRAL, None)
    assert not can_update(shown, second)


def test_a_duplicate_keeps_its_avatar():
    """Catches a version kept by Shift+D that changes with the original, by their neutral mesh."""
    first, second = two_avatars()
    shown, _ = show_on_head(first)
    version = shown.copy()  # Shift+D
    twin = shown.copy()  # Alt+D
    version.data = shown.data.copy()
    for each in (version, twin):
        bpy.context.scene.collection.objects.link(each)
    update_splats(shown, avatar_attributes(second))
    for each, expected in ((shown, second), (twin, second), (version, first)):
        found = stored_avatar(each)
        assert_array_equal(found.splats.xyz, expected.splats.xyz)
        offsets = expected.driven_offsets["strain_position"]
        assert_array_equal(found.driven_offsets["strain_position"], offsets)
    neutral = get_input(shown, splat_nodes.NEUTRAL)
    update_splats(shown, avatar_attributes(first))
    assert get_input(shown, splat_nodes.NEUTRAL) == neutral


def test_world_splats():
    """Catches splats taken for embedded ones, sRGB for linear, and colors beyond 0…1."""
    sh = np.linspace(-3, 3, 900, dtype=np.float32).reshape(300, 1, 3)
    splats = replace(random_splats(1, 300, degree=0), sh=sh)
    shown = show_world_splats(splats, "scan")
    xyz, rotation, scale = evaluated_splats(shown)
    assert_allclose(xyz, splats.xyz, atol=1e-7)
    assert same_rotation(rotation, splats.rotation) < 1e-3
    assert_allclose(scale, np.exp(splats.log_scale), rtol=1e-5)
    expected = linear(0.5 + SH_C0 * splats.sh[:, 0])
    assert (expected.min(), expected.max()) == (0, 1)
    assert_allclose(displayed_colors(shown), expected, atol=2e-6)


def test_names_of_trees_are_told_apart():
    """Catches names that Blender shortens, and a tree found for a similar name."""
    kinds = [
        splat_nodes.TreeOptions(convention, degree, names)
        for convention in (*CONVENTIONS, None)
        for degree in range(4)
        for count in range(1 + len(OFFSETS) if convention else 1)
        for names in combinations(OFFSETS, count)
    ]
    for kind in (kinds[-1], *(kind for kind in kinds if kind.offsets and kind.degree == 3)):
        assert splat_nodes.splat_tree(kind).name == kind.tree_name
    names = {tree.name for tree in bpy.data.node_groups} | {kind.tree_name for kind in kinds}
    assert len({kind.tree_name for kind in kinds}) == len(kinds)
    assert max(map(len, names)) <= 59
    assert not [(a, b) for a in names for b in names if a != b and b.startswith(a)]


def test_display_inputs():
    """Catches inputs that are not wired, and splats on a mesh they were not trained on."""
    avatar = avatar_of("stga", 2000)
    with refusal("trained on"):
        show_avatar(avatar, animated_head(avatar.neutral, avatar.faces[::-1]))
    shown = show_avatar(avatar, animated_head(avatar.neutral, avatar.faces))
    opacity = 1 / (1 + np.exp(-avatar.splats.opacity))
    assert len(evaluated_splats(shown)[0]) == 2000
    set_input(shown, splat_nodes.OPACITY_THRESHOLD, 0.4)
    assert len(evaluated_splats(shown)[0]) == (opacity >= 0.4).sum()
    set_input(shown, splat_nodes.OPACITY_THRESHOLD, 0.0)
    set_input(shown, splat_nodes.PERCENTAGE, 25.0)
    assert 400 < len(evaluated_splats(shown)[0]) < 600
    set_input(shown, splat_nodes.PERCENTAGE, 100.0)
    assert get_input(shown, splat_nodes.SIZE) == 1.0
    assert get_input(shown, "Colour of the sea") is None
    set_input(shown, splat_nodes.DISPLAY, QUADS)
    with refusal("quads"):
        evaluated_splats(shown)


def test_quads_face_the_camera_and_cover_the_splat():
    """Catches quads edge-on, or of another size or shape: Gaussians are cut off."""
    avatar = avatar_of("stga", 200)
    shown = show_avatar(avatar, animated_head(avatar.neutral, avatar.faces))
    camera = active_camera((0.4, -1.0, 1.3))
    bpy.context.scene.frame_set(5)
    centre, rotation, scale = evaluated_splats(shown)
    set_input(shown, splat_nodes.SIZE, 2.0)
    set_input(shown, splat_nodes.DISPLAY, QUADS)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    quads = [np.array(i.matrix_world) for i in depsgraph.object_instances if i.is_instance]
    quads = np.array(quads, np.float64)
    to_world = np.array(shown.matrix_world, np.float64)
    placed = centre @ to_world[:3, :3].T + to_world[:3, 3]
    assert_allclose(quads[:, :3, 3], placed, atol=1e-5)
    # In the quad's own space each splat is a sphere, and the camera right above its center.
    eye = (np.linalg.inv(quads) @ [*camera.location, 1.0])[:, :3]
    assert (eye[:, 2] / norm(eye, axis=-1)).min() > 1 - 1e-4
    turned = np.array([mathutils.Quaternion(each).to_matrix() for each in rotation], np.float64)
    axes = to_world[:3, :3] @ turned * 2 * scale[:, None]
    shapes = [m @ m.transpose(0, 2, 1) for m in (quads[:, :3, :3], axes)]
    assert_allclose(shapes[0], shapes[1], rtol=2e-3, atol=1e-10)


def test_selection_grays_out_frozen_splats():
    """Catches the selection of another frame, or of triangles beside selected ones."""
    avatar = avatar_of("stga", 1000)
    head = animated_head(avatar.neutral, avatar.faces)
    chosen = avatar.faces[:40]
    head.vertex_groups.new(name="stga_5").add([int(v) for v in np.unique(chosen)], 1.0, "ADD")
    selected = np.isin(avatar.faces, chosen).all(1)[avatar.splats.face]
    shown = show_avatar(avatar, head)
    set_input(shown, splat_nodes.SHOW_SELECTION, True)

    def grays():
        return np.isclose(displayed_colors(shown), splat_nodes.FROZEN_COLOR[:3]).all(1)

    bpy.context.scene.frame_set(5)
    assert 0 < selected.sum() < 1000
    assert_array_equal(grays(), ~selected)
    bpy.context.scene.frame_set(6)
    assert not grays().any()
    bpy.context.scene.frame_set(5)
    set_input(shown, splat_nodes.SHOW_SELECTION, False)
    assert not grays().any()
    set_input(shown, splat_nodes.SELECTED_ONLY, True)
    assert len(evaluated_splats(shown)[0]) == selected.sum()
    bpy.context.scene.frame_set(6)
    assert len(evaluated_splats(shown)[0]) == 1000


def test_unseen_splats_are_colored_or_hidden():
    """Catches triangles that were filmed colored as unseen, views that add to the color, the mark
    of an avatar that knows it on one that does not, and a mark that stored avatars lose."""
    avatar = avatar_of("stga", 1000)
    unseen = np.arange(len(avatar.faces)) % 3 == 0
    marked = replace(avatar, regions={"unseen": unseen})
    head = animated_head(avatar.neutral, avatar.faces)
    shown = show_avatar(marked, head)
    hidden = unseen[avatar.splats.face]

    def blue():
        return np.isclose(displayed_colors(shown), splat_nodes.UNSEEN_COLOR[:3]).all(1)

    assert not blue().any()
    set_input(shown, splat_nodes.SHOW_UNSEEN, True)
    assert_array_equal(blue(), hidden)
    set_input(shown, splat_nodes.FILMED_ONLY, True)
    assert len(evaluated_splats(shown)[0]) == 1000 - hidden.sum()
    found = stored_avatar(shown).regions["unseen"]
    assert_array_equal(found[avatar.splats.face], hidden)
    update_splats(shown, avatar_attributes(avatar))
    assert len(evaluated_splats(shown)[0]) == 1000
    assert not stored_avatar(shown).regions


TREES = [("stga", 3, ("normal_color",)), (None, 0, ()), ("gaussian_avatars", 3, tuple(OFFSETS))]


@pytest.mark.parametrize("kind", TREES)
def test_trees_are_built_one_node_group_at_a_time(kind):
    """Catches what blocks the UI, groups built again, and needless strain nodes."""
    built = []
    options = splat_nodes.TreeOptions(*kind)
    while splat_nodes.build_next_node_group(options):
        built.append(len(bpy.data.node_groups))
    assert built == list(range(1, len(built) + 1))
    assert max(len(tree.nodes) for tree in bpy.data.node_groups) <= 64
    assert splat_nodes.splat_tree(options) == find_tree(options.tree_name)
    assert len(bpy.data.node_groups) == len(built)
    is_lit = compat.NATIVE_SPLATS and options.convention is not None
    assert len(bpy.data.materials) == (4 if is_lit else 2)
    nodes = [node for tree in bpy.data.node_groups for node in tree.nodes]
    sockets = [socket for node in nodes for socket in node.inputs if socket.type == "STRING"]
    names = [socket.default_value for socket in sockets]
    assert splat_nodes.stored.XYZ in names
    assert any("strain" in name for name in names) == bool(options.offsets)
