"""The plan in the panel: asked of a worker, kept in the scene, and handed to training."""

import json

import pytest

bpy = pytest.importorskip("bpy")

from capture.factory import write_mesh_capture  # noqa: E402

from stga_addon.training.run.folder import read_run  # noqa: E402
from stga_addon.training.settings import PRESETS  # noqa: E402


@pytest.fixture
def chosen(extension, tmp_path):
    """The scene's settings, with a head of a toy capture."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    root = write_mesh_capture(tmp_path / "capture")
    bpy.ops.stga.import_capture(directory=str(root))
    return bpy.context.scene.stga


def test_the_plan_reaches_the_run(chosen, extension, tmp_path):
    """Catches a plan that is empty, choices that are lost by looking again, and ones that training does not get."""
    from types import SimpleNamespace

    assert bpy.ops.stga.analyze_capture() == {"FINISHED"}
    rows = {row.name: row for row in chosen.effects}
    assert (rows["exposure"].on, rows["exposure"].choice) == (False, "auto")
    assert "255 levels" in rows["exposure"].reason
    rows["strain-color"].choice = "on"
    assert bpy.ops.stga.analyze_capture() == {"FINISHED"}
    rows = {row.name: row for row in chosen.effects}
    assert (rows["strain-color"].on, rows["strain-color"].choice) == (True, "on")
    effects = " ".join(extension.operators.analyze.chosen_effects(SimpleNamespace(effects=chosen.effects)))
    assert effects == "strain-color=on"
    seconds = json.loads(chosen.preset_timing)
    assert list(seconds) == list(PRESETS)
    chosen.preset = "draft"
    assert chosen.minutes == pytest.approx(seconds["draft"] / 60)
    out = tmp_path / "run"
    bpy.ops.stga.train(directory=str(out), iterations=3, effects=effects, preset=chosen.preset)
    run = read_run(out)
    assert run.settings.strain_color
    assert (run.settings.preset, run.settings.lattice) == ("draft", PRESETS["draft"].changes["lattice"])
    assert {decision.effect: decision.choice for decision in run.effect_plan}["strain-color"] == "on"


def test_another_head_has_another_plan(chosen):
    """Catches a plan that outlives the capture it was made for."""
    chosen.effects.add().name = "jaw"
    chosen.preset_timing = '{"draft": 1}'
    chosen.head = chosen.head
    assert not chosen.effects
    assert not chosen.preset_timing


def test_a_choice_that_cannot_be(chosen):
    """Catches a mistake that shows nowhere, or as a traceback."""
    row = chosen.effects.add()
    row.name, row.choice = "jaw", "on"
    with pytest.raises(RuntimeError, match=r"jaw=on: .* no parameters of FLAME"):
        bpy.ops.stga.analyze_capture()
    assert chosen.analysis_error.startswith("jaw=on: ")
    assert "Traceback" not in chosen.analysis_error
