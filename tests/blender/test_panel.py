"""Panels are drawn from memory: Blender redraws them many times a second."""

import builtins
import io
import json
import os
import re
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from gui.layouts import filled

from stga_addon.progress import Progress
from stga_addon.scene import tags
from stga_addon.scene.display import splat_nodes
from stga_addon.scene.display.splat_object import set_input
from stga_addon.training.run.report import (
    CURVE_COLOR,
    DETAIL_COLOR,
    FORECAST_COLOR,
    MARGIN,
    SIZE,
    curve_image,
)

from .session import ops, panel
from .test_operators import write_ball_avatar, write_ball_run
from .test_train_operators import tick_until


@pytest.fixture
def trained(extension, worker, monkeypatch):
    """A scene whose run has finished, with curve and refined tracking, as the timer has read it."""
    ops.select(threshold=0.0005)
    run = worker.run
    monitor = extension.operators.monitor
    figures = {"psnr": 27.0, "splats": 5.0, "left_s": 70.0}
    worker.report(Progress(0.9, "Ending", figures=lambda: figures))
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines()))
    (run / "tracking.npz").write_bytes(b"")
    worker.leave()
    write_ball_avatar(run / "avatar.npz")
    tick_until(monitor, lambda: panel().result_shown)
    monkeypatch.setattr(extension.operators.timers, "has_timer", lambda: True)
    monkeypatch.setattr(monitor, "start_timer", lambda: None)
    return run


def draw(extension, name=""):
    """Draw the panels with `name` in their identifiers; the texts on them."""
    context = SimpleNamespace(
        scene=bpy.context.scene,
        region=SimpleNamespace(width=10_000),
        preferences=SimpleNamespace(
            system=SimpleNamespace(ui_scale=1.0), addons=bpy.context.preferences.addons
        ),
        space_data=SimpleNamespace(
            shading=SimpleNamespace(type="SOLID"),
            region_3d=SimpleNamespace(view_perspective="PERSP"),
        ),
        view_layer=bpy.context.view_layer,
        window_manager=bpy.context.window_manager,
        screen=SimpleNamespace(is_animation_playing=False),
    )
    panels = [cls for cls in extension.ui.panel.CLASSES if issubclass(cls, bpy.types.Panel)]
    layouts = [filled(cls, context) for cls in panels if name in cls.bl_idname]
    leaves = [leaf for layout in layouts for leaf in layout.leaves]
    for leaf in leaves:
        if leaf.kind == "prop":
            owner, prop = leaf.arguments[:2]
            assert prop.startswith("[") or hasattr(owner, prop)
    shown = [leaf for leaf in leaves if leaf.options.get("text") or leaf.kind[:4] != "prop"]
    shown = [leaf for leaf in shown if leaf.kind != "template_list"]
    return [leaf.text or leaf.kind for leaf in shown]


def test_panels(extension, trained, monkeypatch, capsys):
    """Catches files read while drawing, which block redraws, and an error without a trace, or
    repeated."""
    monitor = extension.operators.monitor
    extension.operators.training_python.has_training_python(bpy.context)

    def refuse(*arguments, **_):
        raise AssertionError(f"file access while drawing: {arguments}")

    for module, names in (
        (os, ("stat", "lstat", "listdir", "scandir", "open")),
        (builtins, ("open",)),
        (io, ("open",)),
    ):
        for name in names:
            monkeypatch.setattr(module, name, refuse)
    try:
        texts = draw(extension)
    finally:
        monkeypatch.undo()
    assert {"Trained", "template_icon", "Apply Refined Tracking", "Analyze Capture"} <= set(texts)
    monkeypatch.setattr(monitor, "_read_status", lambda scene, state: 1 / 0)
    assert monitor.tick() is None
    assert capsys.readouterr().err.count("ZeroDivisionError") == 1
    assert monitor.tick() is None
    assert "ZeroDivisionError" not in capsys.readouterr().err
    assert "Monitoring stopped after an unexpected error (ZeroDivisionError" in " ".join(
        draw(extension)
    )


def test_what_was_not_filmed_and_the_lens_are_said(extension, trained):
    """Catches a color in the viewport that nothing explains, or that is explained after it was
    turned off, and a guessed focal length that only a file tells."""
    settings = panel()
    settings.splats[tags.OBSERVED] = (
        "filmed from 30° on its right to 40° on its left; what is beyond"
    )
    settings.head[tags.FOCAL_LENGTH] = "924 px, estimated"
    settings.head[tags.TRACKED] = True
    for is_shown in (True, False):
        set_input(settings.splats, splat_nodes.SHOW_UNSEEN, is_shown)
        text = " ".join(draw(extension))
        assert ("40° on its left. Blue parts were not filmed" in text) == is_shown
    assert "Focal length: 924 px, estimated" in text


def test_a_word_for_the_quality_and_more_training(extension, trained, tmp_path):
    """Catches figures that only an expert reads, a finished run that can only be resumed, which
    trains nothing, and *Resume* where there is no run."""
    settings = panel()
    settings.run_folder = str(trained)
    settings.minutes = 3.0
    texts = draw(extension, "STGA_PT_train")
    assert "Quality: Usable" in texts
    assert not any("PSNR" in text for text in texts)
    assert {"Train", "Train 3 min More"} <= set(texts)
    (trained / "run.json").write_text("{}")
    settings.show_figures = True
    assert "PSNR 27.00 dB" in draw(extension, "STGA_PT_train")
    ops.dismiss(request="training")
    assert "Train 3 min More" in draw(extension, "STGA_PT_train")
    another = tmp_path / "another"
    settings.run_folder = str(another)
    settings.avatar = ""
    texts = draw(extension, "STGA_PT_train")
    assert ("Train" in texts, "Resume" in texts) == (True, False)
    settings.run_folder = str(write_ball_run(another))
    assert {"Train", "Resume"} <= set(draw(extension, "STGA_PT_train"))


