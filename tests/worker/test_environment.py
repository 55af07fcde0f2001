"""The training runtime: which commands make it, what its test says, and how it fails."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from stga_addon.errors import StgaError
from stga_addon.worker import environment as runtime
from stga_addon.worker import process as task
from stga_addon.worker.environment import InstallStep
from stga_addon.worker.environment_check import NEEDED
from stga_addon.worker.process import State

SMI = "| NVIDIA-SMI 575.57.08   Driver Version: 575.57.08   CUDA Version: {} |"
FOUND = {"python": "3.11.7", "found": dict.fromkeys(NEEDED, "1.0"), "broken": {}, "device": "CPU with 4 threads"}


@pytest.mark.parametrize(
    ("device", "driver", "chosen"),
    [
        ("cpu", "13.2", "cpu"),
        ("auto", None, "cpu"),
        ("auto", "11.4", "cpu"),
        ("auto", "12.6", "cuda"),
        ("cuda", "12.0", "cuda"),
        ("cuda", "14.1", "cuda"),
    ],
)
def test_the_device_fits_the_driver(device, driver, chosen):
    """Catches GPU packages where the driver is too old for them, and none where there is a GPU."""
    assert runtime.device_for(device, SMI.format(driver) if driver else None) == chosen


def test_cuda_that_cannot_be_is_refused():
    """Catches gigabytes that are downloaded in vain."""
    with pytest.raises(StgaError, match=r"goes up to CUDA 11\.4, training needs CUDA 12 or newer"):
        runtime.device_for("cuda", SMI.format("11.4"))
    with pytest.raises(StgaError, match="finds no NVIDIA GPU"):
        runtime.device_for("cuda", None)


def test_steps(tmp_path):
    """Catches a site's own index passed over, a network that offline steps would need, and what is never installed."""
    looking, making, small, rest = runtime.steps(tmp_path, "/python", "cuda", None, "linux")
    assert making.command == ["/python", "-m", "venv", str(tmp_path)]
    assert rest.command[0] == small.command[0] == str(runtime.venv_python(tmp_path))
    assert small.command[-3:] == ["--index-url", "https://download.pytorch.org/whl/cpu", "torch"]
    assert small.optional  # where pytorch.org cannot be reached, there is PyPI
    assert set(rest.command) >= {*NEEDED.values(), "warp-lang"}
    assert not rest.optional
    assert "--index-url" not in rest.command
    assert runtime.steps(tmp_path, "/python", "cuda", None, "win32") == [looking, making, rest]
    _, _, offline = runtime.steps(tmp_path, "/python", "cpu", tmp_path / "wheels", "linux")
    assert "--no-index" in offline.command
    assert str(tmp_path / "wheels") in offline.command
    assert set(offline.command) >= set(NEEDED.values())
    assert "warp-lang" not in offline.command


@pytest.mark.parametrize(("newest", "status"), [((3, 11), 0), ((99, 0), 1)])
def test_an_old_python_is_refused_at_once(newest, status, tmp_path, monkeypatch):
    """Catches gigabytes that are downloaded for a Python that cannot use them."""
    monkeypatch.setattr(runtime, "OLDEST", newest)
    looking = runtime.steps(tmp_path, sys.executable, "cpu", None)[0]
    done = subprocess.run(looking.command, capture_output=True, text=True)
    assert done.returncode == status
    assert ("ERROR: Python 3." in done.stderr) == bool(status)


def test_what_an_interpreter_says():
    """Catches a runtime that is called good and cannot train."""
    assert runtime.describe("p", FOUND) == "Python 3.11.7, torch 1.0, numba 1.0, CPU with 4 threads"
    old = {**FOUND, "python": "3.9.1"}
    with pytest.raises(StgaError, match=r"p: is Python 3\.9\.1, training needs 3\.11 or newer"):
        runtime.describe("p", old)
    bare = {**FOUND, "broken": {"torch": "ModuleNotFoundError: No module", "PIL": "OSError: libjpeg.so"}}
    with pytest.raises(StgaError, match=r"p: Python 3\.11\.7 lacks torch, pillow \(OSError: libjpeg\.so\); install"):
        runtime.describe("p", bare)


