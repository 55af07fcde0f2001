"""Heads moved onto the surface that the cameras see, against surfaces that are known."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import trimesh
from numpy.linalg import norm
from numpy.random import default_rng
from scipy.ndimage import binary_dilation

from stga_addon.capture.camera import look_at
from stga_addon.capture.mesh_geometry import facing, rasterize
from stga_addon.flame.forward import flame_forward
from stga_addon.tracking.correspondence import nearest_points, shaded_image
from stga_addon.tracking.fit import HeadFit, RecordedTake, fit_head
from stga_addon.tracking.observed_surface import (
    PosedSurface,
    SurfaceSearch,
    Sweep,
    gray_view,
    in_sight,
    near_landmarks,
    outline_offsets,
    outlines_agree,
    surface_offsets,
    surface_points,
)
from stga_addon.tracking.posed_points import SurfacePoints
from stga_addon.tracking.solve import person
from stga_addon.tracking.stages import Workers
from stga_addon.tracking.surface import fit_surface, smooth_offsets
from stga_addon.worker.helpers import Helpers

from .test_fit import HERE, frame_at, in_cameras_world, places_on, recorded, seen, shown

RADIUS_M = 0.09
SWEEP = Sweep(0.004, 0.0005, 0.001)


def rig(count, size=400):
    eyes = [
        (np.sin(a), 0.15 * (-1) ** k, np.cos(a))
        for k, a in enumerate(np.linspace(-0.5, 0.5, count))
    ]
    return [look_at(eye, (0, 0, 0), size, size, 3.4 * size) for eye in eyes]


def sphere_image(camera, contrast=1.0):
    """A ball with waves of several lengths on it, seen by intersecting rays with it: no mesh and no
    rasterizer."""
    rays = rays_of(camera)
    middle = -rays @ camera.position
    inside = middle**2 - (camera.position @ camera.position - RADIUS_M**2)
    at = camera.position + (middle - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
    rng = default_rng(3)
    level = sum(
        np.sin(at @ rng.normal(0, 1.5 / length, 3) + rng.uniform(0, 6))
        for length in (0.002, 0.003, 0.004) * 4
    )
    gray = np.where(inside > 0, 128 + 14 * contrast * level, 255)
    return np.repeat(np.clip(gray, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def rays_of(camera, grid=1):
    """Unit directions (H grid, W grid, 3) through `grid` x `grid` places of each pixel."""
    y, x = (np.indices((grid * camera.height, grid * camera.width)) + 0.5) / grid
    flat = (x - camera.cx) / camera.fl_x, (y - camera.cy) / camera.fl_y
    rays = np.stack([*flat, np.ones(x.shape)], -1) @ camera.world_to_camera[:3, :3]
    return rays / norm(rays, axis=-1, keepdims=True)


def ball_points():
    """Unit directions to the front of a ball."""
    directions = default_rng(0).normal(size=(60, 3)) * [1, 1, 0.5] + [0, 0, 2]
    return directions / norm(directions, axis=1, keepdims=True)


def views(cameras, contrast=1.0):
    pictures = [sphere_image(camera, contrast) for camera in cameras]
    pairs = zip(cameras, pictures, strict=True)
    return [gray_view(*own, np.zeros(3), SWEEP.spacing) for own in pairs]


@pytest.mark.parametrize("offset", [-0.0018, 0.0, 0.0023])
def test_offsets_lead_to_the_surface_in_the_images(offset):
    """Catches a wrong sign, a pixel center that is off by half, or a wrong patch: the ball would be
    missed."""
    cameras = rig(5)
    normals = ball_points()
    points = (RADIUS_M - offset) * normals
    cosines = np.stack([facing(camera, points, normals) for camera in cameras])
    found, correlation = surface_offsets(views(cameras), cosines, points, normals, SWEEP)
    assert (correlation > 0.8).mean() > 0.9
    assert np.median(np.abs(found - offset)[correlation > 0]) < 1e-4
    assert np.percentile(np.abs(found - offset)[correlation > 0.8], 95) < 3e-4


def test_nothing_is_found_without_texture_or_with_one_camera():
    """Catches noise taken for a surface, which would move the head at random."""
    cameras = rig(5)
    normals = ball_points()
    points = RADIUS_M * normals
    cosines = np.stack([facing(camera, points, normals) for camera in cameras])
    assert not surface_offsets(views(cameras, 0), cosines, points, normals, SWEEP)[1].any()
    alone = cosines * (np.arange(5) == 2)[:, None]
    assert not surface_offsets(views(cameras), alone, points, normals, SWEEP)[1].any()


def test_large_images_are_reduced_to_the_size_of_a_sample():
    """Catches a principal point that reduction moves, and samples that skip most pixels of a large
    image."""
    camera = look_at((0.2, 0.1, 1.0), (0, 0, 0), 1210, 900, 12000)
    rng = default_rng(0)
    pixels = rng.integers(0, 255, (900, 1210, 3), np.uint8)
    small, image = gray_view(camera, pixels, np.zeros(3), 0.001)
    factor = camera.fl_x / small.fl_x
    assert factor == 11  # 0.085 mm a pixel
    assert image.shape == (81, 110) == (small.height, small.width)
    points = rng.normal(0, 0.02, (9, 3))
    found = small.project(points)[0] * factor
    np.testing.assert_allclose(found, camera.project(points)[0], atol=1e-9)


def test_points_are_of_skin_that_is_in_sight(head):
    """Catches the back of the head compared in images of the face, and points on eyeballs and
    teeth, which reflections and lids make look elsewhere."""
    vertices = head.model.v_template
    faces = head.model.faces
    masks = head.model.masks
    points = surface_points(head, 400)
    inner = [masks[name] for name in ("left_eyeball", "right_eyeball", "teeth")]
    assert len(points) > 250
    assert not np.isin(faces[points.face], np.concatenate(inner)).any()
    at = points.on(vertices, faces)
    camera = look_at((0, 0, 1.2), (0, 0, 0), 400, 400, 1300)
    visible = in_sight(camera, vertices, faces, at)
    back, front = np.quantile(vertices[:, 2], [0.15, 0.85])
    assert visible[at[:, 2] > front].mean() > 0.8
    assert not visible[at[:, 2] < back].any()


def test_offsets_are_smooth_robust_and_local(head):
    """Catches outliers that dent a face, and offsets that spread to where nothing was seen."""
    vertices = head.model.v_template
    faces = head.model.faces
    points = surface_points(head, 2000)
    at = points.on(vertices, faces)
    rng = default_rng(0)
    true = 0.003 * np.exp(-((at - at[at[:, 2].argmax()]) ** 2).sum(1) / 0.04**2)
    wrong = rng.random(len(at)) < 0.15
    outliers = np.where(wrong, rng.uniform(-0.004, 0.004, len(at)), 0)
    noisy = true + rng.normal(0, 0.0004, len(at)) + outliers
    front = at[:, 2] > np.median(at[:, 2])
    found = smooth_offsets(vertices, faces, points, noisy, np.where(front, 0.2, 0.0))
    error = points.on(found[:, None], faces)[:, 0] - true
    assert np.abs(error[front]).mean() < 0.0003
    back = vertices[:, 2] < np.quantile(vertices[:, 2], 0.1)
    assert np.abs(found[back]).max() < 0.0003


def test_offsets_do_not_depend_on_how_the_surface_is_cut_into_triangles():
    """Catches a Laplacian that counts neighbors and takes a slope for a bend."""
    y, x = (0.004 * values.ravel() for values in np.indices((12, 12)))
    flat = np.column_stack([x, y]) + default_rng(0).uniform(-0.0013, 0.0013, (144, 2))
    vertices = np.column_stack([flat, np.zeros(144)])
    cell = np.flatnonzero((np.arange(144) % 12 < 11) & (np.arange(144) < 132))
    faces = np.concatenate([cell[:, None] + [0, 1, 12], cell[:, None] + [1, 13, 12]])
    points = SurfacePoints(np.arange(len(faces)), np.full((len(faces), 3), 1 / 3))
    slope = 0.001 + 0.05 * flat[:, 0]
    residual = points.on(slope[:, None], faces)[:, 0]
    found = smooth_offsets(vertices, faces, points, residual, np.full(len(faces), 0.1))
    assert np.abs(found - slope).max() < 5e-5


def pictured(head, cameras, meshes):
    """Images of a take, in colors of the vertices without a pattern."""
    count = len(head.model.v_template)
    faces = head.model.faces
    colors = default_rng(2).uniform(0.25, 1, (count, 1)) * np.ones(3)
    pictures = [[(c, shaded_image(mesh, faces, c, colors)) for c in cameras] for mesh in meshes]
    return partial(shown, pictures)


def test_a_head_is_moved_onto_the_skin_that_the_cameras_see(head):
    """Catches a surface that does not reach the fit, or the person's own offset that is lost:
    landmarks alone, wrong by 3 mm each, leave errors of millimeters."""
    model = head.model
    cameras = rig(5)
    rng = default_rng(5)
    shape = rng.normal(0, 0.7, model.n_identity)
    front = model.v_template[:, 2] > 0.04
    bump = 0.002 * np.sin(model.v_template[:, :1] * 60) * front[:, None] * [0, 0, 1]
    meshes = [flame_forward(model, shape, frame_at(head, t), bump) for t in (0, 6)]
    images = pictured(head, cameras, meshes)
    wrong = rng.normal(0, 0.0018, (150, 3))
    take = recorded(head, cameras, meshes, places_on(head, 150), wrong=wrong, images=images)
    first = fit_head(head, take)
    fit = fit_surface(head, first, take, Workers(Helpers(1)))
    before, after = (
        [distances(one, t, mesh, head, front) for t, mesh in enumerate(meshes)]
        for one in (first, fit)
    )
    assert np.max(after) < 0.0006 < np.min(before)
    assert fit.static_offset is not None
    assert np.abs(fit.static_offset).max() > 0.001
    blank = replace(take, images=lambda t, most=None: [(c, 0 * i + 90) for c, i in images(t)])
    assert fit_surface(head, first, blank, Workers(Helpers(1))) is first


def test_one_timestep_does_not_tell_the_errors_of_landmarks(head, monkeypatch):
    """Catches landmarks that count as corrected for the person, although their errors may be the
    one expression."""
    model = head.model
    cameras = rig(5)
    wrong = default_rng(5).normal(0, 0.0018, (150, 3))
    mesh = flame_forward(model, np.zeros(model.n_identity), frame_at(head, 6))
    images = pictured(head, cameras, [mesh])
    take = recorded(head, cameras, [mesh], places_on(head, 150), wrong=wrong, images=images)
    first = fit_head(head, take)
    found = []
    for share in (0.2, 5.0):
        monkeypatch.setattr("stga_addon.tracking.surface.TAKE_LANDMARK_FRACTION", share)
        found.append(fit_surface(head, first, take, Workers(Helpers(1))).parameters[0])
    assert np.abs(found[0] - first.parameters[0]).max() > 0.001
    assert np.array_equal(*found)


def distances(fit, timestep, true, head, front):
    """Median distance of vertices from the true surface along its normals, in meters."""
    back = in_cameras_world(fit, timestep)
    return np.median(nearest_points(true, head.model.faces, back[front])[1])


@pytest.mark.parametrize(
    ("count", "share"), [pytest.param(4, 0.6, marks=pytest.mark.nightly), (3, 0.5)]
)
def test_skin_slides_as_dense_tracking_has_it(head, count, share):
    """Catches poses that follow the detector's landmarks where the surface does not tell, or that
    of three cameras follow the surface: the detector has the lower face 6 mm to one side, at each
    timestep another."""
    model = head.model
    cameras = rig(count, 200)
    places = places_on(head, 150)
    shape = np.zeros(model.n_identity)
    front = model.v_template[:, 2] > 0.04
    meshes = [flame_forward(model, shape, frame_at(head, t)) for t in (0, 3, 6)]
    lower = (places.on(model.v_template, model.faces)[:, 1] < 0)[:, None] * [0.006, 0, 0]
    right = recorded(head, cameras, meshes, places).landmarks
    errors = []
    at = [places.on(mesh, model.faces) + (t - 1) * lower for t, mesh in enumerate(meshes)]
    wrong = {t: seen(cameras, own) for t, own in enumerate(at)}
    images = pictured(head, cameras, meshes)
    take = RecordedTake(places, np.ones(150, bool), wrong, images, metric=True)
    for dense, landmarks in ((False, wrong), (True, right)):
        first = fit_head(head, replace(take, landmarks=landmarks))
        fit = fit_surface(head, first, take, Workers(Helpers(1)), dense=dense)
        assert fit.static_offset is not None
        slips = [in_cameras_world(fit, t) - mesh for t, mesh in enumerate(meshes)]
        errors.append(norm(slips, axis=2)[:, front].mean())
    assert errors[1] < share * errors[0]


def no_image(*_):
    pytest.fail("no image is needed")


# Outlines in masks, against a ball whose outline is known


CAMERA = look_at((0.3, 0.1, 1.0), (0.01, 0, 0), 120, 160, 500)


def ball(radius):
    """Vertices and triangles of a ball, and a thousand unit directions to its surface."""
    mesh = trimesh.creation.icosphere(4, radius)
    directions = default_rng(0)
    directions = directions.normal(size=(1000, 3))
    directions /= norm(directions, axis=1, keepdims=True)
    return np.array(mesh.vertices), np.array(mesh.faces), directions


def ball_mask(camera, grid=8):
    """The ball's mask with soft edges: rays through `grid` × `grid` places of each pixel."""
    rays = rays_of(camera, grid)
    hits = (rays @ camera.position) ** 2 > camera.position @ camera.position - RADIUS_M**2
    shares = hits.reshape(camera.height, grid, camera.width, grid).mean((1, 3))
    return (255 * shares).astype(np.uint8)


