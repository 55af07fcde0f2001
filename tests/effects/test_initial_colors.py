"""Colors that splats start with, on a ball whose triangles' colors are known."""

from dataclasses import replace

import numpy as np

from stga_addon.avatar.splats import SH_C0
from stga_addon.training.optimize.initial_colors import triangle_colors
from stga_addon.training.optimize.initial_splats import initial_splats
from stga_addon.training.settings import make_settings

from .scenes import own_colors


def test_splats_start_with_the_colors_of_the_images(painted):
    """Catches colors of other triangles, mirrored images, channels in another order, and colors mixed with white."""
    capture = painted()
    splats = initial_splats(capture, make_settings(iterations=1, lattice=1, hull_points=False))
    found = 255 * (0.5 + SH_C0 * splats.sh[:, 0])
    error = np.abs(found - own_colors(capture)[splats.face]).max(axis=1)
    front = capture.neutral[capture.faces[splats.face]].mean(1)[:, 2] > 0.03
    assert front.mean() > 0.3
    assert np.median(error[front]) < 3
    assert np.percentile(error[front], 95) < 15
    assert not splats.sh[:, 1:].any()


def test_what_no_view_shows_has_the_nearest_color(painted):
    """Catches a gray back of the head, which shows as soon as the avatar is turned."""
    capture = painted()
    colors = triangle_colors(capture, capture.views["train"][:1])
    center = capture.neutral[capture.faces].mean(1)
    direction = center - capture.views["train"][0].camera.position
    hidden = (direction * center).sum(1) > 0.005  # well behind the ball's outline
    assert hidden.mean() > 0.2
    shown = colors[~hidden]
    gap = np.abs(colors[hidden][:, None] - shown[None]).max(axis=2).min(axis=1)
    assert gap.max() < 1e-6  # a color that some visible triangle has
    assert np.abs(255 * colors[hidden] - 127.5).max() > 20


def test_masks_that_show_nothing_give_gray(painted, tmp_path):
    """Catches a division by zero where no triangle is seen."""
    capture = painted()
    views = [replace(view, camera=replace(view.camera, cx=-1000.0)) for view in capture.views["train"][:2]]
    np.testing.assert_array_equal(triangle_colors(capture, views), 0.5)
