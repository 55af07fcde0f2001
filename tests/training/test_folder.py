"""A run's folder: what is written comes back, and what is damaged is refused in one sentence."""

import json
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from capture import factory
from numpy.testing import assert_array_equal, assert_equal
from refusal import refusal

from stga_addon.capture.selection import SelectionOptions
from stga_addon.training.optimize.state import arrays_of
from stga_addon.training.run import checkpoint as checkpoint_files
from stga_addon.training.run import folder, metrics_log
from stga_addon.training.run.checkpoint import Checkpoint
from stga_addon.training.run.folder import Run
from stga_addon.training.run.identity import RunIdentity
from stga_addon.training.settings import STRATEGIES, Rates, make_settings

from .toys import random_state

FACES = 5


def make_run(**changes):
    settings = make_settings(iterations=9, **changes)
    return Run(Path("/data/head"), Path("/data/flame.npz"), "opencv", settings)


def make_checkpoint():
    return Checkpoint(
        state=random_state(12, FACES),
        iteration=34,
        visit=7,
        last_timestep=3,
        initial_count=10,
        elapsed_s=12.5,
        evaluations=4,
        losses=(0.5, 0.25),
        lines=5,
        tracking_gain=0.5,
        tracking=np.zeros((5, 20)),
    )


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_run_round_trip(tmp_path, strategy):
    """Catches a setting, also of nested ones, that changes its value or kind in run.json."""
    bare = Run(Path("/x"), None, "vhap", make_settings(seconds=60.0))
    chosen = SelectionOptions(threshold=0.5, zero_pose="all", regions=("nose",))
    changes = {"background": (0.0, 0.5, 1.0), "selection": chosen, "rates": Rates(xyz=1.0)}
    for run in (make_run(strategy=strategy, **changes), bare):
        folder.write_run(tmp_path, run)
        assert repr(folder.read_run(tmp_path)) == repr(run)


@pytest.mark.parametrize("run", ["runs/anna", "anna run", "work/runs/anna_2"])
def test_paths_of_a_project_that_was_moved(tmp_path, run):
    """Catches Refine, Extend and `stga render RUN` that end with "OLD/capture: is not a folder"
    once capture and run were moved together; and a run, or what is elsewhere, taken for it."""
    for name in (f"{run}/run.json", "captures/anna/flame.npz", "runs/parent/run.json"):
        (tmp_path / "old" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "old" / name).touch()
    here = tmp_path / "old/captures/anna"
    further = folder.Continuation(tmp_path / "old/runs/parent", "", 0, 1)
    stored = replace(make_run(), capture=here, flame=here / "flame.npz", continuation=further)
    away = replace(stored, takes=(folder.Take(Path("/none/take"), 9, RunIdentity(*"12345678")),))
    folder.write_run(tmp_path / "old" / run, away)
    assert repr(folder.read_run(tmp_path / "old" / run)) == repr(away)
    (tmp_path / "old").rename(tmp_path / "new")
    found = folder.read_run(tmp_path / "new" / run)
    assert repr(found) == repr(away).replace(f"{tmp_path}/old", f"{tmp_path}/new")


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("version", 7, "has run format version 7, this add-on reads 8; train it again$"),
        ("version", None, "has run format version None, this add-on reads 8$"),
        ("format", "stga-avatar", "is not a run"),
        ("device", "toaster", "device: expected auto, cpu, gpu or gpu:NAME, got 'toaster'"),
        ("principal_point", "corner", "expected one of vhap, .*, got 'corner'"),
        (
            "continuation",
            {"parent": "a", "avatar": "b", "first": 5, "last": 3},
            "continuation: its last timestep 3 is before its first, 5",
        ),
    ],
)
def test_damaged_runs(tmp_path, field, value, message):
    """Catches a run of another version taken for one's own, and a traceback of one edited."""
    folder.write_run(tmp_path, make_run())
    factory.edit(tmp_path / "run.json", lambda document: document.update({field: value}))
    with refusal(rf"run\.json: .*{message}"):
        folder.read_run(tmp_path)


