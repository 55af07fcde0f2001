"""The whole command line on generated arguments and damaged inputs: exit code 0, 2 or 130, one
bounded sentence.

STGA_FUZZ_CASES sets the number of cases and STGA_FUZZ_FIRST the first one; case n is the same in
every run.
"""

import io
import os
import random
import shutil
import signal
import tempfile
import traceback
import warnings
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from capture import factory
from flame.small_head import small_head
from tracking.recording import record

from stga_addon.capture.open import open_capture
from stga_addon.cli.main import main
from stga_addon.development.benchmark.variants import Benchmark
from stga_addon.driving.inverse import write_performance
from stga_addon.driving.performance import Performance
from stga_addon.jobs import table as ask
from stga_addon.jobs.avatar_source import OpenHead, Played, write_head
from stga_addon.jobs.perform import write_request
from stga_addon.tracking.head_model import HeadModel
from stga_addon.training import preset_timing
from stga_addon.training.run.folder import read_run

from .arguments import REQUESTS, generate_arguments, tracked_footage
from .damages import damage

CASES = int(os.environ.get("STGA_FUZZ_CASES", 60))
"""Of every run of the tests; `make fuzz` tries 20,000."""
PARTS = min(10, 1 + CASES // 200)
"""Tests that the cases are spread over, so that several processes share them; each makes the files
anew, which takes longer than all cases of `make test`."""
FIRST_CASE = int(os.environ.get("STGA_FUZZ_FIRST", 0))
MAX_CASE_S = 60
MAX_OUTPUT_CHARACTERS = 2000
REPORTED_FAILURES = 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """FOLDER/template, from which FOLDER/case is copied anew for every case; paths in its files
    point into the case."""
    folder = tmp_path_factory.mktemp("fuzz")
    case = folder / "case"
    capture = factory.write_mesh_capture(case / "mesh", (0, 1), range(2))
    flame, model = factory.write_flame_capture(case / "flame", (0, 1), range(2))
    factory.write_release(case / "release")
    for name, options in {"run": [capture], "tracked": [flame, "--flame", model]}.items():
        strategy = ["--strategy", "gaussian-avatars", "--iterations", 2]
        assert call(["train", *options, *strategy, "--out", case / name])[0] == 0
    shutil.copytree(case / "run", case / "unfinished")
    (case / "unfinished/avatar.npz").unlink()
    splats = ["--effect", "hull-points=off", "--out", case / "splats"]
    assert call(["train", capture, "--iterations", 2, "--device", "cpu", *splats])[0] == 0
    factory.write_mesh_capture(case / "take", (0, 1), range(2))
    record(case / "footage", HeadModel(small_head(0), "flame"))
    assert call(["track", *tracked_footage(case), "--out", case / "footage/out"])[0] == 0
    requests = requests_about(case)
    assert set(requests) == set(REQUESTS)
    for name, request in requests.items():
        write_request(case / "jobs" / name, request)
    assert call(["export", case / "run", "--format", "ply", "--out", case / "splats.ply"])[0] == 0
    played = Played({4: open_capture(capture).neutral}, selection={4: np.ones(320, bool)})
    avatar = case / "run/avatar.npz"
    head = OpenHead(capture, None, "vhap", avatar, 24.0, lambda: played.selection, lambda: played)
    write_head(case / "head", head, played=True)
    (case / "take.blend").write_bytes(b"BLENDER")
    write_performance(
        case / "take.csv", Performance(np.arange(3) / 30, np.full((3, 52), 0.3), None, 30.0)
    )
    np.savez(case / "motion.npz", expr=np.zeros((2, 2)), pose=np.zeros((2, 15)), shape=np.zeros(4))
    case.rename(folder / "template")
    (folder / "start").mkdir()
    return folder


def requests_about(case):
    """A request of each kind, by its name, about the files of the case."""
    capture = case / "mesh"
    run = case / "splats"
    footage = case / "footage"
    once = {"iterations": 1, "device": "cpu"}
    settings = read_run(case / "run").settings
    key = np.zeros(small_head(0).n_expression + 18)
    avatar = case / "run/avatar.npz"
    played = Played({4: open_capture(capture).neutral})
    tracking = ask.Track(
        footage / "footage", footage / "head.npz", case / "asked", landmarks=footage / "points"
    )
    capture_of_avatar = case / "made/capture"
    requests = (
        ask.Train(case / "asked", capture, settings, selection={0: np.ones(320, bool)}),
        ask.Resume(run, capture, device="cpu"),
        ask.Refine(case / "refined", run, weights=np.linspace(0, 1, 320, dtype=np.float32), **once),
        ask.Extend(case / "extended", run, (case / "take",), **once),
        tracking,
        ask.MakeAvatar(
            replace(tracking, out=capture_of_avatar),
            ask.Train(case / "made/run", capture_of_avatar, settings),
        ),
        ask.SolveAgain(footage / "out", footage / "head.npz", {1: key}),
        ask.RenderRecording(case / "none.bin", case / "asked.mp4", 1, 25.0),
        ask.Analyze(capture),
        ask.Evaluate(run),
        ask.Render(
            avatar, case / "asked", cameras=capture / "transforms_val.json", capture=capture
        ),
        ask.Export(avatar, case / "asked.glb", "web", capture, played=played),
        ask.ConvertMotion(case / "take.csv", case / "asked.npz", footage / "head.npz"),
        ask.Select(capture),
        ask.TimePresets(capture),
        ask.Relight(case / "run", flame=None),
        ask.MakeExact(case / "run"),
        ask.RenderBlend(case / "take.blend", case / "asked", (1, 2)),
        Benchmark(case / "asked", capture, 1.0, only=("draft",)),
    )
    return {type(request).__name__: request for request in requests}


@pytest.fixture(autouse=True)
def _without_what_takes_minutes(monkeypatch):
    monkeypatch.setattr(preset_timing, "seconds_per_iteration", lambda *_, **__: 1e-5)
    monkeypatch.setattr("stga_addon.development.commands.carry_out_plan", lambda *_: None)
    monkeypatch.setattr("stga_addon.development.benchmark.benchmark.write_report", lambda *_: "")
    monkeypatch.setattr("stga_addon.development.benchmark.slice.train_in_turns", lambda *_: {})
    monkeypatch.setenv("STGA_BLENDER", "no-such-blender")
    monkeypatch.setattr("stga_addon.development.demo.run.run_demo", lambda *_, **__: None)


def call(arguments):
    """Exit code, stdout and stderr of the command line."""
    out = io.StringIO()
    error = io.StringIO()
    with redirect_stdout(out), redirect_stderr(error):
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as stopped:  # argparse's way
            code = stopped.code
    return code, out.getvalue(), error.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
def test_command_line(folder, monkeypatch, part):
    """Catches tracebacks, other exit codes, long messages, numeric warnings, hangs and files left
    half-written."""
    case = folder / "case"
    scratch = folder / "scratch"
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    monkeypatch.chdir(folder / "start")  # relative names of outputs end up in FOLDER
    failures = {}
    for number in range(FIRST_CASE + part, FIRST_CASE + CASES, PARTS):
        shutil.rmtree(case, ignore_errors=True)
        shutil.rmtree(scratch, ignore_errors=True)
        shutil.copytree(folder / "template", case)
        scratch.mkdir()
        rng = random.Random(number)
        arguments, variables = generate_arguments(rng, case)
        damages = [damage(rng, case, arguments) for _ in range(rng.choice([0, 1, 1, 1, 2, 5]))]
        with monkeypatch.context() as patch:
            for name, value in variables.items():
                patch.setenv(name, value)
            problem = find_problem(arguments, [case, scratch])
        if problem:
            described = f"case {number}: {variables!a} stga {ascii(arguments)[:600]}"
            described += f"\n  after {ascii(damages)[:600]}"
            failures.setdefault(problem, []).append(described)
            print(f"{described}\n  {problem}", flush=True)
    report = [f"{len(found)} x {problem}\n{found[0]}" for problem, found in failures.items()]
    assert not failures, "\n\n".join(report[:REPORTED_FAILURES])


def find_problem(arguments, folders):
    """What is wrong with a call, as one text for all calls with the same cause; None where it
    behaves."""

    def stop(*_):
        raise TimeoutError(f"no answer in {MAX_CASE_S} s")

    signal.signal(signal.SIGALRM, stop)
    signal.alarm(MAX_CASE_S)
    try:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always", RuntimeWarning)
            code, out, error = call(arguments)
    except BaseException as unexpected:
        if isinstance(unexpected, KeyboardInterrupt):
            raise
        places = traceback.extract_tb(unexpected.__traceback__)
        place = [line for line in places if "stga_addon" in line.filename][-1]
        where = f"{Path(place.filename).name}:{place.lineno} {place.name}"
        return f"{type(unexpected).__name__} in {where}: {ascii(str(unexpected))[:150]}"
    finally:
        signal.alarm(0)
    if code not in (0, 2, 130):
        return f"exit code {code}"
    if "Traceback" in out + error:
        return f"traceback in {error[-300:]}"
    if code == 2 and len(error) > MAX_OUTPUT_CHARACTERS:
        return f"{len(error)} characters on stderr: {error[:200]}"
    if code == 2 and not error:
        return "exit code 2 without a message"
    numeric = [warning for warning in warned if issubclass(warning.category, RuntimeWarning)]
    if numeric:
        place = f"{Path(numeric[0].filename).name}:{numeric[0].lineno}"
        return f"warning in {place}: {numeric[0].message}"
    files = [path for folder in folders for path in folder.rglob("*") if not path.is_dir()]
    left = [p for p in files if p.name.endswith(".partial") or p.is_relative_to(folders[-1])]
    return f"left behind: {left[0].name}" if left else None
