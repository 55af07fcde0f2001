"""Helping processes do what one process would, and end when they should."""

import os
import signal
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from stga_addon.errors import StgaError
from stga_addon.worker.helpers import Helpers


def squares(first, last, step):
    """Work of a helper: each square, and the process that it was found in."""
    found = []
    for number in range(first, last):
        found.append((number**2, os.getpid()))
        print("libraries print")
        step()
    return found


def refuses(number, step):
    raise StgaError(f"part {number}: expected another") if number else ZeroDivisionError


def is_killed(number, step):
    os.kill(os.getpid(), signal.SIGTERM)


def takes_long(seconds, step):
    step()
    time.sleep(seconds)


def is_own(value, function, step):
    """A value and a function of the package as it is called here, or an error."""
    if (type(value).__module__, function.__module__) != (
        "stga_addon.progress",
        "stga_addon.format",
    ):
        raise ZeroDivisionError
    if function(value.fraction) != "45 s":
        raise StgaError("expected 45 seconds")
    return value


PARTS = [(first, first + 3) for first in range(0, 21, 3)]


def test_results_are_those_of_one_process_in_order():
    """Catches parts lost, exchanged or doubled, prints among answers, and new helpers per task."""
    pids = set()
    with Helpers(3) as helpers:
        for _ in range(2):
            told = []
            found = [pair for part in helpers.map(squares, PARTS, told.append) for pair in part]
            assert [square for square, _ in found] == [number**2 for number in range(21)]
            assert (told[-1], told) == (21, sorted(told))
            pids |= {pid for _, pid in found}
        pids |= {pid for _, pid in helpers.run(squares, (0, 3), told.append)}
    assert os.getpid() not in pids
    assert 1 <= len(pids) <= 3
    with Helpers(1) as alone:
        told = []
        found = alone.map(squares, PARTS, told.append)
        assert {pid for part in found for _, pid in part} == {os.getpid()}
        assert told == list(range(1, 22))
        assert {pid for _, pid in alone.run(squares, (0, 3), told.append)} == {os.getpid()}
        assert os.getpid() not in {p for _, p in alone.run(squares, (0, 3), print, apart=True)}


def halves(numbers, folder, step):
    """Work whose results are kept; each call leaves a file."""
    for _ in numbers:
        step()
    (folder / f"{time.monotonic_ns()}").touch()
    return {"half": numbers / 2}


@pytest.mark.parametrize("count", [1, 2])
def test_what_was_found_is_not_worked_on_again(tmp_path, count):
    """Catches a call that begins anew, takes results of other arguments, or lacks kept progress."""
    called = tmp_path / "called"
    called.mkdir()
    parts = [(np.arange(3.0) + number, called) for number in range(4)]

    def interrupt(steps):
        if len(list(called.iterdir())) >= 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), Helpers(count, tmp_path / "kept") as helpers:
        helpers.map(halves, parts, interrupt, keep=True)
    before = len(list((tmp_path / "kept").glob("*.npz")))
    told = []
    assert before >= 1
    calls = len(list(called.iterdir()))
    with Helpers(count, tmp_path / "kept") as helpers:
        found = helpers.map(halves, parts, told.append, keep=True)
        expected = [part[0] / 2 for part in parts]
        np.testing.assert_array_equal([own["half"] for own in found], expected)
        assert told[-1] == 12
        assert len(list(called.iterdir())) == calls + 4 - before
        helpers.map(halves, [(np.arange(3.0) + 9, called), parts[0]], told.append, keep=True)
    assert len(list(called.iterdir())) == calls + 4 - before + 1


@pytest.mark.parametrize(
    ("work", "parts", "error", "says"),
    [
        (refuses, [(1,), (2,)], StgaError, "expected another"),
        (refuses, [(0,), (0,)], RuntimeError, "ZeroDivisionError"),
        (is_killed, [(1,), (2,)], StgaError, "a helping process ended before its work did"),
    ],
)
def test_failures_reach_who_asked(work, parts, error, says):
    """Catches a caller that waits for ever for a helper that failed or was killed."""
    with pytest.raises(error, match=says), Helpers(2) as helpers:
        helpers.map(work, parts, lambda steps: None)


def test_a_package_of_another_name_is_the_helpers_own(monkeypatch):
    """Catches work that no helper can import where the package is `bl_ext.….stga.stga_addon`."""
    package = ModuleType("installed")
    package.__path__ = [str(Path(__file__).parents[2])]
    monkeypatch.setitem(sys.modules, "installed", package)
    modules = ("worker.helpers", "progress", "format", "errors")
    helpers, progress, texts, errors = (
        import_module(f"installed.stga_addon.{name}") for name in modules
    )
    right = progress.Progress(45.0)
    wrong = progress.Progress(44.0)
    with helpers.Helpers(2) as two:
        parts = [(right, texts.format_duration)] * 2
        assert two.map(is_own, parts, lambda steps: None) == [right, right]
        with pytest.raises(errors.StgaError, match="expected 45 seconds"):
            two.map(is_own, [(wrong, texts.format_duration)] * 2, lambda steps: None)


def test_cancelling_does_not_wait_for_what_is_being_done():
    """Catches a Cancel that takes as long as the work."""

    def cancel(steps):
        raise KeyboardInterrupt

    since = time.monotonic()
    with pytest.raises(KeyboardInterrupt), Helpers(2) as helpers:
        helpers.map(takes_long, [(60,), (60,)], cancel)
    assert time.monotonic() - since < 30


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="elsewhere, a helper works to the end of its part"
)
def test_helpers_end_with_a_process_that_is_killed():
    """Catches helpers that go on for nobody."""
    script = (
        "from worker.test_helpers import *\n"
        "helpers = Helpers(2)\n"
        "helpers.map(takes_long, [(60,), (60,)], lambda steps: "
        "print(*(process.pid for process in helpers._processes), flush=True))"
    )
    path = os.pathsep.join([*sys.path, str(Path(__file__).parents[1])])
    command = [sys.executable, "-c", script]
    variables = {**os.environ, "PYTHONPATH": path}
    asking = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=variables)
    pids = [int(pid) for pid in asking.stdout.readline().split()]
    asking.kill()
    asking.communicate()
    assert len(pids) == 2
    ended = time.monotonic() + 30
    while any(Path(f"/proc/{pid}").exists() and "Z" not in _state(pid) for pid in pids):
        assert time.monotonic() < ended
        time.sleep(0.05)


def _state(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()[0]
    except OSError:
        return "Z"


CLAIM = """
import os, sys
if {closed}: os.close(2)
from stga_addon.worker.helpers import claim_stdout
messages = claim_stdout()
os.write(1, b"from C")
if not {closed}: print("from Python")
messages.write(b"message")
messages.flush()
"""


@pytest.mark.parametrize("closed", [False, True])
def test_only_messages_reach_standard_output(closed):
    """Catches output of libraries between messages, and a closed standard error that ends it."""
    done = subprocess.run([sys.executable, "-c", CLAIM.format(closed=closed)], capture_output=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == b"message"
    if not closed:
        assert b"from C" in done.stderr
        assert b"from Python" in done.stderr
