"""Workers and their status folder, without Blender: start, progress, cancel, failure, and workers
that are killed."""

import errno
import math
import os
import platform
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from refusal import refusal

from stga_addon.errors import StgaError
from stga_addon.progress import Progress
from stga_addon.worker import launch, status
from stga_addon.worker.launch import (
    prepare_status_folder,
    same_interpreter_environment,
    start_worker,
    worker_environment,
)
from stga_addon.worker.status import WorkerState, WorkerStatus, inspect_worker
from stga_addon.worker.training_python import this_python

ROOT = Path(__file__).resolve().parents[2]
# A worker that reports progress until it is cancelled, or does what its argument says.
WORKER = """
import os, sys, time
from pathlib import Path
from stga_addon.progress import Progress
from stga_addon.worker.status import status_writer
from stga_addon.errors import StgaError

def main():
    with status_writer(Path(sys.argv[1])) as writer:
        print("a line of the log", flush=True)
        for n in range(2000):
            if writer.report(Progress(n / 2000, "counting", "on time",
                lambda: {"n": n, "nothing": float("nan")})):
                return
            if sys.argv[2] == "sentence": raise StgaError("capture: is not a folder")
            if sys.argv[2] == "bug": raise ValueError("a bug\\nof two lines")
            if sys.argv[2] == "exit": os._exit(7)
            if sys.argv[2] == "done": return
            time.sleep(0.01)
main()
"""


@pytest.fixture
def start(tmp_path, monkeypatch):
    """Start the worker above as a module, in a status folder that is returned with the process."""
    (tmp_path / "counting.py").write_text(WORKER)
    path = os.pathsep.join([str(ROOT), str(tmp_path)])
    environment = lambda variables, python: {**variables, "PYTHONPATH": path}  # noqa: E731
    monkeypatch.setattr(launch, "worker_environment", environment)
    running = []

    def run(action="work"):
        folder = tmp_path / "status"
        prepare_status_folder(folder)
        running.append(start_worker(folder, sys.executable, ["counting", str(folder), action]))
        return folder, running[-1]

    yield run
    for process in running:
        process.kill()
        process.wait()


