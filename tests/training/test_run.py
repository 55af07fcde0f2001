"""A whole run: budget, evaluation, the best avatar, and resumption to the same numbers."""

import shutil
from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from refusal import refusal

from stga_addon.avatar.file import read_avatar
from stga_addon.errors import StgaError
from stga_addon.training.evaluate import evaluator
from stga_addon.training.evaluate.forecast import kept_line
from stga_addon.training.evaluate.metrics import Quality
from stga_addon.training.run import session as run_module
from stga_addon.training.run.checkpoint import read_checkpoint, read_selection
from stga_addon.training.run.folder import read_residuals, read_run
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.run.session import train_more, train_run
from stga_addon.training.settings import STRATEGIES

from .toys import assert_same_run, assert_same_state, iteration_of, run_of, stop_at

ITERATIONS = 24
# Everything that changes a state happens in a few iterations.
BUSY = {"density_interval": 5, "density_span": (0.0, 1.0), "lattice": 1}
BUSY |= {"stray_reset_interval": 4, "stray_limit": 0.3}


def make_run(capture, strategy="selective", **changes):
    return run_of(capture, strategy, **{"iterations": ITERATIONS, **BUSY, **changes})


@pytest.fixture(scope="module")
def unbroken(toy, tmp_path_factory):
    """A run from start to end."""
    out = tmp_path_factory.mktemp("unbroken") / "run"
    assert train_run(toy, out, make_run(toy)).path == out / "avatar.npz"
    return out


def test_what_a_run_leaves(toy, unbroken):
    """Catches a budget over- or underrun, missing evaluations, and files that do not read back."""
    checkpoint = read_checkpoint(unbroken)
    assert checkpoint.iteration == ITERATIONS
    assert checkpoint.elapsed_s > 0
    assert read_run(unbroken) == make_run(toy)
    selection = read_selection(unbroken, len(toy.faces))
    assert set(selection) == set(toy.timesteps)
    assert any(faces.any() for faces in selection.values())
    lines = read_metrics(unbroken)
    # Ten evaluations, evenly spread, the last one at the end.
    assert [line["iteration"] for line in lines] == [3, 5, 8, 10, 12, 15, 17, 20, 22, 24]
    assert all({"psnr", "ssim", "seconds", "splats", "loss"} <= set(line) for line in lines)
    assert np.isfinite([line["psnr"] for line in lines]).all()
    assert lines[-1]["splats"] == len(checkpoint.state) > 3 * len(toy.faces)
    assert lines[-1]["psnr"] > lines[0]["psnr"]
    residual = read_residuals(unbroken, len(toy.faces))
    assert 0 < np.nanmean(residual) < 1
    with refusal(r"residuals\.npz: expected 'residual', float32 \(7,\)"):
        read_residuals(unbroken, 7)
    avatar = read_avatar(unbroken / "avatar.npz")
    assert_array_equal(avatar.faces, toy.faces)
    assert avatar.settings["strategy"] == "selective"
    assert sorted(p.name for p in unbroken.iterdir()) == [
        "avatar.npz",
        "checkpoint.npz",
        "metrics.jsonl",
        "residuals.npz",
        "run.json",
        "selection.npz",
    ]


class Crash(Exception):
    """What a power cut looks like from inside."""


def test_crashed_and_resumed_is_the_unbroken_run(toy, unbroken, tmp_path, monkeypatch):
    """Catches evaluations twice, or missing, after going on from a checkpoint before them."""

    def crash(progress):
        iteration = iteration_of(progress)
        monkeypatch.setattr(run_module, "CHECKPOINT_S", 0.0 if iteration == 7 else 1e9)
        if iteration == 13:
            raise Crash
        return False

    with pytest.raises(Crash):
        train_run(toy, tmp_path, make_run(toy), report=crash)
    assert read_checkpoint(tmp_path).iteration == 8
    assert max(line["iteration"] for line in read_metrics(tmp_path)) > 8
    train_run(toy, tmp_path, make_run(toy), resume=True)
    assert_same_run(tmp_path, unbroken)


