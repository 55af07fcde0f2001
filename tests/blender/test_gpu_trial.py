"""The trial of Blender's GPU module before its first picture, with shaders broken on purpose."""

import math

import bpy
import pytest

from stga_addon.raster.cpu.compose import compose
from stga_addon.scene.gpu import renderer, shaders, trial
from stga_addon.scene.gpu.buffers import EXACT
from stga_addon.scene.gpu.renderer import COMPACT, SplatRenderer
from stga_addon.scene.gpu.trial import WrongPicture
from stga_addon.scene.render import engine, viewport_display
from stga_addon.scene.render.viewport_display import GpuDisplay

from .gpu_context import run_with_gpu
from .session import viewport
from .test_gpu_renderer import needs_gpu

BROKEN = {
    "one texture for all": ("_SPLAT_VERTEX", "texelFetch(places", "texelFetch(shades"),
    "first instance only": ("_SPLAT_VERTEX", "(first_block + gl_InstanceID)", "first_block"),
    "wider": (
        "_SPLAT_FRAGMENT",
        "splat_alpha(shade.a, offset)",
        "splat_alpha(shade.a, 0.9 * offset)",
    ),
    "unsorted": ("_SPLAT_VERTEX", "int index =", "int index = 130 -"),
    "other colors": ("_SPLAT_FRAGMENT", "shade.rgb * alpha", "shade.bgr * alpha"),
    "no depth": ("_SPLAT_FRAGMENT", "depth * alpha", "1.1 * depth * alpha"),
}


@pytest.fixture(autouse=True)
def _first_picture(monkeypatch):
    """As in a new process."""
    monkeypatch.setattr(renderer, "_problems", {})
    monkeypatch.setattr(engine, "_reported", set())


def break_shader(monkeypatch, name):
    part, old, new = BROKEN[name]
    assert old in getattr(shaders, part)
    monkeypatch.setattr(shaders, part, getattr(shaders, part).replace(old, new))


def test_formula_of_the_trial():
    """Catches a trial that is wrong itself, and would switch off every GPU, or passes anything."""
    layer = trial._layer(hidden=5)
    image = compose([layer.posed()], trial.CAMERA, with_depth=True)
    assert trial._error(image) < trial.MAX_ERROR / 2
    trial.check(lambda *_: image, 5)
    image.rgb[0, 12, 21] = math.nan
    with pytest.raises(WrongPicture):
        trial.check(lambda *_: image, 5)


@needs_gpu
@pytest.mark.parametrize("color_format", [EXACT, COMPACT])
def test_working_shaders_pass_once(monkeypatch, color_format):
    """Catches a GPU switched off in vain, and a trial for each picture."""
    checked = []
    check = trial.check
    monkeypatch.setattr(
        trial, "check", lambda *given, **named: checked.append(check(*given, **named))
    )

    def work():
        for _ in range(3):
            SplatRenderer(color_format)

    run_with_gpu(work)
    assert checked == [None]


@needs_gpu
@pytest.mark.parametrize("name", BROKEN)
def test_broken_shaders_are_found(monkeypatch, name):
    """Catches pictures that a version of Blender, or a driver, draws wrong without an error."""
    break_shader(monkeypatch, name)
    with pytest.raises(WrongPicture, match="draws splats wrong"):
        run_with_gpu(SplatRenderer)


@needs_gpu
@pytest.mark.parametrize("is_engine", [False, True])
def test_viewports_fall_back_to_points(monkeypatch, capsys, is_engine):
    """Catches a viewport of garbage, or of nothing where the engine draws it, and a traceback or a
    sentence in each redraw."""
    break_shader(monkeypatch, "one texture for all")
    display = GpuDisplay()
    for module in (viewport_display, engine):
        monkeypatch.setattr(module, "display", display)
    monkeypatch.setattr(display, "_draw_region", lambda context: SplatRenderer(COMPACT, True))
    monkeypatch.setattr(engine, "is_drawn_by_engine", lambda context: True)
    monkeypatch.setattr(engine, "settings_values", lambda scene: ())
    monkeypatch.setattr(engine, "all_layers", lambda *_: [trial._layer(0)])
    viewport = engine.EngineViewport()

    def draw():
        for _ in range(2 if is_engine else 1):  # the display's handler is removed
            viewport.draw(bpy.context, bpy.context.evaluated_depsgraph_get())

    run_with_gpu(draw if is_engine else display._draw)
    output = capsys.readouterr()
    assert display.failed
    assert "draws splats wrong" in display.problem
    assert display.problem.endswith("points are shown")
    assert output.out.count("draws splats wrong") == 1
    assert "Traceback" not in output.err
    bpy.app.timers.unregister(viewport_display.show_points)


def test_points_are_shown_in_material_preview(monkeypatch):
    """Catches viewports of the engine, which draws no points, that stay empty."""
    shading = viewport()[1].spaces.active.shading
    shading.type = "RENDERED"
    viewport_display.show_points()
    assert shading.type == "RENDERED"
    monkeypatch.setattr(viewport_display, "ENGINE", bpy.context.scene.render.engine)
    viewport_display.show_points()
    assert shading.type == "MATERIAL"


@needs_gpu
def test_images_fall_back_to_the_rasterizer(monkeypatch):
    """Catches F12 and videos of garbage, and a warning for each frame."""
    break_shader(monkeypatch, "one texture for all")
    told = []
    images = []

    def work():
        for _ in range(2):
            images.append(engine.draw_image([trial._layer(0)], trial.CAMERA, told.append))

    run_with_gpu(work)
    assert images == [None, None]
    assert len(told) == 1
    assert "draws splats wrong" in told[0]
