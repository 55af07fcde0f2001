"""Requests: what is written down, what is refused, and what a worker does."""

import math
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
from capture.factory import edit, write_avatar_of, write_mesh_capture
from cli.test_render_video import decoded
from command_line import stga
from equality import assert_same
from refusal import refusal

from stga_addon.avatar.file import read_avatar, write_avatar
from stga_addon.capture.open import open_capture
from stga_addon.errors import StgaError
from stga_addon.files import read_npz
from stga_addon.format import describe_left
from stga_addon.jobs import analyze as analysis
from stga_addon.jobs import perform as jobs
from stga_addon.jobs import track as tracking_jobs
from stga_addon.jobs import train
from stga_addon.jobs.analyze import Analyze
from stga_addon.jobs.export import Export
from stga_addon.jobs.perform import perform_in_folder, write_request
from stga_addon.jobs.render import Render
from stga_addon.jobs.table import JOBS, Result
from stga_addon.jobs.track import SolveAgain, Track
from stga_addon.jobs.train import Resume, Train
from stga_addon.progress import Clock, Progress, TimeLeft, Written
from stga_addon.tracking.stages import Stage
from stga_addon.training import preset_timing
from stga_addon.training.effect_catalog import RELIGHT, WORLD, EffectDecision
from stga_addon.training.effects import plan
from stga_addon.training.run.folder import Run, write_run
from stga_addon.training.settings import PRESETS, make_settings
from stga_addon.worker.launch import start_worker
from stga_addon.worker.status import (
    CANCEL_FILE,
    LOG_FILE,
    STATUS_FILE,
    WorkerState,
    inspect_worker,
    log_lines,
    request_cancel,
    status_writer,
)

from .tables import REQUESTS, RESULTS


@pytest.fixture
def capture(tmp_path):
    return write_mesh_capture(tmp_path / "capture")


def training(run, capture, **changes):
    settings = make_settings(
        "selective", **{"iterations": 12, "hull_points": False, "seed": 3, **changes}
    )
    return Train(run, capture, settings, principal_point="opencv", selection=painted())


def painted():
    return {0: np.zeros(320, bool), 1: np.arange(320) < 40, 3: np.arange(320) % 2 == 0}


def check(request):
    JOBS[type(request)].check(request)


def asked(request):
    """The folder of a request that is written into it."""
    folder = jobs.request_folder(request.run)
    write_request(folder, request)
    return folder


def test_every_request_is_tried():
    """Catches a request or result that is missing in the tables here, or has no work."""
    assert {type(request) for request in REQUESTS} == set(JOBS)
    assert {type(result) for result in RESULTS} == set(get_args(Result))


@pytest.mark.parametrize("value", [*REQUESTS, *RESULTS], ids=lambda value: type(value).__name__)
def test_round_trip(tmp_path, value):
    """Catches a field that is lost, or changes its type, between the panel and the worker."""
    if type(value) in JOBS:
        write_request(tmp_path, value)
        assert_same(jobs.read_request(tmp_path), value)
    else:
        jobs.write_result(tmp_path, value)
        assert_same(jobs.read_result(tmp_path), value)


def test_the_next_request_forgets_the_last(tmp_path, capture):
    """Catches yesterday's selection, preview, result or wish to cancel in today's work."""
    folder = asked(training(tmp_path / "run", capture))
    for name in (jobs.PREVIEW, CANCEL_FILE, STATUS_FILE):
        (folder / name).write_text("{}")
    jobs.write_result(folder, RESULTS[1])
    write_request(folder, REQUESTS[-1])
    assert sorted(path.name for path in folder.iterdir()) == [jobs.REQUEST, LOG_FILE]


def test_refusals(tmp_path, capture):
    """Catches a run overwritten, or resumed where none is, only after a worker was started."""
    run = tmp_path / "run"
    with refusal(r"holds no run \(run\.json is missing\)"):
        check(Resume(run))
    assert not run.exists()
    write_run(run, Run(capture, None, "vhap", make_settings(iterations=5)))
    with refusal("already holds a run; resume it, or choose another folder"):
        check(training(run, capture))
    check(Resume(run))
    folder = asked(Resume(run))
    with status_writer(folder), refusal("another worker is running"):
        write_request(folder, Resume(run))
    with refusal("holds no tracked capture to solve again"):
        check(SolveAgain(tmp_path / "nothing", Path("m"), {}))
    with refusal("already holds a capture"):
        check(Track(Path("f"), Path("m"), capture))


