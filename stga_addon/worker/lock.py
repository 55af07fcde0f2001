"""Lock files that end with the process that holds them; by a heartbeat, where the storage has no working locks."""

import errno
import os
import platform
import secrets
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from ..errors import StgaError
from ..files import file_size

ACQUIRE_TIMEOUT_S = 0.3
"""How long a lock is waited for: a process that only asks whether it is held has it for a moment."""
PROBE_TIMEOUT_S = 0.03
"""The same between two processes that only ask; Blender's timer waits that long for a worker of another Blender."""
RETRY_INTERVAL_S = 0.002
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""What a file system without working locks answers: some NFS and parallel file systems."""
BEAT_S, EXPIRY_S = 5.0, 30.0
"""On such a one: seconds between two heartbeats, and without one until the lock counts as left behind. A holder that
stands still for longer than that (a suspended machine, storage that hangs) can lose it to another process."""
CLAIM_S = 0.5
"""After how long a process looks whether another one claimed such a lock together with it."""
OWNER_OFFSET = 1
"""Where the owner's process number starts: on Windows, other processes cannot read the first byte, which is locked."""


@contextmanager
def hold_lock(path: Path, beats: bool = True) -> Iterator[None]:
    """Hold the lock file for this process, and write the process number into it.

    beats: where the storage has no locks, hold it by a heartbeat.
    Raises BlockingIOError while another process holds it, OSError where it cannot be written or is a symbolic link.
    """
    with ExitStack() as held:
        try:
            held.enter_context(_hold_file_lock(path))
        except OSError as error:
            if error.errno not in NO_LOCKS or not beats:
                raise
            held.enter_context(_hold_by_beats(path))
        yield


@contextmanager
def _hold_file_lock(path: Path) -> Iterator[None]:
    lock = FileLock(path, timeout=ACQUIRE_TIMEOUT_S, poll_interval=RETRY_INTERVAL_S)
    try:
        lock.acquire()
    except Timeout as error:
        raise BlockingIOError(f"{path} is held by another process") from error
    try:
        _write_owner(path)
        yield
    finally:
        with suppress(OSError):  # Windows removes no open file, which leaves an empty lock behind
            path.unlink()
        lock.release()


def is_locked(path: Path) -> bool:
    """Whether a living process holds the lock; False where the file is missing or cannot be opened."""
    if not path.is_file() or path.is_symlink():
        return False
    try:
        with FileLock(path, timeout=PROBE_TIMEOUT_S, poll_interval=RETRY_INTERVAL_S):
            return False
    except Timeout:
        return True
    except OSError as error:
        return error.errno in NO_LOCKS and _is_beating(path)


def lock_owner(path: Path) -> int:
    """Number of the process that holds the lock; 0 where it is unknown."""
    try:
        file_size(path)  # refuses pipes, whose reading need never end
        with path.open("rb") as file:
            file.seek(OWNER_OFFSET)
            return int(file.read(20))
    except (StgaError, OSError, ValueError):
        return 0


@contextmanager
def _hold_by_beats(path: Path) -> Iterator[None]:
    """Hold the file by renewing its time every BEAT_S. Raises BlockingIOError while another process does."""
    content = f" {os.getpid():<20d}{platform.node()} {secrets.token_hex(8)}".encode()
    if _is_beating(path):
        raise BlockingIOError(f"{path} is held by another process")
    path.write_bytes(content)
    time.sleep(CLAIM_S)
    if path.read_bytes() != content:  # the last of several to write has it
        raise BlockingIOError(f"{path} was taken by another process")
    ended = threading.Event()

    def beat() -> None:
        while not ended.wait(BEAT_S):
            with suppress(OSError):  # storage that does not answer for a moment
                os.utime(path)

    thread = threading.Thread(target=beat, name="stga lock", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        with suppress(OSError):
            if path.read_bytes() == content:
                path.unlink()


def _is_beating(path: Path) -> bool:
    """Whether a process renewed the file within EXPIRY_S, by the clock of the storage."""
    try:
        with tempfile.TemporaryFile(dir=path.parent) as now:
            found = path.stat()
            return found.st_size > 0 and os.fstat(now.fileno()).st_mtime - found.st_mtime < EXPIRY_S
    except OSError:
        return False


def _write_owner(path: Path) -> None:
    with suppress(OSError):  # only messages need it
        descriptor = os.open(path, os.O_WRONLY | getattr(os, "O_NOFOLLOW", 0))
        try:
            os.lseek(descriptor, OWNER_OFFSET, os.SEEK_SET)
            os.write(descriptor, b"%-20d" % os.getpid())
        finally:
            os.close(descriptor)
