"""Lock files that end with the process that holds them."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from ..errors import StgaError
from ..files import file_size

ACQUIRE_TIMEOUT_S = 0.3
"""How long a lock is waited for: a process that only asks whether it is held has it for a moment."""
PROBE_TIMEOUT_S = 0.03
"""The same between two processes that only ask; Blender's timer waits that long for a worker of another Blender."""
RETRY_INTERVAL_S = 0.002
OWNER_OFFSET = 1
"""Where the owner's process number starts: on Windows, other processes cannot read the first byte, which is locked."""


@contextmanager
def hold_lock(path: Path) -> Iterator[None]:
    """Hold the lock file for this process, and write the process number into it.

    Raises BlockingIOError while another process holds it, OSError where it cannot be written or is a symbolic link.
    """
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
    except OSError:
        return False


def lock_owner(path: Path) -> int:
    """Number of the process that holds the lock; 0 where it is unknown."""
    try:
        file_size(path)  # refuses pipes, whose reading need never end
        with path.open("rb") as file:
            file.seek(OWNER_OFFSET)
            return int(file.read(20))
    except (StgaError, OSError, ValueError):
        return 0


def _write_owner(path: Path) -> None:
    with suppress(OSError):  # only messages need it
        descriptor = os.open(path, os.O_WRONLY | getattr(os, "O_NOFOLLOW", 0))
        try:
            os.lseek(descriptor, OWNER_OFFSET, os.SEEK_SET)
            os.write(descriptor, b"%-20d" % os.getpid())
        finally:
            os.close(descriptor)