DAMAGES = {"format": "stga-job", "version": 0, "kind": "Paint", "run": 5}
DAMAGES |= {"capture": None, "device": "toaster", "settings": {}, "principal_point": "up"}
DAMAGES |= {"selection": {"x": {"array": "selection.0"}}, "unknown": 1}
TEXTS = "[]", "3", '{"format": "stga-request", "version": 1}', "[" * 100_000


@pytest.mark.parametrize("name", [*DAMAGES, *TEXTS], ids=lambda name: name[:20])
def test_damaged_requests(tmp_path, name):
    """Catches a traceback or a guess for a request that is damaged or of another version."""
    write_request(tmp_path, REQUESTS[0])
    if name in DAMAGES:
        edit(tmp_path / jobs.REQUEST, lambda values: values.update({name: DAMAGES[name]}))
    else:
        (tmp_path / jobs.REQUEST).write_text(name)
    expected = "" if name in TEXTS else f"({name}|not a request that this version reads)"
    with refusal(rf"request\.json: .*{expected}"):
        jobs.read_request(tmp_path)


def test_time_left_is_told_by_the_pace_of_what_was_done_last():
    """Catches an average over slow and fast work, and work that was done in an earlier call."""
    now = 0.0
    left = TimeLeft(lambda: now)
    assert math.isnan(left.after(0.0))
    left.after(0.5)  # done before
    for share in np.linspace(0.51, 0.7, 20):
        now += 3
        told = left.after(share)
    assert told == pytest.approx(0.3 * 300)
    for share in np.linspace(0.71, 0.85, 15):
        now += 1
        told = left.after(share)
    assert told == pytest.approx(0.15 * 100)


QUICK_LOOK_S = {
    Stage.HEAD_MODEL: 0.3,
    Stage.LANDMARKS: 1.1,
    Stage.FOCAL_LENGTH: 48.4,
    Stage.FIT: 18.2,
    Stage.ONLY_DENSE: 35.4,
    Stage.MATTES: 4.7,
    Stage.TORSO: 24.3,
    Stage.CLOTH: 5.7,
    Stage.CONTACT_SHEET: 6.1,
    Stage.HEADS: 2.7,
}
"""Seconds of the stages of a video of ten frames, on a busy machine."""


def test_the_time_left_of_a_quick_look(monkeypatch):
    """Catches time that is left which stands still, as stages of a short video take another part of
    the time than those of a long one."""
    now = 0.0
    told = []
    monkeypatch.setattr("stga_addon.jobs.track.TimeLeft", lambda: TimeLeft(lambda: now))
    steps = tracking_jobs._Steps(lambda progress: told.append((now, progress.figures()["left_s"])))
    frames = SimpleNamespace(timesteps=range(10))
    steps.plan(SimpleNamespace(cameras=[frames], focal="usual"))
    for stage, seconds in QUICK_LOOK_S.items():
        for done in range(8):
            steps.report(stage, done, 7)
            now += seconds / 7 if done < 7 else 0.0
    assert told[-1] == (pytest.approx(now), pytest.approx(0.0, abs=1e-6))
    late = [(at, left) for at, left in told if 20 < at < 130]
    assert len(late) > 30
    assert all(0.5 < left / (now - at) < 2 for at, left in late)
    lowest = np.minimum.accumulate([left for _, left in late])
    fell_at = [at for (at, left), low in zip(late, lowest, strict=True) if left == low]
    assert np.diff([*fell_at, late[-1][0]]).max() < 15


def test_a_clock_never_goes_back(tmp_path):
    """Catches 73, 25, 55 and 7 minutes that are left one after another, too little that is said as
    if it were true, and 100 % before the end."""
    minutes = (73.0, 64.0, 49.0, 25.0, 39.0, 55.0, 24.0, math.nan, 7.0)
    shares = (0.0, 0.3, 0.2, 0.4, 0.5, 0.6, 0.9, 1.0, 1.0)
    told = []
    with status_writer(tmp_path) as writer:
        for number, (left, share) in enumerate(zip(minutes, shares, strict=True)):
            figures = {"left_s": 60 * left}
            writer.report(Progress(share, f"Stage {number}", figures=lambda f=figures: f))
            told.append(inspect_worker(tmp_path).status)
    expected = ["About 73", "About 64", "About 49", "About 25", "More than 25", "More than 25"]
    expected += ["About 24", "About 24", "About 7"]
    sentences = [describe_left(status.figures) for status in told]
    assert sentences == [f"{each} min left" for each in expected]
    assert [status.progress for status in told] == [0.0, 0.3, 0.3, 0.4, 0.5, 0.6, 0.9, 0.99, 0.99]


