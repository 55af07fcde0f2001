"""Visual-hull points of an analytic scene: a ball beside the mesh, seen in masks from all
around."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from flame.small_head import small_head
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from scipy.spatial.transform import Rotation

from stga_addon.avatar.embedding import face_frames, to_world
from stga_addon.avatar.splats import SH_C0
from stga_addon.capture.camera import look_at
from stga_addon.capture.model import Capture, View
from stga_addon.capture.visual_hull import VOXEL_SIZE_M
from stga_addon.flame.forward import neutral_frame
from stga_addon.flame.model import torso_faces
from stga_addon.flame.sequence import FlameSequence, sequence_mesh
from stga_addon.tracking.folder import TorsoPoints, write_torso_points
from stga_addon.training.optimize.initial_splats import (
    MIN_MESH_DISTANCE_M,
    POINT_COPIES,
    flat_points,
    visual_hull_points,
)

SIZE = 120
FOCAL = 300.0
FAR = 1.0
CENTRE = np.array([0.06, 0.075, 0.02])
RADIUS = 0.03
TIMESTEP = 4


def cameras(count=20):
    """Cameras on a sphere of a meter around the origin (a Fibonacci spiral), looking at it."""
    found = []
    for n in range(count):
        height = 1 - 2 * (n + 0.5) / count
        angle = n * np.pi * (3 - np.sqrt(5))
        x, z = np.sqrt(1 - height**2) * np.array([np.cos(angle), np.sin(angle)])
        camera = look_at(FAR * np.array([x, height, z]), (0, 0, 0), SIZE, SIZE, FOCAL)
        found.append(replace(camera, cx=SIZE / 2 + 2, cy=SIZE / 2 - 3))
    return found


def silhouette(camera, centre, radius):
    """(H, W) bool: the pixels whose ray passes the centre within the radius."""
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    rays = np.stack(
        [(columns - camera.cx) / FOCAL, (rows - camera.cy) / FOCAL, np.ones((SIZE, SIZE))], -1
    )
    rays /= norm(rays, axis=-1, keepdims=True)
    seen = camera.world_to_camera[:3, :3] @ centre + camera.world_to_camera[:3, 3]
    return np.asarray(norm(np.cross(rays, seen), axis=-1) < radius)


def scene(root, centre=CENTRE, radius=RADIUS):
    """A head mesh of 8 cm that at TIMESTEP is turned, moved and 10 % larger than the neutral one,
    and the ball."""
    ball = trimesh.creation.icosphere(4, 0.06)
    neutral = np.array(ball.vertices)
    faces = np.array(ball.faces, np.int32)
    turn = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
    posed = 1.1 * neutral @ turn.T + [0.01, -0.005, 0.0]
    views = []
    for n, camera in enumerate(cameras()):
        mask = silhouette(camera, centre, radius)
        image = np.where(mask[..., None], [90, 250, 40], 255).astype(np.uint8)
        paths = root / f"{n}.png", root / f"{n}_mask.png"
        Image.fromarray(image).save(paths[0])
        Image.fromarray(mask.astype(np.uint8) * 255).save(paths[1])
        views.append(View(TIMESTEP, n, camera, str(n), *paths))
    return Capture(
        root,
        "mesh",
        faces,
        neutral,
        {"train": tuple(views)},
        (0, TIMESTEP),
        {},
        lambda timestep: posed if timestep == TIMESTEP else neutral,
        lambda timestep, pose: neutral,
    )


@pytest.fixture(scope="module")
def beside(tmp_path_factory):
    return scene(tmp_path_factory.mktemp("beside"))


def in_world(capture, points, convention="stga"):
    frames = face_frames(capture.mesh(TIMESTEP), capture.faces, capture.neutral, convention)
    return to_world(points, frames)


@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
def test_points_stand_on_the_balls_surface(beside, convention):
    """Catches swapped image axes, an ignored principal point, points in the wrong frame, and a
    shell with holes."""
    points = visual_hull_points(beside, beside.views["train"], convention, 1)
    world = in_world(beside, points, convention)
    height = norm(world.xyz - CENTRE, axis=1) - RADIUS
    assert len(world) > 300
    # The hull of twenty views is a little larger than the ball; the grid point lies within a voxel
    # of its surface.
    assert height.min() > -2 * VOXEL_SIZE_M
    assert height.max() < 2 * VOXEL_SIZE_M
    # Around the mesh's bounding box the grid ends, and near the mesh no points are wanted.
    sphere = CENTRE + RADIUS * np.array(trimesh.creation.icosphere(3).vertices)
    low = beside.mesh(TIMESTEP).min(0)
    high = beside.mesh(TIMESTEP).max(0)
    margin = 0.25 * norm(high - low) - 2 * VOXEL_SIZE_M
    head = norm(sphere - beside.mesh(TIMESTEP).mean(0), axis=1) - 1.1 * 0.06
    wanted = ((sphere > low - margin) & (sphere < high + margin)).all(axis=1) & (
        head > MIN_MESH_DISTANCE_M + 2 * VOXEL_SIZE_M
    )
    assert wanted.mean() > 0.7
    gaps = norm(sphere[wanted][:, None] - world.xyz[None], axis=2).min(axis=1)
    assert gaps.max() < 2.5 * VOXEL_SIZE_M


def test_points_are_unbound_colored_and_embedded_in_the_nearest_triangle(beside):
    """Catches limits that pull hair onto the skin or a far face, captures without masks, and points
    of many cameras that begin gray."""
    points = visual_hull_points(beside, beside.views["train"], "stga", 2)
    assert points.unbound.all()
    assert points.sh.shape == (len(points), 9, 3)
    color = points.sh[:, 0] * SH_C0 + 0.5
    assert_allclose(np.median(color, axis=0), np.array([90, 250, 40]) / 255, atol=0.02)
    assert not points.sh[:, 1:].any()
    assert not points.opacity.any()
    world = in_world(beside, points)
    assert_allclose(np.exp(world.log_scale), VOXEL_SIZE_M / 2, rtol=1e-5)
    centroids = beside.mesh(TIMESTEP)[beside.faces].mean(1)
    some = np.arange(0, len(points), 7)
    distances = norm(world.xyz[some, None] - centroids[None], axis=2)
    bound = distances[np.arange(len(some)), points.face[some]]
    # The nearest triangle need not have the nearest centroid, but on this even mesh it nearly does.
    assert_allclose(bound, distances.min(axis=1), atol=3e-4)
    views = [replace(view, mask=None) for view in beside.views["train"]]
    bare, masked = (
        visual_hull_points(beside, v, "stga", 0) for v in (views, beside.views["train"])
    )
    assert_array_equal(bare.xyz, masked.xyz)


@pytest.mark.parametrize(("whole", "shift"), [(6, 1), (4, 9)])
def test_blocks_leave_nothing_out(beside, tmp_path, monkeypatch, whole, shift):
    """Catches blocks of voxels that are skipped although some of their voxels are in the hull; all
    but a few images end `shift` pixels behind the ball's first column."""
    views = list(beside.views["train"])
    for number, view in enumerate(views[whole:], whole):
        assert view.mask
        width = Image.open(view.mask).getbbox()[0] + shift
        paths = {}
        for kind, file in (("image", view.image), ("mask", view.mask)):
            paths[kind] = tmp_path / file.name
            Image.open(file).crop((0, 0, width, SIZE)).save(paths[kind])
        views[number] = replace(view, camera=replace(view.camera, width=width), **paths)
    capture = replace(beside, views={"train": tuple(views)})
    found = []
    for voxels in (1, 5):
        monkeypatch.setattr("stga_addon.capture.visual_hull.BLOCK_VOXELS", voxels)
        found.append(visual_hull_points(capture, views, "stga", 0).xyz)
    assert len(found[0]) > 100
    assert np.array_equal(*found)


