"""What is fitted for renderers that blend in linear light, by pictures that are blended so here."""

from dataclasses import replace

import numpy as np
import pytest
from capture.factory import ball, write_mesh_capture
from numpy.testing import assert_allclose, assert_array_equal
from refusal import refusal

from stga_addon.avatar.embedding import to_world
from stga_addon.avatar.file import Avatar, read_avatar, write_avatar
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.avatar.splats import SH_C0, sh_color
from stga_addon.capture.color import linear_to_srgb, srgb_to_linear
from stga_addon.capture.open import open_capture
from stga_addon.export.formats import export_avatar
from stga_addon.export.ply import read_ply
from stga_addon.progress import Cancelled
from stga_addon.render.linear_fit import fit_linear
from stga_addon.render.render import render, render_avatar


def hairy_avatar():
    """A ball of translucent splats, light over dark, whose colors depend on the view."""
    vertices, faces = ball()
    splats = lattice_splats(vertices, faces.astype(np.int32), sh_degree=1)
    rng = np.random.default_rng(0)
    count = len(splats)
    sh = rng.normal(0, 0.1, (count, 4, 3))
    sh[:, 0] = rng.choice((-1.3, 1.2), count)[:, None]
    opacity = rng.normal(-1, 1, count).astype(np.float32)
    splats = replace(splats, sh=sh.astype(np.float32), opacity=opacity)
    return Avatar(splats, "stga", vertices.astype(np.float32), faces.astype(np.int32))


def blended_linearly(avatar, mesh, camera, gray):
    """(3, H, W) sRGB: what Cycles would see without noise."""
    frames = avatar.frames(mesh)
    world = to_world(avatar.splats, frames)
    direction = world.xyz - camera.position
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    linear = srgb_to_linear(np.clip(sh_color(world.sh, direction), 0, None))
    sh = ((linear - 0.5) / SH_C0).astype(np.float32)[:, None]
    behind = float(srgb_to_linear(np.array(gray)))
    picture = render(replace(avatar.splats, sh=sh), camera, (behind,) * 3, frames)
    return np.asarray(linear_to_srgb(picture))


def test_blending_linearly_shows_what_was_trained(tmp_path):
    """Catches a fit that is worse on one background or in a view that it has not seen, that turns
    harmonics or a head's pose, changes what was trained, or goes on after *Cancel*."""
    root = write_mesh_capture(tmp_path / "capture")
    capture = open_capture(root)
    avatar = hairy_avatar()
    fitted = replace(avatar, linear_base=fit_linear(avatar, capture))
    assert fitted.splats is avatar.splats
    for gray in (0.0, 1.0):
        errors = []
        for each in (avatar, fitted.for_linear_light):
            for view in capture.views["val"][:3]:
                mesh = capture.mesh(view.timestep)
                trained = render_avatar(avatar, mesh, view.camera, (gray,) * 3)
                found = blended_linearly(each, mesh, view.camera, gray)
                errors.append(np.square(found - trained).mean())
        before, after = np.reshape(errors, (2, -1)).mean(1)
        assert 10 * np.log10(before / after) > 4, gray
    assert_array_equal(fitted.for_linear_light.splats.sh[:, 1:], avatar.splats.sh[:, 1:])
    with refusal("has no training views"):
        fit_linear(avatar, replace(capture, views={}))
    told = []
    with pytest.raises(Cancelled):
        fit_linear(avatar, capture, lambda progress: told.append(progress) or len(told) > 2)
    assert len(told) == 3


def test_files_keep_both(tmp_path):
    """Catches a fit that is lost in the file, of the wrong shape, in a file for viewers that blend
    as trained, or missing in USD, whose renderers do not."""
    avatar = hairy_avatar()
    base = np.column_stack([avatar.splats.sh[:, 0] * 0.5, avatar.splats.opacity - 1])
    avatar = replace(avatar, linear_base=base)
    write_avatar(tmp_path / "a.npz", avatar)
    read = read_avatar(tmp_path / "a.npz")
    assert_array_equal(read.linear_base, base)
    with refusal("linear_base is float32"):
        write_avatar(tmp_path / "b.npz", replace(avatar, linear_base=base[1:]))
    export_avatar(tmp_path / "a.ply", read, "ply", [(0, avatar.neutral)])
    assert_array_equal(read_ply(tmp_path / "a.ply").opacity, avatar.splats.opacity)
    usd = pytest.importorskip("pxr.Usd", reason="the package usd-core is not installed")
    export_avatar(tmp_path / "a.usdc", read, "usd", [(0, avatar.neutral)])
    stage = usd.Stage.Open(str(tmp_path / "a.usdc"))
    opacity = stage.GetPrimAtPath("/Avatar/Splats").GetAttribute("opacities").Get(0)
    assert_allclose(opacity, 1 / (1 + np.exp(-base[:, 3])), atol=1e-6)