def as_told(series):
    """The seconds that are left and the sentence about them, after each report of a series: when,
    what the work says is left, and whether it knows that to be too little."""
    times = [0.0]
    clock = Clock(lambda: times[-1])
    for now, left_s, *longer in series:
        times.append(now)
        figures = {"left_s": left_s, **dict.fromkeys(["longer"] if any(longer) else [], 1.0)}
        told = clock.reported(Progress(figures=lambda figures=figures: figures))
        yield told.get("left_s"), describe_left(told)


END_S = 154.5
UNDER_LOAD = (
    (26.2, 28.0, True),
    (70.8, 28.0),
    (73.7, 25.1),
    (83.6, 25.4),
    (84.6, 24.5),
    (87.8, 21.9),
    (89.8, 20.2),
    (90.8, 20.2),
    (125.3, 20.0),
)
"""A training of 8 s beside 15 other processes that compiled its kernels before, and its end."""


def test_no_more_is_left_than_is_told():
    """Catches "About 28 s left" when 128 were, and a time that rises."""
    told = list(as_told(UNDER_LOAD))
    left = [left_s for left_s, _ in told]
    assert left == sorted(left, reverse=True)
    for (now, *_), (left_s, sentence) in zip(UNDER_LOAD, told, strict=True):
        assert "More than" in sentence or END_S - now <= 1.25 * left_s + 1, (now, sentence)


def test_what_has_not_come_true_is_not_said_again():
    """Catches "About 20 s left" for a minute and a half, a number that stands still, and no number
    where work takes much longer."""
    series = ((0.0, 20.0), (20.0, 19.9), (90.0, 19.8), (900.0, 19.7))
    said = [sentence for _, sentence in as_told(series)]
    assert said == ["About 20 s left", *(f"More than {left} s left" for left in (18, 11, 1))]


def test_work_that_says_no_more_how_long_it_takes():
    """Catches a time in the panel that comes and goes from stage to stage."""
    series = ((0.0, math.nan), (1.0, 20.0), (2.0, math.nan), (40.0, math.nan))
    said = [sentence for _, sentence in as_told(series)]
    assert said == ["", "About 20 s left", "About 19 s left", "More than 15 s left"]


def test_who_is_silent_takes_longer(tmp_path):
    """Catches "About 28 s left" for as long as a worker compiles and says nothing."""
    with status_writer(tmp_path) as writer:
        writer.report(Progress(stage="Analyzing", figures=lambda: {"left_s": 28.0}))
        for silent_s, expected in ((5.0, "About 28"), (20.0, "More than 26")):
            told = time.time() - silent_s
            os.utime(tmp_path / STATUS_FILE, (told, told))
            sentence = describe_left(inspect_worker(tmp_path).status.figures)
            assert sentence == f"{expected} s left"


def test_an_analysis_says_how_long_it_takes(monkeypatch):
    """Catches minutes of "Timing the presets" without a time."""
    now = [0.0]

    def take(seconds, what):
        now[0] += seconds
        return what

    timings = (take(20.0, SimpleNamespace(preset=name, seconds=1.0)) for name in PRESETS)
    capture = SimpleNamespace(views={"train": [0]}, warnings=())
    monkeypatch.setattr(analysis, "monotonic", lambda: now[0])
    monkeypatch.setattr(analysis, "open_capture", lambda *_: take(2.0, capture))
    monkeypatch.setattr(plan, "plan_effects", lambda *_: take(8.0, (None, ())))
    monkeypatch.setattr(preset_timing, "time_presets", lambda *_, **__: timings)
    told = []
    analysis.analyze(Analyze(Path("capture"), timed=True), told.append, print)
    left = [progress.figures().get("left_s", 0.0) for progress in told]
    shares = [progress.fraction for progress in told]
    assert shares == sorted(shares)
    for gone_s, share, left_s in zip((10.0, 30.0, 50.0), shares[1:], left[1:], strict=True):
        assert gone_s / (gone_s + left_s) == pytest.approx(share)