def test_nothing_near_the_mesh(tmp_path):
    """Catches points on the skin itself, where the mesh's own splats are; here the ball is half
    inside the head."""
    capture = scene(tmp_path, np.array([0.04, 0.04, 0.02]), 0.04)
    world = in_world(capture, visual_hull_points(capture, capture.views["train"], "stga", 0))
    head = norm(world.xyz - capture.mesh(TIMESTEP).mean(0), axis=1) - 1.1 * 0.06
    assert len(world) > 100
    # The clearance is measured to vertices and centroids, 2 mm from any point of a triangle of this
    # mesh.
    assert np.abs(head).min() > MIN_MESH_DISTANCE_M - 0.002
    assert np.abs(head).min() < MIN_MESH_DISTANCE_M + VOXEL_SIZE_M


def test_one_mask_that_says_no_is_enough(beside, tmp_path):
    """Catches carving by vote: what one view sees as background is not there."""
    views = list(beside.views["train"])
    black = tmp_path / "black.png"
    Image.fromarray(np.zeros((SIZE, SIZE), np.uint8)).save(black)
    views[7] = replace(views[7], mask=black)
    assert len(visual_hull_points(beside, views, "stga", 0)) == 0


def turned(model):
    """The torso turned under a head that stays."""
    turn = np.array([0.0, 0.4, 0.0])
    return replace(neutral_frame(model), rotation=turn, neck_pose=-turn)


