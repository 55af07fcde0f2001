"""Outlines in masks, against a ball whose outline is known."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from flame.small_head import small_head
from scipy.ndimage import binary_dilation

from stga_addon.capture.camera import look_at
from stga_addon.capture.mesh_geometry import Similarity, rasterize
from stga_addon.flame.forward import flame_forward
from stga_addon.tracking.fit import HeadFit
from stga_addon.tracking.head_model import HeadModel
from stga_addon.tracking.seen_surface import (
    RecordedTake,
    near_landmarks,
    no_masks,
    outline_offsets,
    outlines_agree,
    surface_points,
)
from stga_addon.tracking.solve import person

from .test_fit import frame_at, places_on
from .test_surface import rig

RADIUS_M = 0.09
CAMERA = look_at((0.3, 0.1, 1.0), (0.01, 0, 0), 120, 160, 500)


def ball(radius):
    """Vertices and triangles of a ball, and a thousand unit directions to its surface."""
    mesh = trimesh.creation.icosphere(4, radius)
    directions = np.random.default_rng(0).normal(size=(1000, 3))
    return (
        np.array(mesh.vertices),
        np.array(mesh.faces),
        directions / np.linalg.norm(directions, axis=1, keepdims=True),
    )


def ball_mask(camera, grid=8):
    """The ball's mask with soft edges: rays through `grid` × `grid` places of each pixel."""
    y, x = (np.indices((grid * camera.height, grid * camera.width)) + 0.5) / grid
    rays = np.stack(
        [(x - camera.cx) / camera.fl_x, (y - camera.cy) / camera.fl_y, np.ones(x.shape)], -1
    )
    rays = rays @ camera.world_to_camera[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    hits = (rays @ camera.position) ** 2 > camera.position @ camera.position - RADIUS_M**2
    return (255 * hits.reshape(camera.height, grid, camera.width, grid).mean((1, 3))).astype(
        np.uint8
    )


def measured(radius, mask, reach=0.005):
    vertices, faces, directions = ball(radius)
    return outline_offsets(CAMERA, mask, vertices, faces, radius * directions, directions, reach)


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


def test_mattes_that_are_too_wide_are_not_followed():
    """Catches a face that grows by a matte's margin, or by hair: those of real captures are a pixel
    or two too wide."""
    head, cameras = HeadModel(small_head(0), "flame"), rig(5)
    places, used = places_on(head, 150), np.ones(150, bool)
    shape, frame = np.zeros(head.model.n_identity), frame_at(head, 0)
    mesh, world = flame_forward(head.model, shape, frame), Similarity(1.0, np.eye(3), np.zeros(3))
    fit = HeadFit(person(head, shape), shape, {0: frame.parameters}, world)
    masks = [
        255 * (rasterize(mesh, head.model.faces, camera)[0] >= 0).astype(np.uint8)
        for camera in cameras
    ]
    points = surface_points(head, 2000)
    for wide, agree in ((0, True), (2, False)):
        grown = [binary_dilation(mask > 0, iterations=wide) if wide else mask > 0 for mask in masks]
        shown = [
            (camera, 255 * mask.astype(np.uint8))
            for camera, mask in zip(cameras, grown, strict=True)
        ]
        take = RecordedTake(
            places, used, {}, lambda t: pytest.fail("no image is needed"), lambda t, own=shown: own
        )
        assert outlines_agree(fit, take, points, near_landmarks(head, points, take), 0.003) is agree
    assert not outlines_agree(
        fit, replace(take, masks=no_masks), points, np.ones(len(points), bool), 0.003
    )