def test_what_follows_training_is_told_ahead(tmp_path, monkeypatch):
    """Catches 100 % for minutes of light and world, and a time that is too short before training
    knows its own."""

    plan = [EffectDecision(name, "auto", True, "", "") for name in (RELIGHT, WORLD)]

    class Prepared:
        capture = SimpleNamespace(warnings=())
        request = Train(tmp_path, tmp_path, make_settings(iterations=1))
        run = SimpleNamespace(effect_plan=plan, settings=SimpleNamespace(tracking=False))

        def train_as_asked(self, report):
            report(Progress(0.0, "Placing splats"))
            report(Progress(0.5, "Training", figures=lambda: {"left_s": 30.0}))
            report(Progress(1.0, "Finished", figures=lambda: {"left_s": 1.0}))
            return SimpleNamespace(path=tmp_path / "avatar.npz")

    def half(prepared, *others):
        others[-1](Progress(0.5, "Halfway"))
        return ("done",) if len(others) == 2 else "done"

    monkeypatch.setattr(train, "prepare", lambda *_: Prepared())
    monkeypatch.setattr(train, "report_run", lambda *_: [])
    monkeypatch.setattr(train, "CurveUpdater", lambda _: lambda _: None)
    for name in ("_light_of", "_world_of"):
        monkeypatch.setattr(train, name, half)
    told = []

    def report(progress):
        told.append((progress.fraction, progress.figures()["left_s"]))
        return False

    train.train_and_finish(Prepared.request, report, print)
    shares, left = zip(*told, strict=True)
    assert shares == pytest.approx([0.0, 0.45, 0.9, 0.9, 0.925, 0.975])
    assert math.isnan(left[0])
    assert left[1:] == pytest.approx([70.0, 41.0, 40.0, 30.0, 10.0])


@pytest.mark.slow
def test_a_worker_renders_and_exports_what_the_command_line_would(tmp_path, capture):
    """Catches a farm whose files differ from those of `stga render` and `stga export`."""
    avatar = write_avatar_of(open_capture(capture), tmp_path / "a.npz", is_colored=True)
    cameras = capture / "transforms_val.json"
    given = f"{avatar} --capture {capture}"
    turned = "--turntable 120 --seconds 0.5 --fps 8 --camera 1 --device cpu"
    turn = {"turntable": 120.0, "camera": 1, "fps": 8.0, "seconds": 0.5, "device": "cpu"}
    black = {"cameras": cameras, "background": (0.0, 0.0, 0.0)}
    asked_for = {
        "pictures": (
            f"render {given} --cameras {cameras} --background black --out",
            Render(avatar, tmp_path / "pictures", capture=capture, **black),
        ),
        "film.mp4": (
            f"render {given} {turned} --video",
            Render(avatar, tmp_path / "film.mp4", True, capture=capture, **turn),
        ),
        "page.glb": (
            f"export {given} --format web --fps 30 --out",
            Export(avatar, tmp_path / "page.glb", "web", capture, fps=30.0),
        ),
    }
    for name, (words, request) in asked_for.items():
        folder = tmp_path / f"{name}_job"
        write_request(folder, request)
        process = start_worker(folder, sys.executable, jobs.worker_arguments(folder))
        assert process.wait(300) == 0, log_lines(folder, 50)
        assert jobs.read_result(folder) == Written(tmp_path / name)
        here = tmp_path / "here" / name
        there = tmp_path / name
        assert stga(words, here) == 0
        assert contents(there)
        # Kernels of another process may round another way, and the encoder then chooses another.
        if name.endswith(".mp4"):
            found, expected = (np.stack(decoded(path)[1]) for path in (here, there))
            assert found.shape == expected.shape
            assert len(found) == 4
            difference = np.abs(found.astype(int) - expected)
            assert difference.mean() < 0.5
            assert difference.max() < 30
        else:
            assert contents(here) == contents(there)


def contents(path):
    """Name -> bytes of the files of a folder, or of one file."""
    files = path.glob("[!.]*") if path.is_dir() else (path,)
    return {file.name: file.read_bytes() for file in files}


@pytest.mark.slow
def test_a_cancelled_render_keeps_its_pictures_alone(tmp_path, capture):
    """Catches a worker that renders a whole film after it was cancelled, or leaves half a video."""
    avatar = write_avatar_of(open_capture(capture), tmp_path / "a.npz")
    for name, kept in (("turn", 3), ("turn.mp4", 0)):
        folder = tmp_path / f"{name}_job"
        is_video = name.endswith(".mp4")
        wanted = Render(avatar, tmp_path / name, is_video, turntable=90.0, capture=capture)
        write_request(folder, replace(wanted, device="cpu"))

        def cancel_at_the_second(progress, folder=folder):
            if progress.detail.startswith("Image 2 of"):
                request_cancel(folder)
            return False

        assert perform_in_folder(folder, also=cancel_at_the_second) is None
        assert inspect_worker(folder).state == WorkerState.CANCELLED
        assert len(list((tmp_path / name).glob("*.png"))) == kept
        assert not (tmp_path / "turn.mp4").exists()


