"""Inverses of view transforms that are kept for rendering, of several scenes and of animated settings."""

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from stga_addon.scene.render import view_transform  # noqa: E402
from stga_addon.scene.render.view_transform import inverse_view, measure  # noqa: E402


def scene_with(view: str, exposure: float = 0.0):
    scene = bpy.data.scenes.new(view)
    scene.view_settings.view_transform, scene.view_settings.exposure = view, exposure
    return scene


def test_scenes_with_different_view_transforms():
    """Catches a render of two scenes in which only the scene measured last shows the trained colors."""
    scenes = [scene_with("AgX"), scene_with("Standard", exposure=1.0)]
    for scene in scenes:
        measure(scene)
    gray = np.full((1, 3), 0.5)
    agx, brighter = (inverse_view(scene) for scene in scenes)
    assert agx is not None
    assert np.abs(agx.show(agx.to_linear(gray)) - gray).max() < 0.01
    # sRGB's curve turns 0.5 into 0.214, of which an exposure of one stop leaves half.
    assert brighter.to_linear(gray) == pytest.approx(0.107, abs=0.002)
    assert np.abs(agx.to_linear(gray) - 0.107).min() > 0.01


def test_an_animated_exposure_keeps_a_few(monkeypatch):
    """Catches a table per frame of an animation that stays in memory, and one of a scene that is rendered with each
    frame and displaced by them."""
    monkeypatch.setattr(view_transform, "_measured", {})
    monkeypatch.setattr(view_transform, "_shown", lambda scene, axis: scene.view_settings.exposure)
    monkeypatch.setattr(view_transform, "InverseView", lambda axis, exposure: exposure)
    still, animated = scene_with("Filmic", exposure=-3.0), scene_with("AgX")
    for frame in range(50):
        animated.view_settings.exposure = 0.1 * frame
        measure(still)
        measure(animated)
        assert inverse_view(still) == -3
        assert inverse_view(animated) == pytest.approx(0.1 * frame)
        assert len(view_transform._measured) <= 8
    animated.view_settings.exposure = 4.8
    assert inverse_view(animated) is not None
