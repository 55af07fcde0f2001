"""Options without effect where the result would be another than asked for: refused before anything is written."""

from pathlib import Path

import numpy as np
import pytest
from capture import factory

from stga_addon.avatar.file import Avatar, write_avatar
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.capture.open import open_capture
from stga_addon.cli.main import main
from stga_addon.training.run.folder import Run, read_run, write_run
from stga_addon.training.settings import make_settings

TRAIN = "train capture --out new --iterations 1"
REFUSED = {
    f"{TRAIN} --schedule paper --strategy gaussian-avatars": "--schedule paper: cannot be combined with --strategy "
    "gaussian-avatars, which has settings of its own",
    f"{TRAIN} --schedule paper --preset draft": "--preset: cannot be combined with --schedule paper, which has "
    "settings of its own",
    f"{TRAIN} --preset final --strategy gaussian-avatars": "--preset: cannot be combined with --strategy "
    "gaussian-avatars, which has settings of its own",
    f"{TRAIN} --threshold 0.01": "--threshold: has no effect without --strategy selective, or --schedule paper",
    f"{TRAIN} --threshold 0.01 --strategy global --schedule paper": "--threshold: has no effect without --strategy "
    "selective",
    "avatar footage --model m.npz --out new --schedule paper --strategy gaussian-avatars": "--schedule paper: cannot "
    "be combined with --strategy gaussian-avatars",
    "avatar footage --model m.npz --out new --threshold 0.01": "--threshold: has no effect without --strategy",
    "render a.npz --video v.mp4 --capture capture --principal-point opencv": "--principal-point: has no effect without "
    "--cameras",
    "export a.npz --format ply --out new.ply --motion take.csv": "--motion: has no effect with --format ply without "
    "--timestep",
}
"""Command line -> the sentence, or how it begins."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Captures, an avatar of the first, and a run that has not begun."""
    folder = tmp_path_factory.mktemp("options")
    capture = open_capture(factory.write_mesh_capture(folder / "capture", (0, 1), range(2)))
    factory.write_flame_capture(folder / "flame", (0, 1), range(2))
    splats = lattice_splats(capture.neutral, capture.faces, order=0)
    write_avatar(folder / "a.npz", Avatar(splats, "stga", capture.neutral.astype(np.float32), capture.faces))
    write_run(folder / "run", Run(capture.root, None, "vhap", make_settings(iterations=1)))
    (folder / "footage").mkdir()
    return folder


@pytest.mark.parametrize("line", REFUSED, ids=lambda line: line.replace(" ", "_")[:90])
def test_options_without_effect_are_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], line: str
) -> None:
    """Catches an option that is ignored without a message, and one that is refused after an hour of tracking."""
    monkeypatch.chdir(folder)
    before = sorted(folder.rglob("*"))
    assert main(line.split()) == 2
    assert f"stga: {REFUSED[line]}" in capsys.readouterr().err
    assert sorted(folder.rglob("*")) == before


def test_a_threshold_is_given_again_when_a_run_is_resumed(folder: Path, tmp_path: Path) -> None:
    """Catches `train --resume` that refuses the threshold that the run began with."""
    run = ["train", str(folder / "capture"), "--out", str(tmp_path / "run"), "--device", "cpu"]
    chosen = ["--threshold", "0.01", "--schedule", "paper", "--iterations", "1"]
    assert main([*run, *chosen]) == 0
    assert main([*run, *chosen, "--resume"]) == 0
    assert main([*run, "--threshold", "0.01", "--resume"]) == 0
    assert main([*run, "--threshold", "0.02", "--resume"]) == 2
    assert read_run(tmp_path / "run").settings.selection.threshold == 0.01
