"""Panels are drawn from memory: Blender redraws them many times a second."""

import builtins
import io
import json
import os
from types import SimpleNamespace

import bpy
import pytest
from gui.layouts import filled

from stga_addon.jobs.table import Kind
from stga_addon.progress import Progress

from .test_curve import lines
from .test_operators import write_ball_avatar


@pytest.fixture
def trained(extension, head, tmp_path, monkeypatch):
    """A scene whose run has finished, with curve and refined tracking, as the timer has read it."""
    bpy.ops.stga.select(threshold=0.0005)
    run, jobs, monitor = tmp_path / "run", extension.stga_addon.jobs, extension.operators.monitor
    folder = jobs.perform.request_folder(run)
    settings = extension.stga_addon.training.settings.make_settings("global", iterations=5)
    jobs.perform.write_request(folder, jobs.train.Train(run, tmp_path / "capture", settings))
    with extension.stga_addon.worker.status.status_writer(folder) as writer:
        monitor.follow(bpy.context.scene, Kind.TRAINING, run, folder)
        writer.report(Progress(0.5, "Training"))
        (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines()))
        (run / "tracking.npz").write_bytes(b"")
    write_ball_avatar(run / "avatar.npz")
    for _ in range(300):
        monitor.tick()
        if bpy.context.scene.stga.result_shown:
            break
    monkeypatch.setattr(monitor, "has_timer", lambda: True)
    monkeypatch.setattr(monitor, "_start_timer", lambda: None)
    return run


def draw(extension, name: str = "") -> list[str]:
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
    shown = [leaf for leaf in leaves if not leaf.kind.startswith(("prop", "template_list"))]
    return [leaf.text or leaf.kind for leaf in shown]


def test_drawing_reads_no_file(extension, trained, monkeypatch):
    """Catches panels that open, stat or list files, which would block redraws."""
    extension.operators.request.has_training_python(bpy.context)

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


def test_errors_of_the_monitor_are_in_the_panel(extension, trained, monkeypatch, capsys):
    """Catches a timer that ends at an error without a trace, or repeats it."""
    monitor = extension.operators.monitor
    monkeypatch.setattr(monitor, "_read_status", lambda scene, state: 1 / 0)
    assert monitor.tick() is None
    assert capsys.readouterr().err.count("ZeroDivisionError") == 1
    assert monitor.tick() is None
    assert "ZeroDivisionError" not in capsys.readouterr().err
    assert "Monitoring stopped after an unexpected error (ZeroDivisionError" in " ".join(
        draw(extension)
    )
