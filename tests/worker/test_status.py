"""The protocol between Blender and its workers, without Blender: folders, last words, and workers that die."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from stga_addon.errors import StgaError
from stga_addon.worker import process as task
from stga_addon.worker.process import Snapshot, State, Status

ROOT = Path(__file__).resolve().parents[2]
# A worker that says how far it is until it is asked to stop, or does what its argument says.
WORKER = """
import os, sys, time
from pathlib import Path
from stga_addon.worker import process as task
from stga_addon.errors import StgaError

def main():
    with task.telling(Path(sys.argv[1])) as teller:
        print("a line of the log", flush=True)
        for n in range(2000):
            if teller.tell(n / 2000, "counting", "so far so good", lambda: {"n": n, "nothing": float("nan")}):
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
    """Start the worker above as a module of its own, in a task folder that it returns."""
    packages = tmp_path / "packages"
    packages.mkdir()
    (packages / "counting.py").write_text(WORKER)
    monkeypatch.setattr(task, "environment", lambda outer: {**outer, "PYTHONPATH": f"{ROOT}{os.pathsep}{packages}"})
    running: list[subprocess.Popen[bytes]] = []

    def run(do: str = "work") -> tuple[Path, "subprocess.Popen[bytes]"]:
        folder = tmp_path / "task"
        task.prepare(folder)
        running.append(task.start(folder, sys.executable, ["counting", str(folder), do]))
        return folder, running[-1]

    yield run
    for process in running:
        process.kill()
        process.wait()


def wait(until: Callable[[], bool]) -> None:
    for _ in range(600):
        if until():
            return
        time.sleep(0.05)
    raise AssertionError("waited in vain")


@pytest.mark.parametrize(
    ("status", "alive", "asked", "begun", "state"),
    [
        (None, False, False, False, State.NONE),
        (None, True, False, True, State.STARTING),
        (None, True, True, True, State.CANCELLING),
        (None, False, False, True, State.LOST),
        (State.WORKING, True, False, True, State.WORKING),
        (State.WORKING, True, True, True, State.CANCELLING),
        (State.WORKING, False, False, True, State.LOST),
        (State.WORKING, False, True, True, State.LOST),
        *[
            (end, alive, asked, True, end)
            for end in (State.FINISHED, State.CANCELLED, State.FAILED)
            for alive in (False, True)
            for asked in (False, True)
        ],
    ],
)
def test_states(status, alive, asked, begun, state):
    """Catches a worker that is taken for dead while it lives, or for alive once it has left its last word."""
    assert task.state_of(None if status is None else Status(status), alive, asked, begun) == state


def test_a_worker_from_start_to_cancel(start):
    """Catches figures that do not arrive, a cancel that is not heard, and a worker that is killed instead."""
    folder, process = start()
    assert task.look(folder, process).state.is_alive
    wait(lambda: task.look(folder, process).state == State.WORKING)
    wait(lambda: task.look(folder).status.share > 0)  # as a Blender sees it that did not start it
    seen = task.look(folder)
    assert seen.state == State.WORKING
    assert (seen.status.message, seen.status.remark) == ("counting", "so far so good")
    assert list(seen.status.figures) == ["n"]
    if os.name != "nt":  # Blender comes first
        assert os.getpriority(os.PRIO_PROCESS, process.pid) == min(os.getpriority(os.PRIO_PROCESS, 0) + 5, 19)
    with pytest.raises(StgaError, match=f"another worker is at work here \\(process {process.pid}\\)"):
        task.prepare(folder)
    with pytest.raises(StgaError, match="another worker"):
        task.forget(folder)
    task.ask_to_stop(folder)
    assert task.look(folder, process).state in (State.CANCELLING, State.CANCELLED)
    assert process.wait(20) == 0
    ended = task.look(folder, process)
    assert ended.state == State.CANCELLED
    assert 0 < ended.status.share < 1
    task.forget(folder)
    assert task.look(folder) == Snapshot()


def test_a_worker_that_finishes(start):
    """Catches an end that is taken for a loss."""
    folder, process = start("done")
    assert process.wait(20) == 0
    assert task.look(folder, process).state == State.FINISHED


def test_a_mistake_is_a_sentence(start):
    """Catches a user's mistake shown as a traceback."""
    folder, process = start("sentence")
    process.wait(20)
    seen = task.look(folder)
    assert seen.state == State.FAILED
    assert (seen.status.error, seen.status.traceback) == ("capture: is not a folder", "")
    assert seen.tail
    assert "a line of the log" in task.account(folder, seen)


def test_a_bug_has_its_traceback(start):
    """Catches a crash that nobody can report."""
    folder, process = start("bug")
    assert process.wait(20) == 1
    seen = task.look(folder)
    assert seen.state == State.FAILED
    assert seen.status.error == "ValueError: a bug"
    account = task.account(folder, seen)
    assert account.startswith("ValueError: a bug\nTraceback")
    assert "a line of the log" in account


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_a_killed_worker_is_lost(start):
    """Catches a panel that shows a progress bar for ever, and an exit status that is not passed on."""
    folder, process = start()
    wait(lambda: task.look(folder, process).state == State.WORKING)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert task.look(folder).state == State.LOST
    assert "the worker ended without a word: it was killed, or" in task.look(folder).status.error
    assert "killed by signal 9" in task.look(folder, process).status.error
    task.prepare(folder)  # and the next one can start