def test_a_bare_interpreter_is_tested(tmp_path):
    """Catches a test that needs what it tests for: this one has nothing at all installed."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv")], check=True)
    python = str(runtime.venv_python(tmp_path / "venv"))
    with pytest.raises(StgaError, match=r"lacks torch, numba, scipy, pillow, platformdirs, trimesh, tqdm; install"):
        runtime.probe(python)


def test_what_is_no_interpreter(tmp_path):
    """Catches tracebacks where a path leads to nothing, or to another program."""
    with pytest.raises(StgaError, match="cannot be started as a Python interpreter"):
        runtime.probe(str(tmp_path / "python"))
    with pytest.raises(StgaError, match=r"is no Python that can run this add-on \(exit status 1\)"):
        runtime.probe("false")


@pytest.mark.slow
def test_this_interpreter_can_train(tmp_path):
    """Catches a probe that misses what is there, and a worker that does not tell."""
    pytest.importorskip("torch")
    folder = runtime.task_folder(tmp_path)
    task.prepare(folder)
    process = task.start(folder, sys.executable, runtime.testing_arguments(tmp_path, sys.executable))
    assert process.wait(120) == 0, task.log_lines(folder, 50)
    seen = task.look(folder, process)
    assert seen.state == State.FINISHED
    assert seen.status.message.startswith(f"Python {sys.version.split()[0]}, torch ")


@pytest.fixture
def tiny(monkeypatch):
    """Only the environment and this package's probe: what pip would do is not this test's."""
    monkeypatch.setattr(runtime, "nvidia_smi", lambda: None)
    monkeypatch.setattr(runtime, "SIZES_GB", {"cpu": 0.0, "cuda": 0.0})
    made = [sys.executable, "-m", "venv", "--without-pip"]
    monkeypatch.setattr(runtime, "steps", lambda venv, *_: [InstallStep("making the environment", [*made, str(venv)])])


def test_a_runtime_is_made(tiny, tmp_path, monkeypatch):
    """Catches a runtime that is used before it has passed the test, or not found afterwards."""
    monkeypatch.setattr(runtime, "probe", lambda python: f"good {Path(python).exists()}")
    python = runtime.venv_python(tmp_path / "venv-1")
    python.parent.mkdir(parents=True)
    python.touch()
    assert runtime.made_python(tmp_path) is None  # what a killed maker leaves
    assert runtime.make(tmp_path, sys.executable) == "good True"
    made = runtime.made_python(tmp_path)
    assert made is not None
    assert [made] == [runtime.venv_python(folder) for folder in tmp_path.glob("venv-*")]
    assert task.read_status(runtime.task_folder(tmp_path)).message == "good True"


def test_a_runtime_that_fails_leaves_nothing(tiny, tmp_path):
    """Catches half an environment that is taken for a runtime the next time."""
    with pytest.raises(StgaError, match="lacks torch"):
        runtime.make(tmp_path, sys.executable)
    assert runtime.made_python(tmp_path) is None
    assert not list(tmp_path.glob("venv*"))
    assert task.look(runtime.task_folder(tmp_path)).state == State.FAILED


def test_an_attempt_in_vain_keeps_the_runtime(tiny, tmp_path, monkeypatch):
    """Catches an artist who can train, tries a newer runtime without a network, and can train no more."""
    with monkeypatch.context() as patched:
        patched.setattr(runtime, "probe", lambda python: "good")
        runtime.make(tmp_path, sys.executable)
    before = runtime.made_python(tmp_path)
    with pytest.raises(StgaError, match="lacks torch"):
        runtime.make(tmp_path, sys.executable)
    assert before is not None
    assert runtime.made_python(tmp_path) == before


@pytest.mark.parametrize(
    ("printed", "reason"),
    [
        ("ERROR: Could not install packages due to an OSError: [Errno 28] No space left on device", "the disk is full"),
        (
            "The virtual environment was not created successfully because ensurepip is not\navailable",
            "no ensurepip; choo",
        ),
        (
            "WARNING: Retrying after connection broken by 'X'\nERROR: No matching distribution",
            "indexes cannot be reached",
        ),
        ("ERROR: no matching distribution\nnotice", "ERROR: no matching distribution$"),
        ("connection broken by an optional step\n$ pip\nERROR: no space", "ERROR: no space$"),
        ("ERROR: No matching distribution found for torch", "for torch: none that fits this Python and system$"),
        ("bye", "exit status 1$"),
    ],
)
def test_a_failing_step_names_its_reason(printed, reason, tiny, tmp_path, monkeypatch):
    """Catches pip's message lost in a log that nobody opens, and one that says nothing to an artist."""
    log = runtime.task_folder(tmp_path) / task.LOG
    script = f"import sys; open({str(log)!r}, 'a').write({printed + chr(10)!r}); sys.exit(1)"
    monkeypatch.setattr(runtime, "steps", lambda *_: [InstallStep("installing torch", [sys.executable, "-c", script])])
    with pytest.raises(StgaError, match=f"installing torch: failed, .*{reason}"):
        runtime.make(tmp_path, sys.executable)


def test_an_optional_step_may_fail(tiny, tmp_path, monkeypatch):
    """Catches no runtime at all where pytorch.org cannot be reached, and PyPI can."""
    monkeypatch.setattr(runtime, "probe", lambda python: "good")
    failing = InstallStep("failing", [sys.executable, "-c", "raise SystemExit(1)"], optional=True)
    making = runtime.steps
    monkeypatch.setattr(runtime, "steps", lambda *given: [*making(*given), failing])
    assert runtime.make(tmp_path, sys.executable) == "good"


def test_cancelling_stops_pip_and_cleans_up(tiny, tmp_path, monkeypatch):
    """Catches a cancel that waits for a download to end, or leaves half an environment."""
    folder = runtime.task_folder(tmp_path)
    script = f"import pathlib, time; pathlib.Path({str(folder / 'cancel')!r}).touch(); time.sleep(600)"
    steps = [
        InstallStep(
            "making the environment", [sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv-1")]
        ),
        InstallStep("waiting", [sys.executable, "-c", script]),
    ]
    monkeypatch.setattr(runtime, "steps", lambda *_: steps)
    assert runtime.make(tmp_path, sys.executable) == ""
    assert task.look(folder).state == State.CANCELLED
    assert not list(tmp_path.glob("venv*"))


def test_a_disk_too_small_is_refused(tmp_path, monkeypatch):
    """Catches a full disk after half an hour of downloading."""
    monkeypatch.setattr(runtime.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 10**8}))
    with pytest.raises(StgaError, match=r"has 0\.1 GB free, the runtime needs 1\.5 GB"):
        runtime.make(tmp_path, sys.executable, "cpu")


def test_the_probe_runs_by_itself():
    """Catches a probe that prints something else than one JSON object last."""
    done = subprocess.run(
        [sys.executable, "-m", "stga_addon.worker.environment_check"], capture_output=True, text=True, check=True
    )
    assert set(json.loads(done.stdout.splitlines()[-1])) == set(FOUND)
