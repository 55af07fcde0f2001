"""Locks: held while a process lives, and only then."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from stga_addon.worker import lock as locks

HOLD = (
    "import sys; from pathlib import Path; from stga_addon.worker.lock import held\n"
    "with held(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
)


def test_looking_neither_takes_nor_makes_a_lock(tmp_path: Path) -> None:
    """Catches a look that leaves a lock file behind, or keeps out the worker that it looks for."""
    path = tmp_path / "worker.lock"
    assert not locks.is_held(path)
    assert not path.exists()
    with locks.held(path):
        assert locks.is_held(path)
        assert locks.owner(path) == os.getpid()
    assert not locks.is_held(path)


def test_a_killed_process_holds_nothing(tmp_path: Path) -> None:
    """Catches a worker that counts as alive for ever after kill -9."""
    path = tmp_path / "worker.lock"
    command = [sys.executable, "-c", HOLD, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        assert locks.is_held(path)
        assert locks.owner(path) == other.pid
        with pytest.raises(BlockingIOError), locks.held(path):
            pass
        other.kill()
    assert path.exists()
    assert not locks.is_held(path)