def posed_head(model, frame):
    return FlameSequence(model, np.zeros(model.n_identity), None, (TIMESTEP,), lambda _: frame)


def capture_of(root, head, views, neutral=None):
    """Of a FLAME head's motion, and views of the ball."""

    def mesh(timestep, *_):
        return sequence_mesh(head, timestep)

    model = head.model
    neutral = model.v_template if neutral is None else neutral
    timesteps = head.timesteps
    return Capture(root, "flame", model.faces, neutral, views, timesteps, {}, mesh, mesh, head)


@pytest.mark.parametrize("one", [False, True])
def test_what_lies_below_the_neck_follows_the_torso(tmp_path, one):
    """Catches a collar that turns with the chin it lies under, and hair beside the neck that does
    not."""
    model = small_head(0)
    head = posed_head(model, turned(model))
    for centre, carried in (([0.0, -0.175, 0.115], True), ([0.0, -0.135, 0.115], False)):
        views = scene(tmp_path, np.array(centre), 0.015).views
        side = max(views["train"], key=lambda view: float(view.camera.position[0]))
        capture = capture_of(tmp_path, head, views)
        place, shown = (flat_points, side) if one else (visual_hull_points, views["train"])
        before, after = (place(capture, shown, "stga", 0, torso) for torso in (False, True))
        assert len(before) == len(after) > 20
        assert not torso_faces(model)[before.face].all()
        assert (
            torso_faces(model)[after.face].all() if carried else (after.face == before.face).all()
        )
        world = [in_world(capture, points).xyz for points in (before, after)]
        assert_allclose(world[0], world[1], atol=1e-6)


def test_few_cameras_take_the_torso_from_where_it_was_seen(tmp_path):
    """Catches a chest that bulges as the hull of few cameras does, one that loses its place when it
    turns or begins gray, and a hull of many cameras that is thrown away."""
    model = small_head(0)
    frames = {TIMESTEP: turned(model), TIMESTEP + 1: neutral_frame(model)}
    head = FlameSequence(model, np.zeros(model.n_identity), None, tuple(frames), frames.__getitem__)
    views = scene(tmp_path, np.array([0.0, -0.175, 0.115]), 0.015).views["train"]
    neutral = sequence_mesh(head, TIMESTEP + 1)
    red = np.uint8([200, 30, 60])
    Image.fromarray(np.tile(red, (SIZE, SIZE, 1))).save(tmp_path / "chest.png")
    later = replace(views[0], timestep=TIMESTEP + 1, image=tmp_path / "chest.png", mask=None)
    capture = capture_of(tmp_path, head, {"train": (*views, later)}, neutral)
    hull, many = (
        visual_hull_points(capture, own, "stga", 0, torso=True) for own in (views[:3], views)
    )
    at = np.array([0.0, -0.16, 0.09]) + np.random.default_rng(0).uniform(-0.01, 0.01, (200, 3))
    write_torso_points(tmp_path, TorsoPoints(TIMESTEP + 1, at))
    few = visual_hull_points(capture, views[:3], "stga", 0, torso=True)
    seen = few.rows(slice(-POINT_COPIES * len(at), None))
    assert len(few) - len(seen) < 0.2 * len(hull)  # above the neck
    assert torso_faces(model)[seen.face].all()
    assert_allclose(seen.sh[:, 0] * SH_C0 + 0.5, np.tile(red / 255, (len(seen), 1)), atol=1e-6)
    neutral = face_frames(capture.mesh(TIMESTEP + 1), capture.faces, capture.neutral)
    assert norm(to_world(seen, neutral).xyz - at.mean(0), axis=1).max() < 0.03
    assert norm(in_world(capture, seen).xyz - at.mean(0), axis=1).min() > 0.01
    assert_array_equal(visual_hull_points(capture, views, "stga", 0, torso=True).xyz, many.xyz)


