"""Panels are drawn from memory: Blender redraws them many times a second."""

import builtins
import io
import json
import os
from types import SimpleNamespace

import bpy
import pytest
from capture.factory import write_mesh_capture

from stga_addon.jobs.table import Kind
from stga_addon.progress import Progress

from .test_curve import lines
from .test_operators import write_ball_avatar


class Layout:
    """Stands in for a panel's layout, and notes the texts."""

    def __init__(self, texts=None):
        self.__dict__["texts"] = [] if texts is None else texts

    def operator(self, name, text="", **_):
        self.texts.append(text or name)
        return SimpleNamespace()

    def operator_menu_enum(self, name, prop, text=""):
        self.texts.append(text)

    def label(self, text="", **_):
        self.texts.append(text)

    def prop(self, owner, name, **_):
        assert name.startswith("[") or hasattr(owner, name)

    def prop_search(self, owner, name, other, collection, **_):
        assert hasattr(owner, name)
        assert hasattr(other, collection)

    def progress(self, factor, text):
        self.texts.append(text)

    def template_list(self, *_, **__):
        pass

    def template_icon(self, *_, **__):
        self.texts.append("curve")

    def _part(self, **_):
        return Layout(self.texts)

    row = column = box = split = grid_flow = _part

    def __setattr__(self, name, value):
        pass


def panels(extension) -> list[type]:
    return [cls for cls in extension.ui.panel.CLASSES if issubclass(cls, bpy.types.Panel)]


@pytest.fixture
def trained(extension, tmp_path, monkeypatch):
    """A scene whose run has finished, with curve and refined tracking, as the timer has read it."""
    bpy.ops.stga.import_capture(directory=str(write_mesh_capture(tmp_path / "capture")))
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
    layout = Layout()
    for cls in [cls for cls in panels(extension) if name in cls.bl_idname]:
        own = [base for base in reversed(cls.__mro__) if base.__module__.startswith("stga")]
        members = {
            key: value
            for base in own
            for key, value in vars(base).items()
            if not key.startswith("__")
        }
        panel = type(cls.__name__, (), members)()  # Blender makes panels itself, in a window only
        panel.layout = layout
        panel.draw(context)
    return layout.texts


def test_drawing_reads_no_file(extension, trained, monkeypatch):
    """Catches panels that open, stat or list files, which would block redraws."""
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
    assert {"Trained", "curve", "Apply Refined Tracking", "stga.analyze_capture"} <= set(texts)


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