def test_what_is_said_of_an_operator(extension, head):
    """Catches *Not Done* over what was done, and all warnings but the last forgotten."""
    operator = SimpleNamespace(report=lambda kind, sentence: None)
    notify = extension.operators.common.Action.notify
    manager = bpy.context.window_manager
    ops.select(threshold=0.0005)
    for kind, sentence, expected in (
        ("WARNING", "One image is missing", ["Done", "One image is missing"]),
        ("WARNING", "So is one mask", ["Done", "One image is missing", "So is one mask"]),
        ("ERROR", "The disk is full", ["Not Done", "The disk is full"]),
    ):
        notify(operator, kind, sentence)
        texts = draw(extension, "next_step")
        assert [text for text in texts if text in {*expected, "Done", "Not Done"}] == expected
    ops.select(threshold=0.0005)
    assert (manager.stga_message, manager.stga_failed) == ("", False)


SECONDS = np.array([2.0, 10.0, 20.0, 40.0, 60.0, 80.0])
PSNR = np.array([20.0, 28.0, 30.5, 32.0, 31.0, 33.2])
AHEAD = {"seconds": 100.0, "psnr": 34.0, "error": 0.5, "ahead": 20.0, "gain": 0.8}
OTHERS = {"ssim": 0.9, "splats": 1, "evaluation_s": 1.0, "wall_s": 1.0}


def lines(count=6, forecast=True):
    made = [
        {"iteration": 10 * row, "seconds": float(SECONDS[row]), "psnr": float(PSNR[row]), **OTHERS}
        for row in range(count)
    ]
    if forecast:
        made[-1]["forecast"] = AHEAD
    return made


def test_curve_image():
    """Catches a curve, forecast or detail upside down, mirrored or out of range, and divisions
    by zero where it is short or flat."""
    pixels, axes, detail = curve_image(lines())
    assert detail == ""
    low, high = map(float, re.fullmatch(r"(\S+) to (\S+) dB, 0 to 1.7 min", axes).groups())
    inner = SIZE - 2 * MARGIN
    for second, color in [(second, CURVE_COLOR) for second in (15, 30, 50, 75)] + [
        (90, FORECAST_COLOR)
    ]:
        column = int(MARGIN + second / 100 * inner)
        at = (column + 0.5 - MARGIN) / inner * 100
        like = np.abs(pixels[:, column, :3] - np.array(color)).sum(-1)
        expected = np.interp(at, [*SECONDS, 100.0], [*PSNR, 34.0])
        found = low + (np.flatnonzero(like < 0.05).mean() + 0.5 - MARGIN) / inner * (high - low)
        assert found == pytest.approx(expected, abs=2 * (high - low) / inner)
    assert curve_image([]) is None
    assert curve_image(lines(1, forecast=False)) is None
    flat = [{"iteration": row, "seconds": 1.0 + row, "psnr": 30.0} for row in range(3)]
    pixels, axes, _ = curve_image(flat)
    assert np.isfinite(pixels).all()
    assert axes == "30 to 30.1 dB, 0 to 3 s"
    measured = [
        {**line, "detail_difference": 0.08 - 0.01 * row}
        for row, line in enumerate(lines(forecast=False))
    ]
    pixels, _, text = curve_image(measured)
    worst, best = map(
        float, re.fullmatch(r"Detail difference (\S+) to (\S+) \(green\)", text).groups()
    )
    assert (worst, best) == (0.072, 0.03)  # a tenth of the time is 8 s
    rows, columns = np.nonzero(np.abs(pixels[..., :3] - np.array(DETAIL_COLOR)).sum(-1) < 0.05)
    assert rows[columns > columns.max() - 5].mean() > rows[columns < columns.mean()].mean() + 30
    assert rows.max() > SIZE - 2 * MARGIN


def test_preview_follows_the_evaluations(extension, tmp_path):
    """Catches an image that stays, is empty or saved, and a panel that fails on damage."""
    curve = extension.ui.sidebar
    monitor = extension.operators.monitor
    drawn = []
    layout = SimpleNamespace(
        column=lambda **_: SimpleNamespace(
            template_icon=lambda *_, **__: None, label=lambda text: drawn.append(text)
        )
    )

    def draw():
        """Read evaluations as the training monitor does, and draw; the texts below."""
        drawn.clear()
        monitor.curves[tmp_path] = monitor._read_curve(tmp_path, {})
        curve.draw_curve(layout, tmp_path)
        return list(drawn)

    assert draw() == []
    file = tmp_path / "metrics.jsonl"
    seen = []
    for count in (1, 3, 6):
        file.write_text("".join(json.dumps(line) + "\n" for line in lines(count)))
        seen.append(draw())
    assert [len(texts) for texts in seen] == [0, 1, 1]
    painted = np.array(curve._previews[str(tmp_path)].image_pixels_float[:]).reshape(SIZE, SIZE, 4)
    np.testing.assert_allclose(painted, curve_image(lines())[0], atol=1 / 255)
    file.write_text(
        '{"iteration": 1, "seconds": "x", "psnr": 1}\n'
        '{"iteration": 2, "seconds": 2, "psnr": null}\n'
    )
    assert draw() == []
    assert len(bpy.data.images) == 0