def wait(condition, seconds=20.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_worker_is_cancelled(start):
    """Catches lost figures, a cancel that is ignored, and a second worker in the folder."""
    folder, process = start()
    assert inspect_worker(folder, process).state.is_alive
    wait(lambda: inspect_worker(folder, process).state == WorkerState.WORKING)
    # as a Blender sees it that did not start the worker
    wait(lambda: inspect_worker(folder).status.progress > 0)
    snapshot = inspect_worker(folder)
    assert snapshot.state == WorkerState.WORKING
    assert (snapshot.status.message, snapshot.status.detail) == ("counting", "on time")
    assert snapshot.status.figures["n"] > 0
    if os.name != "nt":
        nicer = min(os.getpriority(os.PRIO_PROCESS, 0) + 5, 19)
        assert os.getpriority(os.PRIO_PROCESS, process.pid) == nicer
    with refusal(rf"another worker is running here \(process {process.pid}\)"):
        prepare_status_folder(folder)
    with refusal("another worker"):
        status.remove_status_folder(folder)
    status.request_cancel(folder)
    status.request_cancel(folder)
    assert inspect_worker(folder, process).state in (WorkerState.CANCELLING, WorkerState.CANCELLED)
    assert process.wait(20) == 0
    final = inspect_worker(folder, process)
    assert final.state == WorkerState.CANCELLED
    assert 0 < final.status.progress < 1
    status.remove_status_folder(folder)
    assert not folder.exists()
    assert inspect_worker(folder) == status.WorkerSnapshot()


FAILURES = {
    "sentence": (1, "capture: is not a folder"),
    "bug": (1, "ValueError: a bug"),
    "exit": (7, "Worker exited with status 7: a line of the log"),
}


@pytest.mark.parametrize("action", FAILURES)
def test_failures_are_reported(start, action):
    """Catches a user's mistake with a traceback, and a crash whose report lacks it, or the log."""
    folder, process = start(action)
    code, error = FAILURES[action]
    assert process.wait(20) == code
    snapshot = inspect_worker(folder, process)
    assert snapshot.state == (WorkerState.LOST if action == "exit" else WorkerState.FAILED)
    assert snapshot.status.error == error
    assert snapshot.log_tail
    report = status.failure_report(folder, snapshot)
    assert report.startswith(f"{error}\nTraceback") == (action == "bug")
    assert "a line of the log" in report


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_killed_worker_is_lost(start):
    """Catches a progress bar that stays forever after kill -9, and an unreported signal."""
    folder, process = start()
    wait(lambda: inspect_worker(folder, process).state == WorkerState.WORKING)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert inspect_worker(folder).state == WorkerState.LOST
    assert "Worker exited unexpectedly; it was killed or" in inspect_worker(folder).status.error
    assert "(signal 9)" in inspect_worker(folder, process).status.error
    prepare_status_folder(folder)
    assert inspect_worker(folder).state == WorkerState.LOST  # prepared, and no worker yet


@pytest.mark.skipif(os.name == "nt", reason="a shell closes the descriptors")
@pytest.mark.parametrize("action", ["done", "sentence"])
@pytest.mark.parametrize("streams", ["<&- >&- 2>&-", ">/dev/full 2>/dev/full", "| true"])
def test_final_status_without_output_streams(tmp_path, streams, action):
    """Catches a worker without a final status where its output is closed, full or broken."""
    script = WORKER.replace('print("a line of the log", flush=True)', "time.sleep(0.2)")
    (tmp_path / "counting.py").write_text(script)
    folder = tmp_path / "status"
    subprocess.run(
        f"{sys.executable} {tmp_path}/counting.py {folder} {action} {streams}",
        shell=True,
        check=False,
        env=same_interpreter_environment(os.environ),
        timeout=60,
    )
    expected = WorkerState.FINISHED if action == "done" else WorkerState.FAILED
    wait(lambda: (status.read_status(folder) or WorkerStatus()).state == expected)


def test_only_own_files_are_removed(tmp_path):
    """Catches a person's files removed or written over, and a traceback where a file is in the
    way."""
    with status.status_writer(tmp_path / "job") as writer:
        writer.report(Progress(0.5, "working"))
    (tmp_path / "job" / "notes.txt").write_text("mine")
    (tmp_path / "job" / "job.json").write_text("")
    status.remove_status_folder(tmp_path / "job", ["job.json"])
    assert [path.name for path in (tmp_path / "job").iterdir()] == ["notes.txt"]
    (tmp_path / "file").write_text("")
    status.remove_status_folder(tmp_path / "file")
    assert (tmp_path / "file").exists()
    for folder, left in ((tmp_path / "new", []), (tmp_path / "job", ["notes.txt"])):
        for python in (str(tmp_path / "nowhere/python"), "null\0character"):
            prepare_status_folder(folder)
            with refusal(r"cannot be started as a Python interpreter"):
                start_worker(folder, python, [])
            assert folder.exists() == bool(left)
            assert [path.name for path in folder.glob("*")] == left
    for use in (prepare_status_folder, status.request_cancel):
        with refusal(r"file.*cannot be written"):
            use(tmp_path / "file" / "status")
    writing = status.status_writer(tmp_path / "file" / "status")
    with refusal("cannot be written"), writing:
        pass


@pytest.mark.skipif(os.name == "nt", reason="symbolic links need privileges")
def test_symbolic_links_are_not_followed(tmp_path):
    """Catches a file overwritten through a link that somebody placed in the status folder."""
    target = tmp_path / "target"
    folder = tmp_path / "job"
    target.write_text("mine")
    folder.mkdir()
    for name in (status.STATUS_FILE, status.LOG_FILE, status.CANCEL_FILE):
        (folder / name).symlink_to(target)
    prepare_status_folder(folder)
    (folder / status.CANCEL_FILE).symlink_to(tmp_path / "created")
    status.request_cancel(folder)
    assert not (tmp_path / "created").exists()
    (folder / status.CANCEL_FILE).unlink()
    (folder / status.LOG_FILE).unlink()
    (folder / status.LOG_FILE).symlink_to(target)
    with refusal(rf"{status.LOG_FILE}: cannot be written"):
        start_worker(folder, sys.executable, ["this"])
    with status.status_writer(folder) as writer:
        writer.report(Progress(0.5, "working"))
    assert target.read_text() == "mine"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "null",
        '{"state": "dancing"}',
        '{"state": 3}',
        '{"progress": "half"}',
        '{"progress": NaN}',
        '{"progress": 2}',
        '{"error": ["a"]}',
        '{"figures": []}',
        '{"figures": {"n": "many"}}',
        '{"surprise": 1}',
    ],
)
def test_damaged_status_is_ignored(tmp_path, text):
    """Catches an exception in Blender's timer for a truncated or foreign status.json."""
    (tmp_path / status.STATUS_FILE).write_text(text)
    assert status.read_status(tmp_path) is None
    assert inspect_worker(tmp_path).state == WorkerState.NONE


