"""Residuals per triangle."""

from dataclasses import replace

import numpy as np

from stga_addon.avatar.file import Avatar
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.avatar.splats import SH_C0
from stga_addon.capture.images import read_image
from stga_addon.capture.model import Capture
from stga_addon.render.render import render_avatar
from stga_addon.training.evaluate.residuals import MIN_WEIGHT_PX, Residuals, triangle_residuals


def plain_avatar(capture: Capture, level: float) -> Avatar:
    """The capture's mesh in one gray; levels below zero are shown as black."""
    splats = lattice_splats(capture.neutral, capture.faces, 1, 0)
    sh = np.full_like(splats.sh, (level - 0.5) / SH_C0)
    return Avatar(replace(splats, sh=sh), "stga", capture.neutral.astype(np.float32), capture.faces)


def test_an_error_belongs_to_the_triangles_that_show_it(toy: Capture) -> None:
    """Catches weights that depend on colors, as a gradient does where a color is clamped at black,
    and errors given to hidden or neighboring triangles. The weights are rendered: one triangle
    white, all others black, before black."""
    avatar, views = plain_avatar(toy, -0.2), toy.views["train"][:2]
    found = triangle_residuals(avatar, toy, views)
    seen = np.flatnonzero(found.weight > 20)[::12]
    assert len(seen) > 3
    for triangle in seen:
        weight = error = 0.0
        for view in views:
            mesh = toy.mesh(view.timestep)
            shown = render_avatar(avatar, mesh, view.camera)
            difference = np.abs(shown - read_image(view).transpose(2, 0, 1) / 255).mean(0)
            sh = (
                np.where((avatar.splats.face == triangle)[:, None, None], 0.5, -0.5).astype(
                    np.float32
                )
                / SH_C0
            )
            sh = np.broadcast_to(sh, avatar.splats.sh.shape).astype(np.float32)
            alone = replace(avatar, splats=replace(avatar.splats, sh=sh))
            share = render_avatar(alone, mesh, view.camera, (0.0, 0.0, 0.0))[0]
            weight, error = weight + float(share.sum()), error + float((share * difference).sum())
        np.testing.assert_allclose(
            [found.weight[triangle], found.error[triangle]], [weight, error], rtol=2e-3
        )


def test_triangles_that_nothing_shows_are_unknown() -> None:
    """Catches a triangle at the back of the head that is called perfect because no camera sees
    it."""
    residuals = Residuals(np.array([1.0, 0.0, 3.0]), np.array([4.0, MIN_WEIGHT_PX / 2, 6.0]))
    np.testing.assert_array_equal(residuals.mean(), [0.25, np.nan, 0.5])
    np.testing.assert_array_equal((residuals + residuals).mean(), [0.25, 0.0, 0.5])