def test_a_worker_that_dies_on_its_feet(start):
    """Catches an interpreter that cannot even start, whose only word is its exit status."""
    folder, process = start("exit")
    process.wait(20)
    assert task.look(folder, process).status.error == "the worker ended with exit status 7: a line of the log"


def test_an_interpreter_that_is_none(tmp_path):
    """Catches a traceback for a path with a typing error, and a task that seems to have begun."""
    folder = tmp_path / "task"
    task.prepare(folder)
    with pytest.raises(StgaError, match=r"nowhere/python: cannot be started as a Python interpreter"):
        task.start(folder, str(tmp_path / "nowhere/python"), [])
    assert task.look(folder).state == State.NONE


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "null",
        '{"state": "dancing"}',
        '{"state": 3}',
        '{"share": "half"}',
        '{"share": NaN}',
        '{"share": 2}',
        '{"error": ["a"]}',
        '{"figures": []}',
        '{"figures": {"n": "many"}}',
        '{"surprise": 1}',
    ],
)
def test_damaged_words_are_no_words(tmp_path, text):
    """Catches a timer that a half-written or foreign status.json throws off."""
    (tmp_path / task.STATUS).write_text(text)
    assert task.read_status(tmp_path) is None
    assert task.look(tmp_path).state == State.NONE


def test_a_word_comes_whole(tmp_path):
    """Catches a field that is lost between worker and panel."""
    with task.telling(tmp_path) as teller:
        teller.tell(0.25, "training", "enough", lambda: {"psnr": 30.5})
        told = task.read_status(tmp_path)
    assert told == Status(State.WORKING, 0.25, "training", "enough", "", "", {"psnr": 30.5})
    assert task.read_status(tmp_path) == Status(State.FINISHED, 0.25, "training", "enough", "", "", {"psnr": 30.5})


def test_words_are_few(tmp_path, monkeypatch):
    """Catches a worker that writes its status in every iteration, and a new message that has to wait."""
    written = []
    monkeypatch.setattr(task, "write_json", lambda path, value: written.append(value["message"]))
    teller = task.Teller(tmp_path)
    for message in ("a", "a", "b", "b"):
        teller.tell(0, message)
    assert written == ["a", "b"]


def test_a_full_disk_does_not_stop_the_work_itself(tmp_path, monkeypatch):
    """Catches a worker that dies of a status it cannot write; whether the work goes on is for the work to say."""

    def full(path: Path, value: object) -> None:
        raise StgaError(f"{path}: cannot be written ({os.strerror(errno.ENOSPC)})")

    monkeypatch.setattr(task, "LAST_WORD_S", 0.0)
    with task.telling(tmp_path) as teller:
        monkeypatch.setattr(task, "write_json", full)
        assert not teller.tell(0.5, "training")
    monkeypatch.undo()
    (tmp_path / task.LOG).touch()
    assert task.look(tmp_path).state == State.LOST
    monkeypatch.setattr(task.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 100}))
    assert "the disk that holds" in task.look(tmp_path).status.error


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    """Catches a traceback where the run folder is read-only or a file."""
    (tmp_path / "file").write_text("")
    for use in (task.prepare, task.ask_to_stop):
        with pytest.raises(StgaError, match=r"file.*cannot be written"):
            use(tmp_path / "file" / "task")
    with pytest.raises(StgaError, match=r"cannot be written"), task.telling(tmp_path / "file" / "task"):
        pass


def test_one_worker_a_folder(tmp_path):
    """Catches two workers that overwrite each other's words: the second must not touch the first one's."""
    with task.telling(tmp_path) as teller:
        teller.tell(0.5, "first")
        with pytest.raises(StgaError, match="another worker"), task.telling(tmp_path):
            pass
        assert task.read_status(tmp_path).message == "first"


def test_the_environment_is_the_workers_own():
    """Catches a worker that runs on Blender's own standard library, or writes into the extension's folder."""
    made = task.environment({"PATH": "/bin", "PYTHONHOME": "/blender/python", "PYTHONPATH": "/other"})
    assert made["PATH"] == "/bin"
    assert "PYTHONHOME" not in made
    assert made["PYTHONPATH"] == str(ROOT)
    assert made["PYTHONDONTWRITEBYTECODE"] == "1"


def test_the_log_ends_with_its_last_lines(tmp_path):
    """Catches progress bars, which return the carriage, and half characters at the cut."""
    (tmp_path / task.LOG).write_bytes("ä".encode()[1:] + b"x" * 5000 + b"\nfirst\rsecond\n\nthird\n")
    assert task.log_lines(tmp_path, 2) == ["second", "third"]
    assert task.log_lines(tmp_path / "none", 2) == []


def test_status_is_json_for_others(tmp_path):
    """Catches a NaN in status.json, which other programs cannot read."""
    with task.telling(tmp_path) as teller:
        teller.tell(0.5, "x", "", lambda: {"psnr": float("nan"), "loss": float("inf"), "n": 1.0})

    def refuse(name: str) -> None:
        raise AssertionError(name)

    text = (tmp_path / task.STATUS).read_text()
    assert json.loads(text, parse_constant=refuse)["figures"] == {"n": 1.0}