def test_selection_round_trip(tmp_path):
    """Catches timesteps mixed up, masks that lose their kind, and those of another mesh."""
    rng = np.random.default_rng(0)
    selection = {t: rng.random(FACES) < 0.5 for t in (0, 3, 123456)}
    checkpoint_files.write_selection(tmp_path, selection, "a")
    again = checkpoint_files.read_selection(tmp_path, FACES)
    assert list(again) == list(selection)
    for timestep, faces in selection.items():
        assert_array_equal(again[timestep], faces)
        assert again[timestep].dtype == bool
    with refusal(r"selection\.npz: '00000' is bool \(5,\), expected bool \(6,\)"):
        checkpoint_files.read_selection(tmp_path, FACES + 1)
    checkpoint_files.write_selection(tmp_path, {0: np.ones(FACES, np.float32)}, "a")
    with refusal("float32"):
        checkpoint_files.read_selection(tmp_path, FACES)
    np.savez(tmp_path / "selection.npz", mouth=selection[0])
    with refusal("'mouth'"):
        checkpoint_files.read_selection(tmp_path, FACES)


def test_checkpoint_round_trip(tmp_path):
    """Catches a moment or count lost, arrays by columns, and a possible value refused."""
    checkpoint = make_checkpoint()
    checkpoint_files.write_checkpoint(tmp_path, checkpoint)
    again = checkpoint_files.read_checkpoint(tmp_path)
    theirs = arrays_of(again.state)
    for name, array in arrays_of(checkpoint.state).items():
        if name.startswith("gradients/"):
            assert theirs[name].shape == array.shape
        else:
            assert_array_equal(theirs[name], array, err_msg=name)
        assert theirs[name].dtype == array.dtype
    left, right = ({**vars(each), "state": None} for each in (again, checkpoint))
    assert_equal(left, right)
    path = tmp_path / "checkpoint.npz"
    with np.load(path) as stored:
        by_columns = {name: np.asfortranarray(array) for name, array in stored.items()}
    np.savez(path, **by_columns)
    assert not by_columns["parameters/xyz"].flags.c_contiguous
    state = checkpoint_files.read_checkpoint(tmp_path).state
    assert all(array.flags.c_contiguous for array in arrays_of(state).values())
    largest = (1 << 53) - 1
    for counts in ((0, -1, None), (0, -1, 0), (largest, largest, largest)):
        names = ("iteration", "visit", "last_timestep")
        extreme = replace(make_checkpoint(), **dict(zip(names, counts, strict=True)))
        checkpoint_files.write_checkpoint(tmp_path, extreme)
        limited = checkpoint_files.read_checkpoint(tmp_path)
        assert (limited.iteration, limited.visit, limited.last_timestep) == counts


def meta(**changes):
    values = {
        "version": checkpoint_files.VERSION,
        **{k: v for k, v in vars(make_checkpoint()).items() if k not in ("state", "tracking")},
        **changes,
    }
    return np.frombuffer(json.dumps(values).encode(), np.uint8)


def strain_position(**changes):
    """The arrays of positions that follow strain, of FACES triangles, with changes."""
    tables = dict.fromkeys(("value", "average", "first", "second"), np.zeros((5, 3, 3), np.float32))
    arrays = {**tables, "steps": np.zeros(FACES, np.int32), **changes}
    return {f"strain_position/{name}": array for name, array in arrays.items()}


METAS = {
    "has checkpoint format version 3, this add-on reads 4; train it again": {"version": 3},
    r"fields are missing or unknown \(color\)": {"color": 3},
    "setting iteration: expected a whole number from 0 up to .*, got -1": {"iteration": -1},
    "setting iteration: .*, got 9007199254740992": {"iteration": 1 << 53},  # beyond what is exact
    "setting elapsed_s: .*, got inf": {"elapsed_s": math.inf},
    "setting elapsed_s: .*, got -1.0": {"elapsed_s": -1.0},
    "tracking_gain is 'x'": {"tracking_gain": "x"},
}
"""What is said of counts and other values -> them."""
SHAPES = r"first is float32 \(4, 3, 3\), expected float32 \(5, 3, 3\)"
DAMAGES = {
    **{says: {"meta": meta(**changes)} for says, changes in METAS.items()},
    "a field is missing": {"second/sh": None},
    "a field is missing or malformed": {"meta": None},
    r"/xyz is .* \(11, 3\), expected .* \(12, 3\)": {"first/xyz": np.zeros((11, 3), np.float32)},
    "an array has no rows": {"opacity": np.zeros((), np.float32)},
    "field is missing or malformed .*": {"meta": np.frombuffer(b"[]", np.uint8)},
    "parameters/xyz is float64": {"parameters/xyz": np.zeros((12, 3), np.float64)},
    "field is missing or malformed": {"tracking/parameters": np.zeros(20)},
    "tracking/parameters holds a value that is not finite": {
        "tracking/parameters": np.full((5, 20), np.nan)
    },
    f"strain_position/{SHAPES}": strain_position(first=np.zeros((4, 3, 3), np.float32)),
    "strain_position/steps is int64": strain_position(steps=np.zeros(FACES, np.int64)),
}