def measured(radius, mask, reach=0.005):
    vertices, faces, directions = ball(radius)
    surface = PosedSurface(vertices, faces, radius * directions, directions)
    return outline_offsets(CAMERA, mask, surface, reach)


@pytest.mark.parametrize("offset", [-0.003, 0.0, 0.002])
def test_outlines_tell_how_far_the_surface_is_off(offset):
    """Catches a wrong sign, half a pixel, or points beside the outline taken for points on it: 2 mm
    a pixel."""
    found, known = measured(RADIUS_M - offset, ball_mask(CAMERA))
    assert known.sum() > 150
    assert abs(np.median(found[known]) - offset) < 1e-4
    assert np.abs(found[known] - offset).max() < 8e-4
    assert not found[~known].any()


def test_what_the_mask_does_not_show_is_left_open():
    """Catches an outline made up where something stands behind the head, or the mask ends
    elsewhere."""
    mask = ball_mask(CAMERA)
    mask[80:] = 255  # shoulders
    _, known = measured(RADIUS_M, mask)
    pixels, _ = CAMERA.project(RADIUS_M * ball(RADIUS_M)[2])
    assert known.sum() > 60
    assert not known[pixels[:, 1] > 84].any()
    assert not measured(RADIUS_M, np.full_like(mask, 255))[1].any()
    assert not measured(RADIUS_M - 0.02, ball_mask(CAMERA))[1].any()


def test_mattes_that_are_too_wide_are_not_followed(head):
    """Catches a face that grows by a matte's margin, or by hair: those of real captures are a pixel
    or two too wide."""
    places = places_on(head, 150)
    used = np.ones(150, bool)
    frame = frame_at(head, 0)
    shape = np.zeros(head.model.n_identity)
    mesh = flame_forward(head.model, shape, frame)
    faces = head.model.faces
    fit = HeadFit(person(head, shape), shape, {0: frame.parameters}, HERE)
    points = surface_points(head, 2000)
    take = RecordedTake(places, used, {}, no_image)
    near = near_landmarks(head, points, take)
    sweep = Sweep(0.003, 0.0005, 0.001)
    for wide, agree in ((0, True), (2, False)):
        shown = []
        for camera in rig(5):
            mask = rasterize(mesh, faces, camera)[0] >= 0
            mask = binary_dilation(mask, iterations=wide) if wide else mask
            shown.append((camera, 255 * mask.astype(np.uint8)))
        masked = replace(take, masks=lambda t, own=shown: own)
        assert outlines_agree(fit, masked, SurfaceSearch(points, near, sweep)) is agree
    assert not outlines_agree(fit, take, SurfaceSearch(points, np.ones(len(points), bool), sweep))
