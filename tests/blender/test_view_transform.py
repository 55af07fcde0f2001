"""The engine's colors through view transforms, inverses of several of which are kept."""

import bpy
import numpy as np
import pytest
from avatar.conftest import splats_of

from stga_addon.avatar.splats import SH_C0
from stga_addon.capture.color import linear_to_srgb
from stga_addon.scene.compat import choose_format
from stga_addon.scene.display.splat_object import show_world_splats
from stga_addon.scene.render import view_transform
from stga_addon.scene.render.view_transform import inverse_view, measure

from .test_engine import HEIGHT, WIDTH, _engine  # noqa: F401
from .test_splat_object import active_camera


def scene_with(view, exposure=0.0):
    scene = bpy.data.scenes.new(view)
    scene.view_settings.view_transform = view
    scene.view_settings.exposure = exposure
    return scene


def test_scenes_with_different_view_transforms():
    """Catches two scenes of which the last alone shows trained colors, and dark skin off."""
    scenes = [scene_with("AgX"), scene_with("Standard", exposure=1.0)]
    for scene in scenes:
        measure(scene)
    gray = np.full((1, 3), 0.5)
    agx, brighter = (inverse_view(scene) for scene in scenes)
    assert np.abs(agx.show(agx.to_linear(gray)) - gray).max() < 0.01
    # sRGB's curve turns 0.5 into 0.214, of which an exposure of one stop leaves half.
    assert brighter.to_linear(gray) == pytest.approx(0.107, abs=0.002)
    assert np.abs(agx.to_linear(gray) - 0.107).min() > 0.01
    rng = np.random.default_rng(0)
    skin = rng.uniform(0.1, 1.3, (4000, 1)) * [0.75, 0.55, 0.45] + rng.normal(0, 0.04, (4000, 3))
    scene = scene_with("AgX")
    skin = np.clip(skin, 0, 1)
    measure(scene)
    agx = inverse_view(scene)
    difference = 255 * np.abs(agx.show(agx.to_linear(skin)) - skin)
    assert difference.mean() < 0.5  # 0.41; levels of 8 bits
    assert np.percentile(difference, 99) < 6  # 4.6


def test_curves_are_told_apart():
    """Catches colors of other curves: a black or white level, or a handle, that was changed."""
    scene = scene_with("Standard")
    scene.view_settings.use_curve_mapping = True
    curves = scene.view_settings.curve_mapping
    linear = np.array([[0.3, 0.4, 0.5]])
    trained = linear_to_srgb(linear)
    for black, white in ((0.0, 1.0), (0.1, 1.0), (0.2, 1.0), (0.2, 0.8)):
        curves.black_level = (black, 0, black)
        curves.white_level = (1, white, 1)
        curves.update()
        measure(scene)
        low = np.array([black, 0, black])
        expected = low + linear * (np.array([1, white, 1]) - low)
        np.testing.assert_allclose(inverse_view(scene).to_linear(trained), expected, atol=0.01)
    curves.curves[3].points[0].handle_type = "VECTOR"
    assert inverse_view(scene) is None


def test_an_animated_exposure_keeps_a_few(monkeypatch):
    """Catches a table per frame that stays in memory, and a still scene's displaced."""
    monkeypatch.setattr(view_transform, "_measured", {})
    monkeypatch.setattr(view_transform, "_inverse", lambda scene: scene.view_settings.exposure)
    still = scene_with("Filmic", exposure=-3.0)
    animated = scene_with("AgX")
    for frame in range(50):
        animated.view_settings.exposure = 0.1 * frame
        measure(still)
        measure(animated)
        assert inverse_view(still) == -3
        assert inverse_view(animated) == pytest.approx(0.1 * frame)
        assert len(view_transform._measured) <= 8
    animated.view_settings.exposure = 4.8
    assert inverse_view(animated) is not None


def sheet(color=None):
    """A sheet of soft splats of one color, else of mid-tones of skin, in front of the camera."""
    rng = np.random.default_rng(8)
    count = 600
    skin = rng.uniform(0.3, 0.75, (count, 1)) * [1, 0.8, 0.68] + rng.normal(0, 0.02, (count, 3))
    colors = skin if color is None else np.array([color])
    xyz = np.column_stack([rng.uniform(-0.35, 0.35, (count, 2)), np.zeros(count)])
    sh = (colors[:, None] - 0.5) / SH_C0
    show_world_splats(splats_of(xyz, log_scale=-3.2, opacity=3, sh=sh), "skin")
    active_camera((0, 0, 1))


def saved_picture(folder, **view):
    """(H, W, 4) 0 to 255 of a render that Blender saves through these settings."""
    scene = bpy.context.scene
    scene.view_settings.look = "None"
    scene.view_settings.view_transform = view["view_transform"]  # which says what looks there are
    for name, value in {"exposure": 0, "gamma": 1, **view}.items():
        setattr(scene.view_settings, name, value)
    settings = scene.render.image_settings
    choose_format(settings, "IMAGE", "PNG")
    settings.color_mode = "RGBA"
    settings.color_depth = "16"
    scene.render.dither_intensity = 0
    scene.render.filepath = str(folder / "picture.png")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    image.colorspace_settings.name = "Non-Color"
    pixels = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return 255 * pixels.reshape(HEIGHT, WIDTH, 4)


def test_standard_view_transform_shows_trained_colors(tmp_path):
    """Catches colors other than trained in Standard, and a table where none is needed."""
    trained = np.array([0.8, 0.5, 0.1])
    scene = bpy.context.scene
    sheet(trained)
    for name, needed in (("Standard", False), ("Raw", False), ("AgX", True)):
        scene.view_settings.view_transform = name
        assert view_transform.needs_inverse(scene) == needed
    middle = saved_picture(tmp_path, view_transform="Standard")[HEIGHT // 2, WIDTH // 2]
    np.testing.assert_allclose(middle[:3], 255 * trained, atol=0.6)
    assert middle[3] > 0.99 * 255


CONTRAST = {"look": "AgX - Medium High Contrast", "exposure": 0.5, "gamma": 1.1}


@pytest.mark.parametrize("transparent", [True, False])
@pytest.mark.parametrize(
    "view",
    [
        {"view_transform": "Filmic"},
        {"view_transform": "AgX", **CONTRAST},
        {"view_transform": "Standard", "exposure": -0.5},
    ],
)
def test_view_transforms_show_trained_colors(view, transparent, tmp_path):
    """Catches colors that AgX or Filmic changes, and data that a measurement leaves."""
    sheet()
    bpy.context.scene.render.film_transparent = transparent
    trained = saved_picture(tmp_path, view_transform="Standard")
    before = len(bpy.data.images), len(bpy.data.scenes)
    shown = saved_picture(tmp_path, **view)
    assert (len(bpy.data.images), len(bpy.data.scenes)) == before
    covered = (trained[..., 3] > 128) & (trained[..., :3].min(-1) > 30)
    assert covered.mean() > 0.3
    difference = np.abs(shown - trained)[covered]
    assert difference.mean() <= 1.5
    assert np.percentile(difference, 99) <= 6
