"""Heads moved onto the surface that the cameras see, against surfaces that are known."""

import numpy as np
import pytest
from flame.small_head import small_head

from stga_addon.capture.camera import look_at
from stga_addon.flame.forward import flame_forward
from stga_addon.tracking.fit import fit_head
from stga_addon.tracking.head_model import HeadModel
from stga_addon.tracking.mesh_image import shaded_image
from stga_addon.tracking.photo_consistency import (
    Sweep,
    facing,
    gray_view,
    in_sight,
    surface_offsets,
)
from stga_addon.tracking.posed_points import SurfacePoints
from stga_addon.tracking.seen_surface import RecordedTake, surface_points
from stga_addon.tracking.smooth_offsets import smooth_offsets
from stga_addon.tracking.surface import fit_surface
from stga_addon.tracking.write_capture import posed_mesh
from stga_addon.worker.helpers import Helpers

from .test_fit import frame_at, places_on, seen

RADIUS_M = 0.09
SWEEP = Sweep(0.004, 0.0005, 0.001)


@pytest.fixture(scope="module")
def head():
    return HeadModel(small_head(0), "flame")


def rig(count, size=400):
    eyes = [
        (np.sin(a), 0.15 * (-1) ** k, np.cos(a))
        for k, a in enumerate(np.linspace(-0.5, 0.5, count))
    ]
    return [look_at(eye, (0, 0, 0), size, size, 3.4 * size) for eye in eyes]


