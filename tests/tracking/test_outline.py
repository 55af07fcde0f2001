"""Outlines in masks, against a ball whose outline is known."""

import numpy as np
import pytest
import trimesh

from stga_addon.capture.camera import look_at
from stga_addon.tracking.outline import outline_offsets

RADIUS_M = 0.09
CAMERA = look_at((0.3, 0.1, 1.0), (0.01, 0, 0), 120, 160, 500)


def ball(radius):
    """Vertices and triangles of a ball, and a thousand unit directions to its surface."""
    mesh = trimesh.creation.icosphere(4, radius)
    directions = np.random.default_rng(0).normal(size=(1000, 3))
    return np.array(mesh.vertices), np.array(mesh.faces), directions / np.linalg.norm(directions, axis=1, keepdims=True)


def ball_mask(camera, grid=8):
    """The ball's mask with soft edges: rays through `grid` × `grid` places of each pixel."""
    y, x = (np.indices((grid * camera.height, grid * camera.width)) + 0.5) / grid
    rays = np.stack([(x - camera.cx) / camera.fl_x, (y - camera.cy) / camera.fl_y, np.ones(x.shape)], -1)
    rays = rays @ camera.world_to_camera[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    hits = (rays @ camera.position) ** 2 > camera.position @ camera.position - RADIUS_M**2
    return (255 * hits.reshape(camera.height, grid, camera.width, grid).mean((1, 3))).astype(np.uint8)


def measured(radius, mask, reach=0.005):
    vertices, faces, directions = ball(radius)
    return outline_offsets(CAMERA, mask, vertices, faces, radius * directions, directions, reach)


@pytest.mark.parametrize("offset", [-0.003, 0.0, 0.002])
def test_outlines_tell_how_far_the_surface_is_off(offset):
    """Catches a wrong sign, half a pixel, or points beside the outline taken for points on it: 2 mm a pixel."""
    found, known = measured(RADIUS_M - offset, ball_mask(CAMERA))
    assert known.sum() > 150
    assert abs(np.median(found[known]) - offset) < 1e-4
    assert np.abs(found[known] - offset).max() < 8e-4
    assert not found[~known].any()


def test_what_the_mask_does_not_show_is_left_open():
    """Catches an outline made up where something stands behind the head, or the mask ends elsewhere."""
    mask = ball_mask(CAMERA)
    mask[80:] = 255  # shoulders
    _, known = measured(RADIUS_M, mask)
    pixels, _ = CAMERA.project(RADIUS_M * ball(RADIUS_M)[2])
    assert known.sum() > 60
    assert not known[pixels[:, 1] > 84].any()
    assert not measured(RADIUS_M, np.full_like(mask, 255))[1].any()
    assert not measured(RADIUS_M - 0.02, ball_mask(CAMERA))[1].any()