@pytest.mark.parametrize("iteration", [2, 11, 15])
def test_stopped_and_resumed_is_the_unbroken_run(iteration, toy, unbroken, tmp_path):
    """Catches a line of metrics, or an avatar, of the moment of a Ctrl-C that stays after resuming;
    15 is the iteration of an evaluation, 2 before the first."""
    train_run(toy, tmp_path, make_run(toy), report=stop_at(iteration))
    assert read_metrics(tmp_path)[-1]["iteration"] == iteration
    assert (tmp_path / "avatar.npz").exists()
    train_run(toy, tmp_path, make_run(toy), resume=True)
    assert_same_run(tmp_path, unbroken)


def test_the_avatar_of_a_stop_is_not_that_of_the_resumed_run(toy, tmp_path, monkeypatch):
    """Catches a stopped run without the best avatar so far, and a resumed one that keeps a state
    which the unbroken run never evaluated."""
    before = iter([Quality(20, 0.5), Quality(21, 0.5), Quality(25, 0.5)])
    monkeypatch.setattr(evaluator, "evaluate", lambda *_: next(before))
    train_run(toy, tmp_path, make_run(toy), report=stop_at(6))
    now = read_avatar(tmp_path / "avatar.npz").splats.xyz
    assert_array_equal(now, read_checkpoint(tmp_path).state.average.xyz)
    monkeypatch.setattr(evaluator, "evaluate", lambda *_: Quality(19, 0.5))
    train_run(toy, tmp_path, make_run(toy), resume=True)
    kept = read_avatar(tmp_path / "avatar.npz").splats.xyz
    train_run(toy, tmp_path / "five", make_run(toy), report=stop_at(5))
    five = read_checkpoint(tmp_path / "five").state.average.xyz
    assert_array_equal(kept, five)


def test_residuals_that_could_not_be_measured(toy, unbroken, tmp_path, monkeypatch):
    """Catches a run that failed after its last iteration, resumed with success and no residuals."""

    def fail(*_):
        raise StgaError("image 7 cannot be read")

    with monkeypatch.context() as patch:
        patch.setattr(run_module, "triangle_residuals", fail)
        with refusal("image 7"):
            train_run(toy, tmp_path, make_run(toy))
    train_run(toy, tmp_path, make_run(toy), resume=True)
    count = len(toy.faces)
    assert_array_equal(read_residuals(tmp_path, count), read_residuals(unbroken, count))
    assert len(read_metrics(tmp_path)) == len(read_metrics(unbroken))


def test_checkpoints_as_often_as_the_environment_says(monkeypatch):
    """Catches a farm's wish ignored, and a traceback or no checkpoints of a nonsensical one."""
    for text, seconds in (("", None), ("0.5", 0.5), ("0", 0.0)):
        monkeypatch.setenv("STGA_CHECKPOINT_S", text)
        assert run_module._asked_interval_s() == seconds
    for text in ("soon", "-1", "nan", "inf"):
        monkeypatch.setenv("STGA_CHECKPOINT_S", text)
        with refusal("STGA_CHECKPOINT_S: expected seconds between checkpoints"):
            run_module._asked_interval_s()


def test_a_given_selection_survives_an_early_crash(toy, tmp_path):
    """Catches a painted selection replaced by the rule where there was no checkpoint yet."""
    painted = {timestep: np.arange(len(toy.faces)) < 7 for timestep in toy.timesteps}

    def crash(progress):
        if iteration_of(progress) == 2:
            raise Crash
        return False

    with pytest.raises(Crash):
        train_run(toy, tmp_path, make_run(toy), painted, report=crash)
    train_run(toy, tmp_path, make_run(toy), resume=True)
    kept = read_selection(tmp_path, len(toy.faces))
    assert kept.keys() == painted.keys()
    assert all((kept[timestep] == painted[timestep]).all() for timestep in painted)