@pytest.mark.parametrize("says", DAMAGES)
def test_damaged_checkpoints(tmp_path, says):
    """Catches a checkpoint that only the kernels would trip over, or refused for what is right."""
    checkpoint_files.write_checkpoint(tmp_path, make_checkpoint())
    path = tmp_path / "checkpoint.npz"
    with np.load(path) as data:
        arrays = dict(data)
    np.savez(path, **{k: v for k, v in {**arrays, **DAMAGES[says]}.items() if v is not None})
    with refusal(rf"checkpoint\.npz: .*{says}"):
        checkpoint_files.read_checkpoint(tmp_path)


def line(iteration, **changes):
    """A line of metrics with the fields that every line has."""
    times = {"seconds": 0.5 * iteration, "evaluation_s": 0.1, "wall_s": float(iteration)}
    return {"iteration": iteration, "splats": 80, **times, **changes}


def test_metrics_with_a_cut_last_line(tmp_path):
    """Catches a last line that a kill cut in the way of resuming, and lines lost before it."""
    assert metrics_log.read_metrics(tmp_path) == []
    lines = [line(n, psnr=20.0 + n, ssim=0.9) for n in (10, 20, 30)]
    for written in lines:
        metrics_log.append_metrics(tmp_path, written)
    assert metrics_log.read_metrics(tmp_path) == lines
    path = tmp_path / "metrics.jsonl"
    whole = path.read_bytes()
    for cut in (b"\xff\xff\n", bytes(100), b"[" * 100_000, b'{"iteration": 40, "sec'):
        path.write_bytes(whole + cut)
        assert metrics_log.read_metrics(tmp_path) == lines
    path.write_bytes(whole[:-5])
    assert metrics_log.read_metrics(tmp_path) == lines[:2]
    metrics_log.cut_metrics(tmp_path, 2)
    metrics_log.append_metrics(tmp_path, line(25))
    assert metrics_log.read_metrics(tmp_path) == [*lines[:2], line(25)]
    metrics_log.cut_metrics(tmp_path, 1)
    assert metrics_log.read_metrics(tmp_path) == lines[:1]


FORECAST = {"seconds": 1.0, "psnr": 30.0, "error": 0.1, "ahead": 5.0, "gain": 0.5}


@pytest.mark.parametrize(
    ("damaged", "message"),
    [
        (5, "is no object"),
        ({"iteration": 10}, "seconds is None"),
        (line(10, wall_s=-1.0), "wall_s is -1.0"),
        ({**line(10), "iteration": 1.5}, r"iteration is 1\.5"),
        (line(10, psnr="high"), "psnr is 'high'"),
        (line(10, loss=10**400), "loss is 1000"),
        (line(10, psnr=30.0), "psnr has no ssim"),
        (line(10, forecast=5), "forecast: fields"),
        (line(10, psnr=3.0, ssim=1.0, forecast={**FORECAST, "gain": None}), "forecast: setting"),
        (line(10, forecast=FORECAST), "forecast has no psnr"),
    ],
)
def test_damaged_metrics(tmp_path, damaged, message):
    """Catches a traceback in resume, curve or summary for a missing or wrong field."""
    for written in (line(5), damaged, line(20)):
        metrics_log.append_metrics(tmp_path, written)
    with refusal(rf"metrics\.jsonl: line 2: {message}") as caught:
        metrics_log.read_metrics(tmp_path)
    assert len(str(caught.value)) < 400


def test_second_run_is_refused_while_the_first_lives(tmp_path):
    """Catches two processes writing one checkpoint, and a folder that is locked for ever."""
    target = tmp_path / "new" / "run"
    with folder.locked(target):
        mine = rf"another run is working in this folder \(process {os.getpid()}\)"
        with refusal(mine), folder.locked(target):
            pass
        assert (target / "run.lock").exists()  # the refused one must not take the lock away
    assert not (target / "run.lock").exists()
    for content in ("", "hello", "0", "1", str(os.getpid())):
        (tmp_path / "run.lock").write_text(content)
        with folder.locked(tmp_path):
            pass
        assert not (tmp_path / "run.lock").exists()
    (tmp_path / "file").write_text("x")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with refusal("cannot be written"), folder.locked(path):
            pass