@pytest.mark.slow
def test_a_request_continues_what_it_began(tmp_path, capture):
    """Catches a cancel that throws work away, a job that trains anew, and lost figures."""
    request = training(tmp_path / "run", capture, iterations=40)
    folder = asked(request)

    def cancel(progress):
        if iteration_of(progress) == 5:
            request_cancel(folder)
        assert iteration_of(progress) <= 6
        return False

    perform_in_folder(folder, also=cancel, resume=True)
    assert inspect_worker(folder).state == WorkerState.CANCELLED
    assert (request.run / "avatar.npz").exists()
    asked(request)
    with refusal("already holds a run"):
        perform_in_folder(folder)
    asked(request)
    iterations = []
    perform_in_folder(
        folder, also=lambda progress: iterations.append(iteration_of(progress)), resume=True
    )
    assert min(n for n in iterations if n) >= 5
    assert max(iterations) == 40
    seen = inspect_worker(folder)
    found = jobs.read_result(folder)
    assert seen.state == WorkerState.FINISHED
    assert {"splats", "psnr", "loss", "memory_mb", "per_second"} <= set(seen.status.figures)
    assert found.lines[-1] == f"avatar: {request.run / 'avatar.npz'}"
    tracked = Track(tmp_path, tmp_path / "head.npz", tmp_path / "tracked")
    tracked.out.mkdir()
    (tracked.out / "transforms_train.json").touch()
    write_request(tracked.out / "job", tracked)
    assert perform_in_folder(tracked.out / "job", resume=True) == Written(tracked.out)


def iteration_of(progress):
    return progress.figures().get("iteration", 0)


@pytest.mark.slow
def test_previews_while_it_trains(tmp_path, capture, monkeypatch):
    """Catches a preview that never comes, changes the training, or ends it where disks are full."""
    monkeypatch.setattr("stga_addon.worker.status.PREVIEW_INTERVAL_S", 0.0)
    run = tmp_path / "run"
    quiet = tmp_path / "quiet"
    previews = []
    folder = asked(training(run, capture))

    def look(progress):
        if (folder / jobs.PREVIEW).exists():
            previews.append(len(read_avatar(folder / jobs.PREVIEW).splats))
        return False

    def full(path, avatar):
        if path.name == jobs.PREVIEW:
            raise StgaError(f"{path}: cannot be written (No space left on device)")
        write_avatar(path, avatar)

    perform_in_folder(folder, also=look)
    assert len(previews) > 5
    monkeypatch.setattr("stga_addon.training.run.session.write_avatar", full)
    perform_in_folder(asked(training(quiet, capture)))
    assert not (jobs.request_folder(quiet) / jobs.PREVIEW).exists()
    np.testing.assert_array_equal(
        read_npz(run / "avatar.npz")["xyz"], read_npz(quiet / "avatar.npz")["xyz"]
    )


@pytest.mark.slow
def test_mistakes_reach_the_folder_and_the_exit_code(tmp_path, capture, capsys):
    """Catches a failure that only the log shows, and a command that ends well in spite of it."""
    assert stga("perform", tmp_path / "nothing") == 2
    assert "holds no request" in capsys.readouterr().err
    assert not (tmp_path / "nothing").exists()
    folder = asked(training(tmp_path / "run", capture))
    (capture / "meshes/00003.obj").write_text("v 0 0 nan\n")
    assert stga("perform", folder) == 2
    seen = inspect_worker(folder)
    assert seen.state == WorkerState.FAILED
    assert "00003.obj" in seen.status.error
    assert seen.status.traceback == ""


def test_an_interpreter_without_anything_is_named(tmp_path, capture):
    """Catches a traceback about imports where a sentence should say which Python lacks what."""
    folder = asked(training(tmp_path / "run", capture))
    subprocess.run(
        [sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv")], check=True
    )
    python = tmp_path / "venv/bin/python"
    process = start_worker(folder, str(python), jobs.worker_arguments(folder))
    assert process.wait(60) == 2
    seen = inspect_worker(folder, process)
    says = f"Worker exited with status 2: stga: {python} lacks the package 'numpy'"
    assert seen.status.error == says