def test_a_lost_avatar_is_written_anew(toy, unbroken, tmp_path):
    """Catches "--resume" of a finished run that ends without an avatar and says nothing, trains on,
    or evaluates again."""
    out = tmp_path / "run"
    shutil.copytree(unbroken, out)
    for name in ("avatar.npz", "residuals.npz"):
        (out / name).unlink()
    told = []

    def note(progress):
        return bool(told.append(progress.stage))

    train_run(toy, out, make_run(toy), resume=True, report=note)
    assert "Writing the missing avatar from the checkpoint" in told
    assert_same_state(out, unbroken)
    assert len(read_metrics(out)) == len(read_metrics(unbroken))
    written = read_avatar(out / "avatar.npz").splats
    assert_array_equal(written.xyz, read_checkpoint(unbroken).state.average.xyz)
    assert read_residuals(out, len(toy.faces)).shape == (len(toy.faces),)
    stopped = tmp_path / "stopped"
    train_run(toy, stopped, make_run(toy), report=stop_at(11))
    (stopped / "avatar.npz").unlink()
    train_run(toy, stopped, make_run(toy), resume=True)
    assert (stopped / "avatar.npz").exists()


@pytest.mark.parametrize("change", ["renamed", "emptied"])
def test_a_folder_that_is_moved_while_training(toy, tmp_path, change):
    """Catches a renamed run begun again under its old name, without what resuming needs."""
    out = tmp_path / "run"
    moved = tmp_path / "moved"

    def move(progress):
        if iteration_of(progress) == 7:
            out.rename(moved)
            if change == "emptied":
                out.mkdir()
        return False

    with refusal(rf"^{out}: was moved or deleted while its run trained; "):
        train_run(toy, out, make_run(toy), report=move)
    assert not out.exists() or not list(out.iterdir())
    assert (moved / "run.json").exists()
    train_run(toy, moved, make_run(toy), resume=True)
    assert read_checkpoint(moved).iteration == ITERATIONS


def test_the_best_avatar_is_kept(toy, tmp_path, monkeypatch):
    """Catches a run that gets worse and takes its best avatar with it, and one that keeps an early
    state because it is a hair sharper."""
    found = (30, 0.3), (30, 0.1), (29, 0.2), (31, 0.11), *[(30.5, 0.15)] * 20
    scores = iter(found)
    written = []

    def write(path, avatar):
        written.append(avatar)
        run_module_write(path, avatar)

    run_module_write = run_module.write_avatar

    def evaluate(*arguments):
        psnr, difference = next(scores)
        return Quality(psnr, 0.5, detail_difference=difference)

    monkeypatch.setattr(evaluator, "evaluate", evaluate)
    monkeypatch.setattr(run_module, "write_avatar", write)
    train_run(toy, tmp_path, make_run(toy), report=stop_at(11))
    train_run(toy, tmp_path, make_run(toy), resume=True)
    assert len(written) == 3
    assert kept_line(read_metrics(tmp_path), make_run(toy).settings)["psnr"] == 31
    best = read_avatar(tmp_path / "avatar.npz").splats
    assert_array_equal(best.xyz, written[2].splats.xyz)
    assert not np.array_equal(written[0].splats.xyz, written[1].splats.xyz)


def test_without_held_out_views_the_latest_avatar_is_kept(toy, tmp_path):
    """Catches a run without avatar, or with its first one, where nothing can be measured."""
    bare = replace(toy, views={"train": toy.views["train"]})
    train_run(bare, tmp_path, make_run(toy))
    avatar = read_avatar(tmp_path / "avatar.npz")
    assert_array_equal(avatar.splats.xyz, read_checkpoint(tmp_path).state.average.xyz)
    assert all("psnr" not in line for line in read_metrics(tmp_path))


def test_what_is_refused_changes_nothing(toy, unbroken, tmp_path):
    """Catches hours of training lost to a forgotten --resume, files of a run among those of a
    recording, an endless wait for views that never come, and a folder made for nothing."""
    for out, says in (
        (unbroken, "already holds a run"),
        (toy.root, "is the folder of the capture"),
    ):
        before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
        with refusal(says):
            train_run(toy, out, make_run(toy))
        assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    for views in ({}, {"train": ()}):
        with refusal("has no training views"):
            train_run(replace(toy, views=views), tmp_path / "run", make_run(toy))
    bare = replace(toy, views={"train": toy.views["train"]})
    with refusal("has no held-out views"):
        train_run(bare, tmp_path / "run", make_run(toy, target_psnr=30.0))
    assert not (tmp_path / "run").exists()