@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
def test_a_single_camera_gets_a_layer_as_deep_as_the_mesh(beside, convention):
    """Catches points off their rays, holes in the layer, and one before or behind the head."""

    def apart(view):
        return norm(view.camera.world_to_camera[:2, :3] @ CENTRE)

    view = max(beside.views["train"], key=apart)
    world = in_world(beside, flat_points(beside, view, convention, 1), convention)
    pixels, depth = view.camera.project(world.xyz.astype(np.float64))
    mask = silhouette(view.camera, CENTRE, RADIUS)
    columns, rows = np.floor(pixels + 1e-3).astype(int).T
    assert mask[rows, columns].all()
    _, mesh_depth = view.camera.project(beside.mesh(TIMESTEP))
    assert mesh_depth.min() < depth.min()
    assert depth.max() < mesh_depth.max()
    step = VOXEL_SIZE_M * FOCAL / FAR
    inner = silhouette(view.camera, CENTRE, RADIUS - 2 * VOXEL_SIZE_M)
    wanted = np.argwhere(
        inner & ~silhouette(view.camera, beside.mesh(TIMESTEP).mean(0), 1.1 * 0.06 + 0.01)
    )[:, ::-1]
    assert len(wanted) > 50
    assert norm(wanted[:, None] + 0.5 - pixels[None], axis=2).min(axis=1).max() < 1.5 * step
    assert world.unbound.all()
    assert_allclose(np.exp(world.log_scale), VOXEL_SIZE_M / 2, rtol=1e-5)


@pytest.mark.parametrize(("right", "up", "continued"), [(0.0, -0.24, True), (0.22, 0.05, False)])
def test_a_single_camera_continues_the_torso_that_it_cuts_off(tmp_path, right, up, continued):
    """Catches a chest that ends in the air, and hair that is continued like one."""
    model = small_head(0)
    head = posed_head(model, neutral_frame(model))
    number = min(range(20), key=lambda n: abs(float(cameras()[n].position[1])))
    ball = right * cameras()[number].world_to_camera[0, :3] + [0.0, up, 0.0]
    views = scene(tmp_path, ball, 0.08).views
    side = views["train"][number]
    capture = capture_of(tmp_path, head, views)
    cut, whole = (
        in_world(capture, flat_points(capture, side, "stga", 0, torso)) for torso in (False, True)
    )
    pixels = side.camera.project(whole.xyz.astype(np.float64))[0]
    beyond = ((pixels < 0) | (pixels >= SIZE)).any(axis=1)
    assert beyond.any() == continued
    assert_allclose(whole.xyz[~beyond], cut.xyz, atol=1e-6)
    if continued:
        assert (pixels[beyond, 1] > SIZE).any()
        assert pixels[beyond, 1].max() < 1.4 * SIZE
        color = np.tile([90, 250, 40], (beyond.sum(), 1)) / 255
        assert_allclose(whole.sh[beyond, 0] * SH_C0 + 0.5, color, atol=1e-6)
        assert (whole.opacity[beyond] > 2).all()


def test_no_layer_where_nothing_lies_beside_the_mesh(tmp_path, beside):
    """Catches a crash where nothing lies outside the mesh, and 10^13 points of one of 100 m."""
    capture = scene(tmp_path, CENTRE, 0.0)
    for points in (
        flat_points(capture, capture.views["train"][0], "stga", 1),
        visual_hull_points(capture, capture.views["train"], "stga", 1),
    ):
        assert points.sh.shape == (0, 4, 3)
    huge = replace(beside, mesh=lambda timestep: 1000 * beside.mesh(timestep))
    assert len(visual_hull_points(huge, beside.views["train"][:2], "stga", 0)) < 100_000