def sphere_image(camera, contrast=1.0):
    """A ball with waves of several lengths on it, seen by intersecting rays with it: no mesh and no
    rasterizer."""
    y, x = np.indices((camera.height, camera.width)) + 0.5
    local = np.stack(
        [(x - camera.cx) / camera.fl_x, (y - camera.cy) / camera.fl_y, np.ones(x.shape)], -1
    )
    rays = local @ camera.world_to_camera[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    middle = -rays @ camera.position
    inside = middle**2 - (camera.position @ camera.position - RADIUS_M**2)
    at = camera.position + (middle - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
    rng = np.random.default_rng(3)
    level = sum(
        np.sin(at @ rng.normal(0, 1.5 / length, 3) + rng.uniform(0, 6))
        for length in (0.002, 0.003, 0.004) * 4
    )
    gray = np.where(inside > 0, 128 + 14 * contrast * level, 255)
    return np.repeat(np.clip(gray, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def ball_points():
    """Unit directions to the front of a ball."""
    directions = np.random.default_rng(0).normal(size=(60, 3)) * [1, 1, 0.5] + [0, 0, 2]
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("offset", [-0.0018, 0.0, 0.0023])
def test_offsets_lead_to_the_surface_in_the_images(offset):
    """Catches a wrong sign, a pixel center that is off by half, or a wrong patch: the ball would be
    missed."""
    cameras, normals = rig(5), ball_points()
    points = (RADIUS_M - offset) * normals
    views = [
        gray_view(camera, sphere_image(camera), np.zeros(3), SWEEP.spacing) for camera in cameras
    ]
    cosines = np.stack([facing(camera, points, normals) for camera in cameras])
    found, correlation = surface_offsets(views, cosines, points, normals, SWEEP)
    assert (correlation > 0.8).mean() > 0.9
    assert np.median(np.abs(found - offset)[correlation > 0]) < 1e-4
    assert np.percentile(np.abs(found - offset)[correlation > 0.8], 95) < 3e-4


def test_nothing_is_found_without_texture_or_with_one_camera():
    """Catches noise taken for a surface, which would move the head at random."""
    cameras, normals = rig(5), ball_points()
    points = RADIUS_M * normals
    cosines = np.stack([facing(camera, points, normals) for camera in cameras])
    plain = [
        gray_view(camera, sphere_image(camera, 0), np.zeros(3), SWEEP.spacing) for camera in cameras
    ]
    assert not surface_offsets(plain, cosines, points, normals, SWEEP)[1].any()
    views = [
        gray_view(camera, sphere_image(camera), np.zeros(3), SWEEP.spacing) for camera in cameras
    ]
    alone = cosines * (np.arange(5) == 2)[:, None]
    assert not surface_offsets(views, alone, points, normals, SWEEP)[1].any()


def test_large_images_are_reduced_to_the_size_of_a_sample():
    """Catches a principal point that reduction moves, and samples that skip most pixels of a large
    image."""
    camera = look_at((0.2, 0.1, 1.0), (0, 0, 0), 1210, 900, 12000)
    rng = np.random.default_rng(0)
    view = gray_view(camera, rng.integers(0, 255, (900, 1210, 3), np.uint8), np.zeros(3), 0.001)
    factor = camera.fl_x / view.camera.fl_x
    assert factor == 11  # 0.085 mm a pixel
    assert view.image.shape == (81, 110) == (view.camera.height, view.camera.width)
    points = rng.normal(0, 0.02, (9, 3))
    np.testing.assert_allclose(
        view.camera.project(points)[0] * factor, camera.project(points)[0], atol=1e-9
    )


def test_hidden_points_are_not_in_sight(head):
    """Catches the back of the head compared in images of the face."""
    vertices, faces = head.model.v_template, head.model.faces
    points = surface_points(head, 300).on(vertices, faces)
    camera = look_at((0, 0, 1.2), (0, 0, 0), 400, 400, 1300)
    visible = in_sight(camera, vertices, faces, points)
    back, front = np.quantile(vertices[:, 2], [0.15, 0.85])
    assert visible[points[:, 2] > front].mean() > 0.8
    assert not visible[points[:, 2] < back].any()


def test_surface_points_leave_out_eyeballs_and_teeth(head):
    """Catches points on parts that reflections and lids make look elsewhere."""
    points = surface_points(head, 400)
    inner = np.concatenate(
        [head.model.masks[name] for name in ("left_eyeball", "right_eyeball", "teeth")]
    )
    assert len(points) > 250
    assert not np.isin(head.model.faces[points.face], inner).any()


def test_offsets_are_smooth_robust_and_local(head):
    """Catches outliers that dent a face, and offsets that spread to where nothing was seen."""
    vertices, faces = head.model.v_template, head.model.faces
    points = surface_points(head, 2000)
    at = points.on(vertices, faces)
    rng = np.random.default_rng(0)
    true = 0.003 * np.exp(-((at - at[at[:, 2].argmax()]) ** 2).sum(1) / 0.04**2)
    wrong = rng.random(len(at)) < 0.15
    noisy = (
        true
        + rng.normal(0, 0.0004, len(at))
        + np.where(wrong, rng.uniform(-0.004, 0.004, len(at)), 0)
    )
    front = at[:, 2] > np.median(at[:, 2])
    found = smooth_offsets(vertices, faces, points, noisy, np.where(front, 0.2, 0.0))
    error = points.on(found[:, None], faces)[:, 0] - true
    assert np.abs(error[front]).mean() < 0.0003
    back = vertices[:, 2] < np.quantile(vertices[:, 2], 0.1)
    assert np.abs(found[back]).max() < 0.0003


def test_offsets_do_not_depend_on_how_the_surface_is_cut_into_triangles():
    """Catches a Laplacian that counts neighbors: on triangles of many sizes, as the bundled head's,
    it takes a slope for a bend, and smooths the person away."""
    y, x = (0.004 * values.ravel() for values in np.indices((12, 12)))
    flat = np.column_stack([x, y]) + np.random.default_rng(0).uniform(-0.0013, 0.0013, (144, 2))
    vertices = np.column_stack([flat, np.zeros(144)])
    cell = np.flatnonzero((np.arange(144) % 12 < 11) & (np.arange(144) < 132))
    faces = np.concatenate([cell[:, None] + [0, 1, 12], cell[:, None] + [1, 13, 12]])
    points = SurfacePoints(np.arange(len(faces)), np.full((len(faces), 3), 1 / 3))
    slope = 0.001 + 0.05 * flat[:, 0]
    found = smooth_offsets(
        vertices, faces, points, points.on(slope[:, None], faces)[:, 0], np.full(len(faces), 0.1)
    )
    assert np.abs(found - slope).max() < 5e-5


def painted(head):
    """Colors of the vertices, without a pattern."""
    return np.random.default_rng(2).uniform(0.25, 1, (len(head.model.v_template), 1)) * np.ones(3)


def test_a_head_is_moved_onto_the_skin_that_the_cameras_see(head):
    """Catches a surface that does not reach the fit, or the person's own offset that is lost:
    landmarks alone, wrong by 3 mm each, leave errors of millimeters."""
    model, cameras = head.model, rig(5)
    rng = np.random.default_rng(5)
    shape, front = rng.normal(0, 0.7, model.n_identity), model.v_template[:, 2] > 0.04
    bump = 0.002 * np.sin(model.v_template[:, :1] * 60) * front[:, None] * [0, 0, 1]
    meshes = [flame_forward(model, shape, frame_at(head, t), bump) for t in (0, 6)]
    places = places_on(head, 150)
    wrong = rng.normal(0, 0.0018, (150, 3))
    landmarks = {
        t: seen(cameras, places.on(mesh, model.faces) + wrong) for t, mesh in enumerate(meshes)
    }
    pictures = [
        [(c, shaded_image(mesh, model.faces, c, painted(head))) for c in cameras] for mesh in meshes
    ]
    reliable = np.ones(150, bool)
    first = fit_head(head, places, reliable, landmarks)
    fit = fit_surface(
        head,
        first,
        RecordedTake(places, reliable, landmarks, lambda t, most=None: pictures[t]),
        Helpers(1),
    )
    errors = [
        [
            np.median(distances(one, posed_mesh(one, one.parameters[t]), meshes[t], head, front))
            for t in (0, 1)
        ]
        for one in (first, fit)
    ]
    assert np.max(errors[1]) < 0.0006 < np.min(errors[0])
    assert fit.static_offset is not None
    assert np.abs(fit.static_offset).max() > 0.001

    blank = [[(c, np.full_like(image, 90)) for c, image in own] for own in pictures]
    assert (
        fit_surface(
            head,
            first,
            RecordedTake(places, reliable, landmarks, lambda t, most=None: blank[t]),
            Helpers(1),
        )
        is first
    )


def test_one_timestep_does_not_tell_the_errors_of_landmarks(head, monkeypatch):
    """Catches landmarks that count as corrected for the person, although their errors may be the
    one expression."""
    model, cameras, places, reliable = head.model, rig(5), places_on(head, 150), np.ones(150, bool)
    mesh = flame_forward(model, np.zeros(model.n_identity), frame_at(head, 6))
    wrong = np.random.default_rng(5).normal(0, 0.0018, (150, 3))
    landmarks = {0: seen(cameras, places.on(mesh, model.faces) + wrong)}
    pictures = [(c, shaded_image(mesh, model.faces, c, painted(head))) for c in cameras]
    take, found = RecordedTake(places, reliable, landmarks, lambda t, most=None: pictures), []
    first = fit_head(head, places, reliable, landmarks)
    for share in (0.2, 5.0):
        monkeypatch.setattr("stga_addon.tracking.surface.TAKE_LANDMARK_SHARE", share)
        found.append(fit_surface(head, first, take, Helpers(1)).parameters[0])
    assert np.abs(found[0] - first.parameters[0]).max() > 0.001
    assert np.array_equal(*found)


def distances(fit, found, true, head, front):
    """Distances (N,) of vertices from the true surface along its normals, in meters."""
    from stga_addon.tracking.correspondence import nearest_points

    back = (found - fit.to_capture.translation) @ fit.to_capture.rotation / fit.to_capture.scale
    return nearest_points(true, head.model.faces, back[front])[1]


@pytest.mark.parametrize(("count", "share"), [(5, 0.6), (3, 0.5)])
def test_skin_slides_as_dense_tracking_has_it(head, count, share):
    """Catches poses that follow the detector's landmarks where the surface does not tell, or that
    of three cameras follow the surface: the detector has the lower face 6 mm to one side, at each
    timestep another."""
    model, cameras = head.model, rig(count, 280)
    meshes = [
        flame_forward(model, np.zeros(model.n_identity), frame_at(head, t)) for t in (0, 3, 6)
    ]
    places, reliable, front = (
        places_on(head, 150), np.ones(150, bool), model.v_template[:, 2] > 0.04,
    )  # fmt: skip
    lower = (places.on(model.v_template, model.faces)[:, 1] < 0)[:, None] * [0.006, 0, 0]
    right = {t: seen(cameras, places.on(mesh, model.faces)) for t, mesh in enumerate(meshes)}
    wrong = {
        t: seen(cameras, places.on(mesh, model.faces) + (t - 1) * lower)
        for t, mesh in enumerate(meshes)
    }
    pictures = [
        [(c, shaded_image(mesh, model.faces, c, painted(head))) for c in cameras] for mesh in meshes
    ]
    take, errors = (
        RecordedTake(places, reliable, wrong, lambda t, most=None: pictures[t], metric=True),
        [],
    )
    for dense, landmarks in ((False, wrong), (True, right)):
        first = fit_head(head, places, reliable, landmarks, metric=True)
        fit = fit_surface(head, first, take, Helpers(1), dense=dense)
        assert fit.static_offset is not None
        errors.append(np.mean([slip(fit, t, mesh)[front].mean() for t, mesh in enumerate(meshes)]))
    assert errors[1] < share * errors[0]


def slip(fit, timestep, true):
    """Distances (V,) of vertices from the true ones, in meters."""
    world, mesh = fit.to_capture, posed_mesh(fit, fit.parameters[timestep])
    return np.linalg.norm((mesh - world.translation) @ world.rotation / world.scale - true, axis=1)


def test_one_camera_leaves_the_fit_as_it_is(head):
    """Catches a surface made up from one camera."""
    places = places_on(head, 100)
    mesh = flame_forward(head.model, np.zeros(head.model.n_identity), frame_at(head, 0))
    landmarks = {0: seen(rig(1), places.on(mesh, head.model.faces))}
    fit = fit_head(head, places, np.ones(100, bool), landmarks)
    take = RecordedTake(
        places, np.ones(100, bool), landmarks, lambda t: pytest.fail("no image is needed")
    )
    assert fit_surface(head, fit, take, Helpers(1)) is fit