def test_a_budget_in_seconds(toy, tmp_path, monkeypatch):
    """Catches wall time not counted, counted twice when resumed, or overrun."""
    ticks = count()  # a clock that ticks when it is read, so that every step takes 0.01 s
    monkeypatch.setattr(run_module, "perf_counter", lambda: next(ticks) / 100)
    shares = []

    def note(progress):
        shares.append(progress.fraction)
        return iteration_of(progress) == 6

    run = make_run(toy, iterations=None, seconds=0.6)
    train_run(toy, tmp_path, run, report=note)
    assert read_checkpoint(tmp_path).elapsed_s == pytest.approx(0.06)
    train_run(toy, tmp_path, run, resume=True)
    end = read_checkpoint(tmp_path)
    assert 0.6 <= end.elapsed_s < 0.615
    assert end.iteration == pytest.approx(60, abs=1)
    assert shares == sorted(shares)


def test_more_training(toy, unbroken, tmp_path, monkeypatch):
    """Catches a finished run that trains nothing more, or as if from the beginning, an avatar that
    gets worse, and a run that cannot be resumed afterwards."""
    out = tmp_path / "run"
    shutil.copytree(unbroken, out)
    shares = []
    left = []

    def note(progress):
        if progress.stage == "Training":
            shares.append(progress.fraction)
            left.append(progress.figures()["left_s"])
        return False

    before = read_checkpoint(out)
    ticks = count()  # every step takes 0.01 s
    monkeypatch.setattr(run_module, "perf_counter", lambda: next(ticks) / 100)
    train_more(toy, out, make_run(toy), 0.2, note)
    after = read_checkpoint(out)
    assert after.elapsed_s - before.elapsed_s == pytest.approx(0.2, abs=0.02)
    assert after.iteration - before.iteration == pytest.approx(20, abs=1)
    assert shares == sorted(shares)
    assert shares[0] >= 0.5
    assert left[-1] < left[0]
    lines = read_metrics(out)
    assert lines[-1]["iteration"] == after.iteration
    assert lines[: before.lines] == read_metrics(unbroken)
    train_run(toy, out, make_run(toy), resume=True)
    assert read_checkpoint(out).iteration == after.iteration


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("schedule", ["default", "paper"])
def test_every_strategy_and_schedule_runs(toy, tmp_path, strategy, schedule):
    """Catches a combination that no other test trains, and an avatar's wrong convention."""
    often = {"stray_reset_interval": 3, "density_interval": 3}
    train_run(toy, tmp_path, run_of(toy, strategy, schedule=schedule, iterations=8, **often))
    avatar = read_avatar(tmp_path / "avatar.npz")
    assert avatar.convention == ("gaussian_avatars" if strategy == "gaussian-avatars" else "stga")
    assert set(avatar.splats.face.tolist()) == set(range(len(toy.faces)))
    assert (read_selection(tmp_path, len(toy.faces)) != {}) == (strategy == "selective")


def test_progress_tells_what_a_person_wants_to_know(toy, tmp_path):
    """Catches shares that do not end at one, speeds or losses that are never filled in, and a wait
    for kernels with nothing to look at."""
    told = []
    figures = []
    first = []

    def report(progress):
        figures.append(dict(progress.figures()))
        if progress.stage == "Compiling kernels" and progress.preview is not None:
            progress.preview(tmp_path / "first.npz")
            first.append(len(read_avatar(tmp_path / "first.npz").splats))
        return bool(told.append(progress))

    train_run(toy, tmp_path, make_run(toy), report=report)
    training = [found for found, p in zip(figures, told, strict=True) if p.stage == "Training"]
    assert [found["iteration"] for found in training] == list(range(1, ITERATIONS + 1))
    assert [p.fraction for p in told if p.stage == "Training"][-1] == 1.0
    evaluating_s = read_metrics(tmp_path)[-2]["evaluation_s"]
    assert training[-1]["left_s"] == pytest.approx(2 * evaluating_s)
    assert all(found["per_second"] > 0 and np.isfinite(found["loss"]) for found in training)
    assert told[-1].stage == "Trained"
    assert "psnr" in figures[-1]
    assert first == [training[0]["splats"]]
