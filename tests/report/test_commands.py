"""The commands around time and accuracy, as typed."""

from pathlib import Path

import pytest

from stga_addon.cli.main import main
from stga_addon.training import preset_timing
from stga_addon.training.run.folder import read_run


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every preset takes a millisecond an iteration."""
    monkeypatch.setattr(preset_timing, "seconds_per_iteration", lambda *_: 0.001)


def test_presets(toy_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Catches presets that are not told, or without their time, or without what was timed."""
    assert main(["presets", str(toy_root), "--device", "cpu"]) == 0
    device, *lines = capsys.readouterr().out.splitlines()
    assert device == "Training on the CPU (--device cpu)"
    assert [line.split()[0] for line in lines] == ["draft", "standard", "final"]
    assert lines[1].split()[1:6] == ["3000", "iterations", "about", "3", "s"]


def test_what_is_timed_is_what_will_train(toy_root, tmp_path, capsys, monkeypatch):
    """Catches a GPU that is given the minutes of the CPU."""
    timed: list[str] = []
    monkeypatch.setattr(
        preset_timing, "seconds_per_iteration", lambda *call: timed.append(call[3]) or 1e-3
    )
    for module in ("jobs.analyze", "render.device"):
        monkeypatch.setattr(
            f"stga_addon.{module}.choose_device", lambda wanted: ("gpu:Card", "why")
        )
    device = ["--device", "gpu"]
    assert main(["presets", str(toy_root), *device]) == 0
    assert main(["info", str(toy_root), "--json", "--presets", *device]) == 0
    assert timed == ["gpu:Card"] * 6


def test_a_preset_brings_its_iterations(toy_root, tmp_path, capsys, monkeypatch):
    """Catches a preset that changes nothing, and one that cannot be overruled."""
    train = ["train", str(toy_root), "--out"]
    assert main([*train, str(tmp_path / "preset"), "--preset", "draft", "--target-psnr", "5"]) == 0
    out = capsys.readouterr().out
    assert "Preset draft: 800 iterations\n" in out
    assert "5 dB was reached" in out
    assert "held-out views: " in out
    settings = read_run(tmp_path / "preset").settings
    assert (settings.preset, settings.iterations, settings.lattice, settings.target_psnr) == (
        "draft", 800, 1, 5.0,
    )  # fmt: skip
    assert main([*train, str(tmp_path / "counted"), "--preset", "final", "--iterations", "3"]) == 0
    settings = read_run(tmp_path / "counted").settings
    assert (settings.preset, settings.seconds, settings.iterations) == ("final", None, 3)
    assert main([*train, str(tmp_path / "counted"), "--resume", "--preset", "draft"]) == 2
    assert "--preset: this run began with final" in capsys.readouterr().err
