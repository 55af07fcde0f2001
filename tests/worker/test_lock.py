"""Lock files: held while a process lives, and only then."""

import errno
import os
import platform
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import pytest
from filelock import FileLock
from refusal import refusal

from stga_addon.progress import Progress
from stga_addon.worker import lock
from stga_addon.worker.lock import hold_folder, is_locked, lock_owner
from stga_addon.worker.status import WorkerState, inspect_worker, status_writer

HOLD = (
    "import sys; from pathlib import Path; from stga_addon.worker.lock import hold_folder\n"
    "with hold_folder(Path(sys.argv[1]), 'worker.lock', 'holder'):\n"
    "    print('held', flush=True); sys.stdin.read()"
)


def hold(path):
    return hold_folder(path.parent, path.name, "holder")


def test_a_lock_ends_with_its_process(tmp_path):
    """Catches a worker alive for ever after kill -9, and a probe that leaves a file."""
    path = tmp_path / "worker.lock"
    assert not is_locked(path)
    assert not path.exists()
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as other:
        assert other.stdout.readline() == "held\n"
        assert is_locked(path)
        assert lock_owner(path) == other.pid
        expected = rf"another holder \(process {other.pid}\)"
        with refusal(expected), hold(path):
            pass
        other.kill()
    assert path.exists()
    assert not is_locked(path)
    with hold(path):
        assert is_locked(path)
        assert lock_owner(path) == os.getpid()
    assert not is_locked(path)


@pytest.mark.skipif(os.name == "nt", reason="links need privileges, and pipes are no files")
def test_what_is_no_lock_file(tmp_path):
    """Catches a file overwritten through a link at the lock's path, and a read that never
    returns."""
    path = tmp_path / "run.lock"
    target = tmp_path / "target"
    target.write_text("mine")
    path.symlink_to(target)
    with refusal("cannot be written"), hold(path):
        pass
    assert not is_locked(path)
    assert target.read_text() == "mine"
    os.mkfifo(tmp_path / "pipe.lock")
    assert lock_owner(tmp_path / "pipe.lock") == 0
    assert not is_locked(tmp_path / "pipe.lock")


@contextmanager
def probed(path):
    """Hold the lock for a moment in another thread, as a probe of another process does, while the
    block runs."""
    begun = threading.Event()

    def hold():
        with FileLock(path):
            begun.set()
            time.sleep(0.1)

    path.touch()
    thread = threading.Thread(target=hold)
    thread.start()
    begun.wait(10)
    yield
    thread.join()


def test_probes_disturb_nobody(tmp_path, monkeypatch):
    """Catches a probe that another one takes for a lock, or that keeps a worker from starting."""
    monkeypatch.setattr(lock, "PROBE_TIMEOUT_S", 10.0)
    monkeypatch.setattr(lock, "ACQUIRE_TIMEOUT_S", 10.0)
    with probed(tmp_path / "worker.lock"):
        assert not is_locked(tmp_path / "worker.lock")
    with probed(tmp_path / "worker.lock"), hold(tmp_path / "worker.lock"):
        pass


def test_storage_without_locks(tmp_path, monkeypatch):
    """Catches workers that cannot run there, count as lost, or are two in one folder: storage that
    answers as an NFS without its lock service does."""
    fcntl = pytest.importorskip("fcntl")

    def flock(descriptor, operation):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", flock)
    monkeypatch.setattr(lock, "BEAT_S", 0.05)
    monkeypatch.setattr(lock, "EXPIRY_S", 1.0)
    folder = tmp_path / "job"
    path = tmp_path / "job/worker.lock"
    lease = path.with_name("worker.lock.lease")
    with status_writer(folder) as writer:
        writer.report(Progress(0.5, "Working"))
        assert lock_owner(path) == os.getpid()
        own = lease.read_text()
        time.sleep(1.5)  # longer than a lock without a heartbeat lasts
        assert inspect_worker(folder).state == WorkerState.WORKING
        with refusal("another worker is running"), status_writer(folder):
            pass
        assert is_locked(path)
    assert inspect_worker(folder).state == WorkerState.FINISHED
    assert not is_locked(path)
    assert not lease.exists()
    # what a process that was killed on another machine leaves
    lease.write_text(own.replace(f"{os.getpid()}", "123").replace(platform.node(), "elsewhere"))
    path.touch()
    assert is_locked(path)
    os.utime(lease, (time.time() - 2, time.time() - 2))
    assert not is_locked(path)
    with hold(path):
        assert is_locked(path)
