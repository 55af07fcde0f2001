"""Images of splats by EEVEE and Cycles, against the CPU rasterizer's."""

from dataclasses import replace

import bpy
import numpy as np
import pytest
from avatar.conftest import splats_of
from numpy.testing import assert_allclose, assert_array_equal
from refusal import refusal

from stga_addon.avatar.embedding import WORLD
from stga_addon.avatar.splats import SH_C0
from stga_addon.capture.color import linear_to_srgb, srgb_to_linear
from stga_addon.light.relight import Relighter
from stga_addon.raster.cpu.compose import compose
from stga_addon.raster.posed_splats import PosedSplats
from stga_addon.scene.cameras import render_camera
from stga_addon.scene.compat import enable_nodes
from stga_addon.scene.display.splat_nodes import DISPLAY, QUADS
from stga_addon.scene.display.splat_object import set_input, show_world_splats
from stga_addon.scene.gpu.context import has_gpu_context
from stga_addon.scene.render.scene_splats import (
    forget_frame,
    relight_frame,
)

from .session import ops, picture, shown_layers
from .test_engine import add_sun, camera_at, show, textured, with_light
from .test_panel import draw
from .test_splat_object import active_camera, avatar_of, displayed_colors

SIZE_PX = 64
SAMPLES = 4
MIN_PSNR_DB = 33.0
"""Quads end at three standard deviations, and the rasterizer blurs what is smaller than a pixel."""
EEVEE = "BLENDER_EEVEE" if bpy.app.version >= (5, 0) else "BLENDER_EEVEE_NEXT"
EEVEE_MARKS = (
    pytest.mark.slow,  # compiling its shaders takes most of a minute
    pytest.mark.skipif(not has_gpu_context(), reason="Blender gets no GPU context: no EGL driver"),
)


def overlapping_splats():
    """Translucent splats of two colors, which tell the order in which they are blended."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(400, 3))
    xyz = 0.1 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    colors = np.where(xyz[:, 2:] > 0, (1.2, -0.3, -0.8), (-0.8, 0.2, 1.2))
    return splats_of(
        xyz,
        rotation=rng.normal(size=(400, 4)),
        log_scale=rng.normal(-4.5, 0.3, (400, 3)),
        opacity=rng.normal(1.0, 1.0, 400),
        sh=colors[:, None],
    )


def blended_in_linear_light(splats, view):
    """(3, H, W) sRGB over black as both engines blend: rasterized with linear colors."""
    linear = srgb_to_linear(np.clip(0.5 + SH_C0 * splats.sh.astype(np.float64), 0, 1))
    splats = replace(splats, sh=((linear - 0.5) / SH_C0).astype(np.float32))
    image = compose([PosedSplats(splats, WORLD, np.eye(4))], view)
    return np.asarray(linear_to_srgb(np.clip(image.rgb, 0, 1)))


@pytest.mark.parametrize("engine", [pytest.param(EEVEE, marks=EEVEE_MARKS), "CYCLES"])
def test_images_without_noise(engine, tmp_path):
    """Catches splats out of order, black holes behind the eighth, and noisy transparency."""
    scene = bpy.context.scene
    splats = overlapping_splats()
    set_input(show_world_splats(splats, "ball"), DISPLAY, QUADS)
    camera = active_camera((0, 0, 0.6))
    camera.data.lens = 80
    scene.world = bpy.data.worlds.new("black")
    enable_nodes(scene.world).nodes["Background"].inputs["Color"].default_value = (0, 0, 0, 1)
    scene.view_settings.view_transform = "Standard"
    found = picture(tmp_path / "image.png", engine, SIZE_PX, SAMPLES)[..., :3] / 255
    depsgraph = bpy.context.evaluated_depsgraph_get()
    view = render_camera(camera.evaluated_get(depsgraph), depsgraph, SIZE_PX, SIZE_PX)
    expected = blended_in_linear_light(splats, view)
    psnr_db = -10 * np.log10(np.mean((found.transpose(2, 0, 1) - expected) ** 2))
    print(f"{engine}: {psnr_db:.1f} dB")
    assert expected.mean() > 0.1, "nothing to compare"
    assert psnr_db >= MIN_PSNR_DB


def test_images_of_recorded_light_say_so(extension, tmp_path, capsys):
    """Catches F12 and animations in another light that do not say so, or do each image."""
    scene = bpy.context.scene
    cast = "the light of this frame"
    shown, _ = show(with_light(textured(avatar_of("stga"))))
    camera_at()
    add_sun()
    scene.stga.splats = shown
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 1
    scene.render.resolution_x = scene.render.resolution_y = 8
    scene.render.filepath = f"{tmp_path}/"
    scene.frame_start = 5
    scene.frame_end = 7

    def said(**how):
        bpy.ops.render.render(**how)
        return capsys.readouterr().out

    assert cast not in said()
    scene.stga_lighting.mode = "scene"
    assert "render colors as recorded" in said()
    assert any(cast in text for text in draw(extension, "lighting"))
    ops.relight_frame()
    assert cast not in said()
    assert not any(cast in text for text in draw(extension, "lighting"))
    text = said(animation=True)
    assert "render the light of frame 5" in text
    assert text.count(cast) == 1
    scene.frame_set(6)
    assert cast in said()
    ops.relight_frame()
    assert cast not in said()
    ops.relight_frame(clear=True)
    assert "render colors as recorded" in said()
    shown.hide_render = True
    assert cast not in said()


def test_relit_color_of_a_frame(lighting):
    """Catches relit colors that do not reach the nodes, or stay when taken back, and the advice to
    light an avatar that is hidden."""
    avatar = with_light(textured(avatar_of("stga")))
    shown, _ = show(avatar)
    camera = camera_at()
    before = displayed_colors(shown)
    add_sun(3.0)
    with refusal("as recorded"):
        relight_frame(shown, bpy.context.scene)
    lighting.mode = "scene"
    shown.visible_camera = False
    with refusal("hidden from the camera"):
        relight_frame(shown, bpy.context.scene)
    shown.visible_camera = True
    relight_frame(shown, bpy.context.scene)
    (layer,) = shown_layers()
    eye = layer.eye_in_avatar(np.array(camera.matrix_world)[:3, 3])
    relit = Relighter(avatar).radiance(layer.relit.mesh, eye, layer.relit.lighting)
    assert_allclose(displayed_colors(shown), np.maximum(relit, 0), atol=2e-3)
    assert np.abs(displayed_colors(shown) - before).mean() > 0.05
    assert forget_frame(shown)
    assert_array_equal(displayed_colors(shown), before)
