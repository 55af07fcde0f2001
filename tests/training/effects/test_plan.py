"""Effect plan: decided once, printed, stored with the run and kept on resume."""

import re

import pytest
from capture import factory
from command_line import refused, stga

from stga_addon.capture.open import open_capture
from stga_addon.flame.parts import PARTS
from stga_addon.training.effect_catalog import EFFECTS
from stga_addon.training.effects import plan as planning
from stga_addon.training.effects.plan import Verdict, add_effects, plan_effects
from stga_addon.training.run.folder import read_run
from stga_addon.training.settings import TrainingSettings, make_settings


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return factory.write_mesh_capture(
        tmp_path_factory.mktemp("effects") / "ball", (0, 1, 3), range(3)
    )


@pytest.fixture(scope="module")
def trained(root, tmp_path_factory):
    out = tmp_path_factory.mktemp("effects") / "run"
    choices = "--iterations 4 --effect strain-color=on --effect hull-points=off"
    assert stga("train", root, "--out", out, choices) == 0
    return out


def test_parts_of_the_head_can_be_left_out():
    """Catches a part that has no setting of its name, or that no rule decides about."""
    settings = TrainingSettings()
    assert [name for name in PARTS if getattr(settings, name, None) is None] == []
    assert [name for name in PARTS if EFFECTS[name].switch != name] == []
    assert set(planning.RULES) == set(EFFECTS)


def test_the_run_keeps_its_plan(trained, root, monkeypatch, capsys):
    """Catches decisions lost in run.json, settings that do not follow, and decisions anew."""
    run = read_run(trained)
    plan = {decision.effect: decision for decision in run.effect_plan}
    assert (plan["strain-color"].choice, plan["strain-color"].on) == ("on", True)
    assert "strain_color" in run.settings.driven_offsets
    assert (plan["hull-points"].choice, plan["hull-points"].on) == ("off", False)
    assert not run.settings.hull_points
    assert plan["exposure"].choice == "auto"
    assert run.settings.effects == {"strain-color": "on", "hull-points": "off"}
    monkeypatch.setattr("stga_addon.training.effects.plan.plan_effects", None)
    before = read_run(trained)
    train = "train", root, "--out", trained, "--resume --effect"
    assert stga(*train, "strain-color=on") == 0
    assert read_run(trained) == before
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert any(line.startswith("strain-color on, as asked:") for line in lines)
    assert "differs from what was decided for this run" in refused(
        capsys, *train, "strain-color=off"
    )


@pytest.mark.parametrize("effect", ["strain-color", "normal-color"])
@pytest.mark.parametrize(("choice", "expected"), [("auto", True), ("off", False)])
def test_takes_can_call_for_strain(root, monkeypatch, choice, expected, effect):
    """Catches an extension that cannot hold its takes' expressions, or overrules a choice."""
    capture = open_capture(root)
    settings = make_settings(iterations=1, effects={} if choice == "auto" else {effect: choice})
    settings, plan = plan_effects(capture, settings)
    (offset,) = EFFECTS[effect].offsets
    assert offset not in settings.driven_offsets
    monkeypatch.setitem(planning.RULES, effect, lambda facts: Verdict(True, "two takes say so"))
    extended, later = add_effects(capture, settings, plan)
    assert (offset in extended.driven_offsets) == expected
    changed = [now for now, then in zip(later, plan, strict=True) if now != then]
    assert [(each.effect, each.on, each.reason) for each in changed] == expected * [
        (effect, True, "two takes say so")
    ]
    assert add_effects(capture, extended, later) == (extended, later)


def test_info_shows_the_plan(tmp_path, capsys):
    """Catches an overview without plan or figures, or that does not heed choices."""
    root = factory.write_mesh_capture(tmp_path / "ball", (0, 1, 2, 3, 4, 5), range(3))
    assert stga("info", root, "--effect strain-color=on") == 0
    lines = capsys.readouterr().out.splitlines()
    (strain,) = [line for line in lines if line.startswith("strain-color")]
    assert "on, as asked: " in strain
    assert "coefficients a triangle" in strain
    gain = r"[+-]\d\.\d\d dB in left-out"
    assert re.search(rf"{gain} frames and {gain} cameras", strain)
    assert any(line.startswith("view-color") and "off: " in line for line in lines)


@pytest.mark.parametrize("effect", ["jaw=on", "teeth=on", "strain=on"])
def test_what_cannot_be_is_one_sentence(root, tmp_path, capsys, effect):
    """Catches an impossible choice that is taken in silence, or ends in a traceback."""
    says = "'strain=on' is not NAME=on" if effect == "strain=on" else f"--effect {effect}: "
    try:
        code = stga("train", root, "--out", tmp_path / "run", "--iterations 2 --effect", effect)
    except SystemExit as stop:  # argparse's, of a value that no capture could have
        code = stop.code
    assert code == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_baselines_decide_nothing(root, tmp_path, capsys):
    """Catches the paper's letter, or GaussianAvatars' method, with effects of ours."""
    for number, options in enumerate(("--schedule paper", "--strategy gaussian-avatars")):
        out = tmp_path / str(number)
        train = ("train", root, "--iterations 2", options, "--out")
        assert stga(*train, out) == 0
        run = read_run(out)
        assert (run.effect_plan, run.settings.effects) == ((), None)
        assert not run.settings.driven_offsets
        assert "--effect cannot be combined with" in refused(
            capsys, *train, tmp_path / "no", "--effect strain-color=on"
        )
