"""The whole command line on generated arguments and damaged inputs: exit code 0, 2 or 130, one bounded sentence.

STGA_FUZZ_CASES sets the number of cases and STGA_FUZZ_FIRST the first one; case n is the same in every run.
"""

import copy
import io
import itertools
import json
import os
import random
import shutil
import signal
import tempfile
import traceback
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from capture import factory
from PIL import Image
from tracking.test_track import record

from stga_addon.capture.open import open_capture
from stga_addon.cli.main import main
from stga_addon.development.demo.head import synthetic_flame
from stga_addon.driving.inverse import write_performance
from stga_addon.driving.performance import Performance
from stga_addon.requests import values as ask
from stga_addon.requests.folder import write_request
from stga_addon.tracking.head_model import HeadModel
from stga_addon.training import preset_timing
from stga_addon.training.run.folder import read_run

pytest.importorskip("torch")

CASES = int(os.environ.get("STGA_FUZZ_CASES", 100))
"""Of every run of the tests; `make fuzz` tries 20,000."""
PARTS = min(10, 1 + CASES // 200)
"""Tests that the cases are spread over, so that several processes share them; each makes the files anew, which takes
longer than a hundred cases."""
FIRST_CASE = int(os.environ.get("STGA_FUZZ_FIRST", 0))
MAX_CASE_S = 60
MAX_OUTPUT_CHARACTERS = 2000
REPORTED_FAILURES = 20

REQUESTS = tuple(kind.__name__ for kind in get_args(ask.Request))
NUMBERS = [
    "0", "1", "2", "-1", "nan", "inf", "-inf", "1e308", "1e-320", "0x10", "1_0", "٣", " 1", "", "9" * 400, "many",
]  # fmt: skip
TEXTS = [
    "", " ", ".", "..", "/", "//", "a\0b", "\ud800", "a" * 300, "a/" * 3000, "ä²−", "\n", "\x1b[2J", "-", "--", "=",
    "~",
]  # fmt: skip
JSON_VALUES: list[Any] = [
    *(None, True, False, 0, 1, -1, 2.5, 10**30, -(10**400), 1e308, 1e-320, float("nan"), float("inf"), -float("inf")),
    *(
        "1",
        "nan",
        *TEXTS,
        "/",
        "//",
        "a" * 5000,
        "vhap",
        "opencv",
        "../x",
        "/dev/null",
        "images",
        "images/00000_00.png",
    ),
    *([], {}, [[]], [None], [0] * 1000, {"": {}}, [[0, 0, 0, 0]] * 4, [1e300] * 3, {"a": [1, {"b": None}]}),
]
ARRAYS: list[Callable[[np.ndarray], np.ndarray]] = [
    lambda a: a[:-1] if a.ndim else a.reshape(1), lambda a: a[None], lambda a: a.astype(np.float16),
    lambda a: np.zeros(0, a.dtype), lambda a: np.zeros((0, *a.shape[1:]), a.dtype), lambda a: np.full_like(a, 0),
    lambda a: -a if a.dtype.kind in "if" else ~a if a.dtype.kind == "b" else a, lambda a: np.full(a.shape, np.nan),
    lambda a: np.full(a.shape, 1e30), lambda a: np.full(a.shape, np.inf, np.float32),
    lambda a: np.full(a.shape, 2**62), lambda a: np.full(a.shape, "x"),
    lambda a: a.astype(complex) if a.dtype.kind in "if" else a, lambda a: a.astype(bool), lambda a: a.T,
    lambda a: np.concatenate([a, a]) if a.ndim else a,
]  # fmt: skip
BYTES = [b"\xff" * 8, b"\0" * 8, b"-1", b"1e999", b"NaN", b"[", b"]", b'"', b"{}", b"\n", b".", b"\x80", b"99999999999"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """FOLDER/template, from which FOLDER/case is copied anew for every case; paths in its files point into the case."""
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
    splats = ["--iterations", 2, "--device", "cpu", "--effect", "hull-points=off", "--out", case / "splats"]
    assert call(["train", capture, *splats])[0] == 0
    factory.write_mesh_capture(case / "take", (0, 1), range(2))
    record(case / "footage", HeadModel(synthetic_flame(0), "flame"))
    assert call(["track", *tracked_footage(case), "--out", case / "footage/out"])[0] == 0
    requests = requests_about(case)
    assert set(requests) == set(REQUESTS)
    for name, request in requests.items():
        write_request(case / "jobs" / name, request)
    assert call(["export", case / "run", "--format", "ply", "--out", case / "splats.ply"])[0] == 0
    (case / "head").mkdir()
    head = {
        "capture": str(capture),
        "flame": None,
        "avatar": str(case / "run/avatar.npz"),
        "principal_point": "vhap",
        "fps": 24.0,
    }
    (case / "head/head.json").write_text(json.dumps(head))
    (case / "take.blend").write_bytes(b"BLENDER")
    write_performance(case / "take.csv", Performance(np.arange(3) / 30, np.full((3, 52), 0.3), None, 30.0))
    np.savez(case / "motion.npz", expr=np.zeros((2, 2)), pose=np.zeros((2, 15)), shape=np.zeros(4))
    case.rename(folder / "template")
    (folder / "start").mkdir()
    return folder


def tracked_footage(case: Path) -> list[str]:
    """What `stga track` is given to track the footage of the case from its landmark files."""
    footage = case / "footage"
    return [str(footage / "footage"), "--model", str(footage / "head.npz"), "--landmarks", str(footage / "points")]


def requests_about(case: Path) -> dict[str, ask.Request]:
    """A request of each kind, by its name, about the files of the case."""
    capture, run, footage, once = case / "mesh", case / "splats", case / "footage", {"iterations": 1, "device": "cpu"}
    settings = read_run(case / "run").settings
    key = np.zeros(synthetic_flame(0).n_expression + 18)
    avatar, played = case / "run/avatar.npz", ask.Played({4: open_capture(capture).neutral})
    requests: tuple[ask.Request, ...] = (
        ask.Train(case / "asked", capture, settings, selection={0: np.ones(320, bool)}),
        ask.Resume(run, capture, device="cpu"),
        ask.Refine(case / "refined", run, weights=np.linspace(0, 1, 320, dtype=np.float32), **once),
        ask.Extend(case / "extended", run, (case / "take",), **once),
        ask.SelectForTake(run, case / "take"),
        ask.Track(footage / "footage", footage / "head.npz", case / "asked", landmarks=footage / "points"),
        ask.SolveAgain(footage / "out", footage / "head.npz", {1: key}),
        ask.RenderRecording(case / "none.bin", case / "asked.mp4", 1, 25.0),
        ask.Analyze(capture),
        ask.Evaluate(run),
        ask.Render(avatar, case / "asked", cameras=capture / "transforms_val.json", capture=capture),
        ask.Export(avatar, case / "asked.stga", "web", capture, played=played),
        ask.ConvertMotion(case / "take.csv", case / "asked.npz", footage / "head.npz"),
        ask.Select(capture),
        ask.TimePresets(capture),
        ask.Relight(case / "run", flame=None),
        ask.RenderBlend(case / "take.blend", case / "asked", (1, 2)),
        ask.Benchmark(case / "asked", capture, 1.0, only=("draft",)),
    )
    return {type(request).__name__: request for request in requests}


@pytest.fixture(autouse=True)
def _without_what_takes_minutes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preset_timing, "seconds_per_iteration", lambda *_, **__: 1e-5)
    monkeypatch.setattr("stga_addon.development.benchmark.command.carry_out_plan", lambda *_: None)
    monkeypatch.setattr("stga_addon.development.benchmark.benchmark.write_report", lambda *_: "")
    monkeypatch.setattr("stga_addon.development.benchmark.slice.train_in_turns", lambda *_: {})
    monkeypatch.setenv("STGA_BLENDER", "no-such-blender")
    monkeypatch.setattr("stga_addon.development.demo.command.run", lambda _: None)


def call(arguments: list[Any]) -> tuple[Any, str, str]:
    """Exit code, stdout and stderr of the command line."""
    out, error = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(error):
        try:
            code: Any = main([str(argument) for argument in arguments])
        except SystemExit as stopped:  # argparse's way
            code = stopped.code
    return code, out.getvalue(), error.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
def test_command_line(folder: Path, monkeypatch: pytest.MonkeyPatch, part: int) -> None:
    """Catches tracebacks, other exit codes, long messages, numeric warnings, hangs and files left half-written."""
    case, scratch = folder / "case", folder / "scratch"
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    monkeypatch.chdir(folder / "start")  # relative names of outputs end up in FOLDER
    failures: dict[str, list[str]] = {}
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
            tell = f"case {number}: {variables!a} stga {ascii(arguments)[:600]}\n  after {ascii(damages)[:600]}"
            failures.setdefault(problem, []).append(tell)
            print(f"{tell}\n  {problem}", flush=True)
    report = [f"{len(found)} x {problem}\n{found[0]}" for problem, found in failures.items()]
    assert not failures, "\n\n".join(report[:REPORTED_FAILURES])


def find_problem(arguments: list[str], folders: list[Path]) -> str | None:
    """What is wrong with a call, as one text for all calls with the same cause; None where it behaves."""

    def stop(*_: Any) -> None:
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
        place = [line for line in traceback.extract_tb(unexpected.__traceback__) if "stga_addon" in line.filename][-1]
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
        return f"warning in {Path(numeric[0].filename).name}:{numeric[0].lineno}: {numeric[0].message}"
    left = [path.name for path in itertools.chain.from_iterable(map(files_in, folders)) if is_temporary(path, folders)]
    return f"left behind: {left[0]}" if left else None


def files_in(folder: Path) -> Iterator[Path]:
    for parent, _, names in os.walk(folder):
        yield from (Path(parent) / name for name in names)


def is_temporary(path: Path, folders: list[Path]) -> bool:
    return path.name.endswith(".partial") or path.is_relative_to(folders[-1])


# Arguments


def generate_arguments(rng: random.Random, case: Path) -> tuple[list[str], dict[str, str]]:
    """A command line about the files of the case, with some nonsense in it, and environment variables."""
    command = rng.choices(list(COMMANDS), [weight for weight, _ in COMMANDS.values()])[0]
    arguments = [command, *COMMANDS[command][1](rng, case)]
    if rng.random() < 0.04 and len(arguments) > 1:
        arguments.pop(rng.randrange(1, len(arguments)))
    if rng.random() < 0.1:
        arguments.insert(
            rng.randrange(len(arguments) + 1), rng.choice([*TEXTS, *NUMBERS, "--bogus", "--help", "--out"])
        )
    variables = {}
    if rng.random() < 0.1:
        variables["STGA_HEAD"] = rng.choice([str(case / "head")] * 3 + [str(case), "a" * 5000, ".", str(case / "none")])
    if rng.random() < 0.05:
        variables["STGA_LPIPS"] = rng.choice([some_path(rng, case), "a" * 5000]).replace("\0", "")
    if rng.random() < 0.05:
        variables["STGA_PYTHON"] = rng.choice([some_path(rng, case), "a" * 5000]).replace("\0", "")
    variables = {name: value.encode("utf-8", "replace").decode() for name, value in variables.items()}
    return arguments, variables


def some_path(rng: random.Random, case: Path, *likely: str) -> str:
    """Usually one of the `likely` names in the case, sometimes any file of it, sometimes nonsense."""
    chance = rng.random()
    if likely and chance < 0.9:
        return str(case / rng.choice(likely))
    if chance < 0.96:
        return str(rng.choice(sorted(case.rglob("*"))))
    return rng.choice([*TEXTS, str(case / "none"), f"{case}/" + "a" * 300])


def output(rng: random.Random, case: Path, name: str) -> list[str]:
    return ["--out", str(case / name) if rng.random() < 0.8 else some_path(rng, case)]


def option(rng: random.Random, share: float, name: str, *values: str) -> list[str]:
    """Sometimes the option, its first value more often than the others."""
    return [name, values[0] if rng.random() < 0.5 else rng.choice(values)] if rng.random() < share else []


def capture_arguments(rng: random.Random, case: Path) -> list[str]:
    kind = rng.choice(["mesh", "mesh", "flame", "release", "mesh/meshes", "motion.npz"])
    share = 0.9 if kind in ("flame", "motion.npz") else 0.05
    arguments = [some_path(rng, case, kind), *option(rng, share, "--flame", some_path(rng, case, "flame/model.npz"))]
    return [*arguments, *option(rng, 0.2, "--principal-point", "vhap", "opencv", "center", *TEXTS)]


def effects_and_device(rng: random.Random) -> list[str]:
    choices = [
        f"{name}={choice}" for name in ("jaw", "teeth", "tracking", "exposure") for choice in ("on", "off", "auto")
    ]
    effects = option(rng, 0.2, "--effect", *choices, *TEXTS, "jaw=", "=on", "a" * 5000)
    return [*effects, *option(rng, 0.2, "--device", "cpu", "auto", "tpu")]


def train(rng: random.Random, case: Path) -> list[str]:
    options = [*option(rng, 0.2, "--seed", "5", *NUMBERS), *option(rng, 0.2, "--threshold", "0.001", *NUMBERS)]
    options += [*option(rng, 0.2, "--target-psnr", "30", *NUMBERS), *option(rng, 0.3, "--schedule", "paper", "default")]
    options += option(rng, 0.3, "--strategy", "global", "selective", "gaussian-avatars", "x")
    options += ["--stop-when-flat"] if rng.random() < 0.1 else []
    if rng.random() < 0.6:
        run, capture = rng.choice([("run", "mesh"), ("unfinished", "mesh"), ("tracked", "flame"), ("run", "flame")])
        arguments = [some_path(rng, case, capture), "--out", some_path(rng, case, run), "--resume"]
        return [
            *arguments,
            *(options if rng.random() < 0.2 else []),
            *option(rng, 0.2, "--flame", f"{case}/flame/model.npz"),
        ]
    budget = rng.choice(
        [["--iterations", rng.choice(["1", "2"])]] * 4 + [["--budget", rng.choice(["0.01s", *NUMBERS[:9]])]]
    )
    return [*capture_arguments(rng, case), *output(rng, case, "new"), *budget, *effects_and_device(rng), *options]


def render(rng: random.Random, case: Path) -> list[str]:
    source = some_path(rng, case, "run", "tracked", "run/avatar.npz", "splats.ply", "unfinished")
    cameras = some_path(rng, case, "mesh/transforms_val.json", "flame/transforms_test.json")
    arguments = [source, *option(rng, 0.8, "--cameras", cameras)]
    arguments += option(rng, 0.2, "--turntable", "90", "360", *NUMBERS)
    arguments += option(rng, 0.2, "--camera", "0", "2", *NUMBERS)
    # A turntable always has few images: each takes as long as one of any other render.
    arguments += ["--seconds", rng.choice(["0", "0.1"]), *option(rng, 0.1, "--fps", "10", "0", "-1", "nan")]
    arguments += option(rng, 0.2, "--frames", "0:3", "2-2", "9:12", *TEXTS)
    arguments += option(rng, 0.3, "--capture", some_path(rng, case, "mesh", "flame"))
    arguments += option(rng, 0.2, "--flame", some_path(rng, case, "flame/model.npz"))
    arguments += option(rng, 0.2, "--motion", some_path(rng, case, "motion.npz", "flame", "take.csv"))
    arguments += option(rng, 0.2, "--background", "black", "0,0.5,1", "nan,0,0", "1,2", "1e400,0,0", *TEXTS)
    arguments += option(rng, 0.1, "--principal-point", "vhap", "opencv", *TEXTS)
    if rng.random() < 0.2:
        return [*arguments, "--video", some_path(rng, case, "new.mp4", "new.avi")]
    return [*arguments, *output(rng, case, "pictures")]


def export(rng: random.Random, case: Path) -> list[str]:
    arguments = [some_path(rng, case, "run", "tracked", "run/avatar.npz", "tracked/avatar.npz", "unfinished")]
    format = rng.choice(["ply", "ply", "ply-sequence", "gaussian-avatars", "usd", "web", "gltf", "spz", "obj"])
    arguments += ["--format", format]
    arguments += option(rng, 0.3, "--capture", some_path(rng, case, "mesh", "flame"))
    arguments += option(rng, 0.2, "--flame", some_path(rng, case, "flame/model.npz"))
    arguments += option(rng, 0.3, "--timestep", "1", *NUMBERS)
    arguments += option(rng, 0.2, "--frames", "0:1", "1:0", "7:9", *NUMBERS)
    arguments += option(rng, 0.2, "--fps", "25", *NUMBERS)
    suffix = {"usd": ".usdc", "web": ".html", "gltf": ".glb", "spz": ".spz"}.get(format, "")
    return [*arguments, *output(rng, case, "exported" + suffix)]


def select(rng: random.Random, case: Path) -> list[str]:
    options = [
        *option(rng, 0.3, "--threshold", "0.001", *NUMBERS),
        *option(rng, 0.2, "--zero-pose", "head", "all", "x"),
    ]
    return [*capture_arguments(rng, case), *options, *option(rng, 0.3, "--out", some_path(rng, case, "new.npz"))]


def info(rng: random.Random, case: Path) -> list[str]:
    flags = [flag for flag in ("--json", "--presets") if rng.random() < 0.3]
    return [*capture_arguments(rng, case), *effects_and_device(rng), *flags]


def evaluate(rng: random.Random, case: Path) -> list[str]:
    return [
        some_path(rng, case, "run", "tracked", "unfinished"),
        *option(rng, 0.5, "--split", "train", "test", "x"),
    ]


def benchmark(rng: random.Random, case: Path) -> list[str]:
    arguments = [*capture_arguments(rng, case), *option(rng, 0.3, "--seeds", *NUMBERS)]
    return [*arguments, *option(rng, 0.3, "--budget", *NUMBERS), *option(rng, 0.3, "--only", "draft", "x", *TEXTS)]


def demo(rng: random.Random, case: Path) -> list[str]:
    return [*option(rng, 0.5, "--budget", *NUMBERS), *option(rng, 0.5, "--out", some_path(rng, case))]


def refine(rng: random.Random, case: Path) -> list[str]:
    region = option(rng, 0.9, "--region", "mouth", some_path(rng, case, "mesh/regions.json", "motion.npz"), *TEXTS)
    frames = option(rng, 0.2, "--frames", "0-1", "1-0", "7-9", *NUMBERS)
    return [some_path(rng, case, "splats", "run"), *region, *frames, *continuing(rng, case)]


def extend(rng: random.Random, case: Path) -> list[str]:
    takes = [some_path(rng, case, "take", "mesh", "flame") for _ in range(rng.choice([1, 1, 1, 2, 0]))]
    only = option(rng, 0.3, "--select-only", some_path(rng, case, "new.npz"))
    return [some_path(rng, case, "splats", "run"), *takes, *only, *([] if only else continuing(rng, case))]


def relight(rng: random.Random, case: Path) -> list[str]:
    light = option(rng, 0.3, "--light", some_path(rng, case, "mesh", "motion.npz"))
    return [some_path(rng, case, "splats", "run"), *light, *option(rng, 0.3, "--gray-card", "0.5,0.5,0.4", *TEXTS)]


def continuing(rng: random.Random, case: Path) -> list[str]:
    """Options that `refine` and `extend` share; each training has an iteration or two."""
    arguments = ["--iterations", rng.choice(["1", "1", "2", "0", "x"]), *output(rng, case, "new")]
    arguments += [*option(rng, 0.2, "--growth", "0.5", *NUMBERS), *option(rng, 0.2, "--seed", "5", *NUMBERS)]
    arguments += ["--resume"] if rng.random() < 0.05 else []
    return [*arguments, *option(rng, 0.2, "--device", "cpu", "auto", "tpu")]


def track(rng: random.Random, case: Path) -> list[str]:
    if rng.random() < 0.4:
        return [*tracked_footage(case), *output(rng, case, "new"), *option(rng, 0.2, "--focal", "900", *NUMBERS)]
    arguments = [
        some_path(rng, case, "mesh", "flame", "mesh/images"),
        "--model",
        some_path(rng, case, "flame/model.npz"),
    ]
    for name in ("--landmarks", "--cameras", "--detector"):
        arguments += option(rng, 0.3, name, some_path(rng, case, "mesh", "mesh/transforms.json"))
    for name in ("--start", "--stop", "--step", "--focal"):
        arguments += option(rng, 0.2, name, "1", *NUMBERS)
    arguments += option(rng, 0.2, "--sync", "auto", "motion", *TEXTS) + option(rng, 0.2, "--world", "keep", *TEXTS)
    return [*arguments, *option(rng, 0.2, "--offset", "0=1", *TEXTS), *output(rng, case, "new")]


def avatar(rng: random.Random, case: Path) -> list[str]:
    begun = case / "new" / "inputs.json"  # as if a first call had been interrupted
    if rng.random() < 0.4:
        begun.parent.mkdir(parents=True, exist_ok=True)
        begun.write_text(rng.choice(["{}", "[]", '{"model": 1}', '{"model": "x", "footage": null}', "x"]))
    iterations = ["--iterations", rng.choice(["2", "0", "x"])]
    return [*track(rng, case), *iterations, *(["--no-blend"] if rng.random() < 0.8 else [])]


def drive(rng: random.Random, case: Path) -> list[str]:
    arguments = [some_path(rng, case, "take.csv", "motion.npz", "flame")]
    arguments += ["--out", some_path(rng, case, "new.csv", "new.npz")]
    arguments += option(rng, 0.7, "--flame", some_path(rng, case, "flame/model.npz"))
    arguments += option(rng, 0.2, "--head", some_path(rng, case, "flame", "mesh"))
    arguments += option(rng, 0.2, "--fps", "25", *NUMBERS)
    arguments += option(rng, 0.2, "--neutral", "quiet", "first", *TEXTS)
    arguments += option(rng, 0.2, "--strength", "2", *NUMBERS)
    arguments += option(rng, 0.2, "--smooth", "0.1", *NUMBERS)
    return arguments + option(rng, 0.2, "--gain", "jaw=2", "x=1", "jaw=nan", *TEXTS)


BATCH_PLANS = (
    'out = "{new}"\n[job.a]\nrequest = "train"\ncapture = "mesh"\nsettings = {{ preset = "draft" }}\n'
    'sweep = {{ "settings.seed" = [0, 1] }}\n[job.b]\nrequest = "evaluate"\nrun = "{{a}}"\nsplit = {value}\n',
    'out = "{new}"\n[resources]\nthreads = {value}\n[job.a]\nrequest = "track"\nminutes = {value}\n',
    "[job.a]\nrequest = {value}\ncases = [{{ name = {value} }}]\n",
    "{value}",
)


def batch(rng: random.Random, case: Path) -> list[str]:
    """Plans, and what a farm is given: jobs themselves are requests, which `perform` is tried with."""
    value = rng.choice(['"val"', "1", "-1", "nan", "1e400", "[]", '"{b}"', '"../x"', '""', "true"])
    new = some_path(rng, case, "new")
    plan = rng.choice(BATCH_PLANS).format(new=new, value=value)
    (case / "plan.toml").write_bytes(plan.encode("utf-8", "surrogatepass"))
    arguments = ["--dry-run"] if rng.random() < 0.7 else ["--emit", rng.choice(["openjd", "flamenco"])]
    if rng.random() < 0.6:
        return [str(case / "plan.toml"), *arguments, *option(rng, 0.3, "--threads", *NUMBERS)]
    arguments += ["--iterations", rng.choice(["3", *NUMBERS]), *option(rng, 0.3, "--seed", *NUMBERS)]
    return [some_path(rng, case, "mesh", "flame"), *arguments, *option(rng, 0.8, "--out", new)]


def environment(rng: random.Random, case: Path) -> list[str]:
    action = rng.choice([["test"], ["remove"], ["use", some_path(rng, case)], ["use", "x"], ["x"]])
    return ["--folder", some_path(rng, case, "new"), *action]


COMMANDS: dict[str, tuple[float, Callable[[random.Random, Path], list[str]]]] = {
    "info": (3, info), "select": (3, select), "export": (3, export), "drive": (1, drive), "render": (3, render),
    "eval": (2, evaluate), "train": (1, train), "refine": (0.5, refine), "extend": (0.5, extend),
    "relight": (0.5, relight), "track": (1, track), "avatar": (0.5, avatar),
    "perform": (1.5, lambda rng, case: [some_path(rng, case, *(f"jobs/{name}" for name in REQUESTS))]),
    "batch": (1, batch), "presets": (0.5, lambda rng, case: capture_arguments(rng, case)),
    "benchmark": (0.5, benchmark), "demo": (0.2, demo), "environment": (0.2, environment),
    "x": (0.1, lambda rng, case: []),
}  # fmt: skip


# Damage


def damage(rng: random.Random, case: Path, arguments: list[str]) -> str:
    """Change one file of the case, mostly one that the arguments name; returns what was done to it."""
    files = sorted(path for path in case.rglob("*") if path.is_file() and not path.is_symlink())
    named = [path for path in files if any(str(path).startswith(a) for a in arguments if a.startswith(f"{case}/"))]
    small = [path for path in named if path.suffix in (".json", ".npz", ".ply", ".jsonl", ".obj")]
    path = rng.choice(rng.choice([small, small, named, files]) or files)
    special = {".json": mutate_json, ".jsonl": mutate_json, ".npz": mutate_npz, ".png": mutate_picture}
    kind = rng.choice([special.get(path.suffix, mutate_bytes)] * 6 + [mutate_bytes] * 2 + [replace_file])
    return f"{path.relative_to(case)}: {kind.__name__} {kind(rng, path)}"


def mutate_bytes(rng: random.Random, path: Path) -> str:
    content = path.read_bytes()
    at, length = rng.randrange(len(content) + 1), rng.choice([0, 1, 4, 40])
    piece = rng.choice([*BYTES, rng.randbytes(4), content[at : at + length] * 2, b""])
    content = content[:at] + piece + content[at + length :]
    path.write_bytes(content if rng.random() < 0.8 else content[:at])
    return f"at {at}"


def mutate_json(rng: random.Random, path: Path) -> str:
    """Replace, delete, add or copy one value, at any depth."""
    try:
        text = path.read_text(encoding="utf-8")
        document = [json.loads(line) for line in (text.splitlines() if path.suffix == ".jsonl" else [text])]
    except (ValueError, RecursionError):  # an earlier damage
        return mutate_bytes(rng, path)
    node: Any = document
    trail: list[Any] = []
    while True:
        keys: list[Any] = list(node) if isinstance(node, dict) else list(range(len(node)))
        if not keys:
            return "nothing"
        key = rng.choice(keys)
        trail.append(key)
        if not isinstance(node[key], (dict, list)) or not node[key] or rng.random() < 0.15 * (len(trail) > 1):
            break
        node = node[key]
    kind = rng.choice(["replace"] * 6 + ["delete", "copy", "scale"])
    if kind == "replace":
        node[key] = copy.deepcopy(rng.choice(JSON_VALUES))
    elif kind == "scale" and isinstance(node[key], (int, float)):
        node[key] *= rng.choice([-1, 0, 1e-9, 1e9, 0.5])
    elif kind == "copy":
        node[key] = copy.deepcopy(rng.choice([node[k] for k in keys]))
    elif isinstance(node, dict) or len(trail) > 1:
        del node[key]
    texts = [json.dumps(value) for value in document]
    path.write_text("\n".join(texts))
    return f"{kind} {trail}"


def mutate_npz(rng: random.Random, path: Path) -> str:
    """Change, remove or rename one array of an intact archive."""
    try:
        with np.load(path) as data:
            arrays = dict(data)
    except Exception:  # an earlier damage
        return mutate_bytes(rng, path)
    if not arrays:
        return "nothing"
    name = rng.choice(list(arrays))
    chance = rng.random()
    if chance < 0.1:
        del arrays[name]
    elif chance < 0.2:
        arrays[rng.choice(["x", "../x", "0", f"{name}/"])] = arrays.pop(name)
    elif chance < 0.4 and arrays[name].size and arrays[name].dtype.kind in "if":
        flat = arrays[name] = arrays[name].copy()
        worst = [np.nan, np.inf, -1e30, 1e6] if flat.dtype.kind == "f" else [-1, np.iinfo(flat.dtype).max]
        flat.reshape(-1)[rng.randrange(flat.size)] = rng.choice(worst)
    else:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                arrays[name] = rng.choice(ARRAYS)(arrays[name])
            except (ValueError, TypeError):
                del arrays[name]
    with zipfile.ZipFile(path, "w") as archive:
        for entry, array in arrays.items():
            with archive.open(f"{entry}.npy", "w") as stream:
                np.lib.format.write_array(stream, np.asarray(array))
    return f"{name} {arrays[name].dtype if name in arrays else 'gone'}"


def mutate_picture(rng: random.Random, path: Path) -> str:
    """Another size, mode or format in the same file."""
    size = rng.choice([(40, 60), (60, 40), (1, 1), (41, 60), (4000, 4000)])
    mode = rng.choice(["RGB", "RGBA", "L", "LA", "P", "I;16", "1", "F", "CMYK"])
    kind = {"F": "TIFF", "CMYK": "JPEG"}.get(mode, "PNG")
    Image.new(mode, size).save(path, kind)
    return f"{mode} {size}"


def replace_file(rng: random.Random, path: Path) -> str:
    """Nothing, an empty file, a folder, a link to itself, a pipe or another file in its place."""
    kind = rng.choice(["missing", "empty", "folder", "link", "pipe", "other"])
    content = rng.choice(sorted(other for other in path.parent.iterdir() if other.is_file())).read_bytes()
    path.unlink()
    if kind == "empty":
        path.touch()
    elif kind == "folder":
        path.mkdir()
    elif kind == "link":
        path.symlink_to(path.name)
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "other":
        path.write_bytes(content)
    return kind
