"""Analysis of the capture: in a worker, shown in the panel, and passed on to training."""

import json
import re
import time

import bpy
import numpy as np
import pytest
from capture.test_repairs import FILES, shows_box, write_capture

from stga_addon.capture.open import open_capture
from stga_addon.jobs.table import Kind
from stga_addon.training.run.folder import read_run
from stga_addon.training.settings import PRESETS

from .session import failure, ops, panel, state_of
from .test_panel import draw


@pytest.fixture
def chosen(head):
    """The settings of a scene with a head."""
    panel().device = "cpu"
    return panel()


def test_effect_choices(chosen, extension, tmp_path):
    """Catches choices of another capture, that are lost, or cannot be and show nowhere."""
    row = chosen.effects.add()
    row.name = "jaw"
    row.choice = "on"
    with failure(r"jaw=on: .* no parameters of FLAME"):
        ops.analyze_capture()
    assert state_of(Kind.ANALYSIS).error.startswith("jaw=on: ")
    assert "Traceback" not in state_of(Kind.ANALYSIS).error
    chosen.preset_timing = '{"draft": 1}'
    chosen.head = chosen.head
    assert not chosen.effects
    assert not chosen.preset_timing
    row = chosen.effects.add()  # as an earlier analysis leaves it
    row.name = "strain-color"
    row.choice = "on"
    ops.analyze_capture()
    rows = {row.name: row for row in chosen.effects}
    assert len(rows) == len(chosen.effects) > 2
    assert (rows["exposure"].on, rows["exposure"].choice) == (False, "auto")
    assert "255 levels" in rows["exposure"].reason
    assert (rows["strain-color"].on, rows["strain-color"].choice) == (True, "on")
    effects = " ".join(extension.operators.train.chosen_effects(chosen))
    assert effects == "strain-color=on"
    seconds = json.loads(chosen.preset_timing)
    assert list(seconds) == list(PRESETS)
    chosen.preset = "draft"
    least = 0.01  # minutes that can be chosen; a fast machine needs fewer
    assert chosen.minutes == pytest.approx(max(least, seconds["draft"] / 60))
    out = tmp_path / "run"
    made = {"iterations": 3, "effects": f"{effects} relight=off", "device": "cpu"}
    ops.train(directory=out, preset=chosen.preset, **made)
    run = read_run(out)
    assert "strain_color" in run.settings.driven_offsets
    assert run.settings.preset == "draft"
    assert run.settings.lattice == PRESETS["draft"].changes["lattice"]
    choices = {decision.effect: decision.choice for decision in run.effect_plan}
    assert choices["strain-color"] == "on"


def test_a_capture_that_is_repaired(extension, tmp_path, monkeypatch):
    """Catches a mesh that misses its images of which the panel says nothing before a training, a
    repair that leaves the scene as it was, and one that takes the shot away."""
    source = write_capture(tmp_path / "capture", **FILES["z-up"])
    ops.import_capture(directory=source)
    panel().device = "cpu"
    bpy.context.scene.frame_end = 7
    with failure(r".*one has z up, by which they fit: with --repair, it is read so"):
        ops.train(directory=tmp_path / "run", iterations=3, device="cpu", effects="relight=off")
    monkeypatch.setattr(extension.ui.next_step, "has_training_python", lambda context: True)
    assert "Repair Capture" in draw(extension, "next_step")
    ops.analyze_capture()
    assert "(z-up)" in panel().misfit
    ops.analyze_capture(repair=True)
    assert not panel().misfit
    assert "Repair Capture" not in draw(extension)
    assert bpy.context.scene.frame_end == 7
    head = panel().head
    found = np.array([head.matrix_world @ vertex.co for vertex in head.data.vertices])
    capture = open_capture(source)
    shows_box(capture)
    z_up = capture.mesh(0)[:, [0, 2, 1]] * [1, -1, 1]
    np.testing.assert_allclose(found, z_up, atol=1e-5)
    ops.train(directory=tmp_path / "run", iterations=3, device="cpu", effects="relight=off")


@pytest.fixture
def analyze(extension, monkeypatch, stand_in):
    """Start an analysis by a stand-in for the worker, with a timer that the test calls."""

    def start(body):
        stand_in(body)
        ops.analyze_capture()

    monkeypatch.setattr(extension.operators.timers, "has_timer", lambda: True)
    yield start
    extension.operators.monitor._close()


def tick_until_done(extension, kind=Kind.ANALYSIS):
    for _ in range(300):
        extension.operators.monitor.tick()
        if not state_of(kind).is_running:
            return
        time.sleep(0.02)
    raise AssertionError("the analysis did not end")


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        ("sys.exit(3)", r"Worker exited with status 3: its log is empty"),
        ("end('failed', 'no memory')", "no memory"),
        ("end('finished')", r".*result\.json: cannot be read"),
        ("answer(kind='Analyzed')", r".*result\.json: fields are missing or unknown"),
        ("answer(kind='Written', path='x', lines=[])", r"Unexpected error \(AttributeError"),
    ],
)
def test_failed_analysis_is_a_sentence(chosen, extension, analyze, body, sentence):
    """Catches a timer that ends with a traceback, and a panel that says nothing."""
    chosen.effects.add().name = "jaw"
    analyze(body)
    tick_until_done(extension)
    assert re.match(sentence, state_of(Kind.ANALYSIS).error)
    assert extension.operators.monitor.tick() is None


def test_analysis_can_be_cancelled(chosen, extension, analyze, monkeypatch, tmp_path):
    """Catches an analysis that nobody can stop, and a folder left for each attempt that fails."""
    assert not ops.cancel.poll()
    analyze("time.sleep(600)")
    assert not ops.analyze_capture.poll()
    begin = time.monotonic()
    ops.cancel(request="analysis")
    assert time.monotonic() - begin < 60
    assert ops.analyze_capture.poll()
    assert extension.operators.monitor.tick() is None
    assert state_of(Kind.ANALYSIS).error == ""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    python = str(tmp_path / "none")
    monkeypatch.setattr(extension.operators.train, "training_python", lambda context: python)
    before = set(tmp_path.iterdir())
    with failure("cannot be started as a Python interpreter"):
        ops.analyze_capture()
    assert set(tmp_path.iterdir()) == before