def test_status_round_trip(tmp_path, monkeypatch):
    """Catches a field lost between worker and panel, NaN in it, and a status at every step."""
    figures = {"psnr": 30.5}
    machine = platform.node()
    now = 100.0
    expected = WorkerStatus("working", 0.25, "training", "enough", "", "", figures, machine, 0.25)
    monkeypatch.setattr(status, "time", SimpleNamespace(monotonic=lambda: now))
    with status.status_writer(tmp_path) as writer:
        now += 0.25
        writer.report(Progress(0.25, "training", "enough", lambda: figures))
        with refusal("another worker"), status.status_writer(tmp_path):
            pass
        assert status.read_status(tmp_path) == expected
        now += 1
    assert status.read_status(tmp_path) == replace(
        expected, state=WorkerState.FINISHED, seconds=1.25
    )
    written = []
    monkeypatch.setattr(status, "write_json", lambda path, value, **_: written.append(value))
    writer = status.StatusWriter(tmp_path)
    for message in ("a", "a", "b", "b"):
        figures = partial(dict, psnr=math.nan, loss=math.inf, n=1.0)
        writer.report(Progress(0, message, figures=figures))
    assert [value["message"] for value in written] == ["a", "b"]
    assert written[0]["figures"] == {"n": 1.0}


def test_full_disk_does_not_stop_the_work(tmp_path, monkeypatch):
    """Catches a worker that fails with its status, and a cause that is not reported."""

    def full(path, value, **options):
        raise StgaError(f"{path}: cannot be written ({os.strerror(errno.ENOSPC)})")

    with status.status_writer(tmp_path) as writer:
        monkeypatch.setattr(status, "write_json", full)
        assert not writer.report(Progress(0.5, "training"))
    monkeypatch.undo()
    (tmp_path / status.LOG_FILE).touch()
    assert inspect_worker(tmp_path).state == WorkerState.LOST
    monkeypatch.setattr(status.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 100}))
    assert f"the disk that holds {tmp_path} is full" in inspect_worker(tmp_path).status.error


def test_worker_environment(monkeypatch, tmp_path):
    """Catches a worker with another Python's library, or with bytecode in the extension's
    folder."""
    variables = {"PATH": "/bin", "PYTHONHOME": "/blender/python", "PYTHONPATH": "/other"}
    made = worker_environment(variables, "/usr/bin/python3")
    assert made["PATH"] == "/bin"
    assert "PYTHONHOME" not in made
    assert made["PYTHONPATH"] == str(ROOT)
    assert made["PYTHONDONTWRITEBYTECODE"] == "1"
    monkeypatch.setattr(sys, "path", ["", "/extensions/site-packages"])
    expected = os.pathsep.join([str(ROOT), "/extensions/site-packages"])
    assert worker_environment({}, sys.executable)["PYTHONPATH"] == expected
    program = tmp_path / f"bin/python{sys.version_info[0]}.{sys.version_info[1]}"
    program.parent.mkdir()
    program.touch()
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.setattr(sys, "executable", "/elsewhere/shims/python3")
    this_python.cache_clear()
    try:
        assert this_python() == (str(program) if os.name == "posix" else sys.executable)
        assert worker_environment({"PYTHONPATH": "/other"}, str(program))["PYTHONNOUSERSITE"] == "1"
    finally:
        this_python.cache_clear()


def test_a_worker_of_the_own_interpreter(monkeypatch, tmp_path):
    """Catches bytecode among an extension's files, the user's site-packages and the user's
    settings."""
    (tmp_path / "packages").mkdir()
    (tmp_path / "packages/some_package.py").touch()
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path / "packages")])
    variables = {**os.environ, "STGA_CACHE": str(tmp_path / "cache")}
    command = [sys.executable, "-c", "import some_package"]
    subprocess.run(command, env=worker_environment(variables, sys.executable), check=True)
    assert [path.name for path in (tmp_path / "packages").iterdir()] == ["some_package.py"]
    assert list((tmp_path / "cache").rglob("some_package.*.pyc"))
    assert "PYTHONPYCACHEPREFIX" not in worker_environment(variables, "/usr/bin/python3")
    theirs = tmp_path / f"lib/python{sys.version_info[0]}.{sys.version_info[1]}/site-packages"
    theirs.mkdir(parents=True)
    (theirs / "strange_package.py").touch()
    variables = {**os.environ, "PYTHONUSERBASE": str(tmp_path), "PYTHONWARNINGS": "ignore"}
    looking = "import importlib.util as u; exit(3 if u.find_spec('strange_package') else 0)"
    variables["PYTHONPATH"] = str(theirs)
    for environment, code in ((variables, 3), (worker_environment(variables, sys.executable), 0)):
        command = [sys.executable, "-c", looking]
        done = subprocess.run(command, env=environment, stdin=subprocess.DEVNULL, check=False)
        assert done.returncode == code
    assert "PYTHONWARNINGS" in worker_environment(variables, "/usr/bin/python3")


def test_log_lines(tmp_path):
    """Catches progress bars, which use carriage returns, and a character that is cut in half."""
    text = "ä".encode()[1:] + b"x" * 5000 + b"\nfirst\rsecond\n\nthird\n"
    (tmp_path / status.LOG_FILE).write_bytes(text)
    assert status.log_lines(tmp_path, 2) == ["second", "third"]
    assert status.log_lines(tmp_path / "none", 2) == []
