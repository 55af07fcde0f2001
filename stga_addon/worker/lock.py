"""Lock files that end with their process; leases, which it renews, on storage without locks."""

import errno
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path

from filelock import FileLock, SoftFileLease, Timeout

from ..errors import StgaError
from ..files import file_size

ACQUIRE_TIMEOUT_S = 0.3
"""Patience for a lock that a process which only asks has for a moment."""
PROBE_TIMEOUT_S = 0.03
"""The same between processes that only query, as Blender's timer does."""
RETRY_INTERVAL_S = 0.002
"""Interval between two attempts to take a lock that another process holds."""
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""Errors of a file system without working locks: some NFS and parallel file systems."""
BEAT_S = 5.0
"""Seconds between two renewals of a lease."""
EXPIRY_S = 30.0
"""Seconds without one until another process takes the lease: from a holder that was killed on
another machine, or stands still (a suspended machine, storage that hangs)."""
LOOK_INTERVAL_S = 0.2
OWNER_OFFSET = 1  # Place of the process number: Windows locks the first byte, which nobody can read


@contextmanager
def hold_folder(
    folder: Path, name: str, holder: str, leased: bool = False
) -> Iterator[SoftFileLease | None]:
    """Make the folder, hold its lock file for this process, and write the process number into it; a
    lease where there are no locks.

    leased: hold a lease as well, for storage whose locks other machines do not see. What is yielded
    is the lease: it has a `compromise` once another process has taken it. A failure of the block
    removes the folders that were made, where nothing is in them. Raises StgaError while another
    process, `holder`, holds it, and where it cannot be written or is a symbolic link.
    """
    path = folder / name
    with ExitStack() as held:
        try:
            missing = [each for each in (folder, *folder.parents) if not each.is_dir()]
            held.push(partial(_remove_empty, missing))
            folder.mkdir(parents=True, exist_ok=True)
            try:
                held.enter_context(_hold_file_lock(path))
            except OSError as error:
                if error.errno not in NO_LOCKS:
                    raise
                leased = True
            lease = held.enter_context(_hold_lease(_lease_of(path))) if leased else None
        except BlockingIOError as error:
            raise StgaError(f"{folder}: another {holder} (process {lock_owner(path)})") from error
        except OSError as error:
            raise StgaError(f"{folder}: cannot be written ({error.strerror or error})") from error
        yield lease


def _remove_empty(folders: Sequence[Path], kind: type | None, *_: object) -> None:
    """As an exit callback: after an exception, remove folders, the innermost first."""
    with suppress(OSError):  # something is in it
        for folder in folders if kind is not None else ():
            folder.rmdir()


@contextmanager
def _hold_file_lock(path: Path) -> Iterator[None]:
    lock = _file_lock(path, ACQUIRE_TIMEOUT_S)
    try:
        lock.acquire()
    except Timeout as error:
        raise BlockingIOError(f"{path} is held by another process") from error
    try:
        with suppress(OSError), path.open("r+b", buffering=0) as file:  # only messages need it
            file.seek(OWNER_OFFSET)
            file.write(b"%-20d" % os.getpid())
        yield
    finally:
        with suppress(OSError):  # Windows removes no open file, which leaves an empty lock behind
            path.unlink()
        lock.release()


@contextmanager
def _hold_lease(path: Path) -> Iterator[SoftFileLease]:
    """Wait until another holder is gone or still for EXPIRY_S; BlockingIOError if it renews."""
    lease = SoftFileLease(
        path, lease_duration=EXPIRY_S, heartbeat_interval=BEAT_S, thread_local=False
    )
    before = _renewed_s(path)
    try:
        stood_still = (None, before)
        lease.acquire(
            timeout=2 * EXPIRY_S,
            poll_interval=LOOK_INTERVAL_S,
            cancel_check=lambda: _renewed_s(path) not in stood_still,
        )
    except Timeout as error:
        raise BlockingIOError(f"{path} is held by another process") from error
    try:
        yield lease
    finally:
        lease.release()


def is_locked(path: Path) -> bool:
    """Whether a living process holds the lock; False where it cannot be opened."""
    if not path.is_file() or path.is_symlink():
        return False
    try:
        with _file_lock(path, PROBE_TIMEOUT_S):
            return False
    except Timeout:
        return True
    except OSError as error:
        return error.errno in NO_LOCKS and _is_renewed(_lease_of(path))


def lock_owner(path: Path) -> int:
    """Number of the process that holds the lock, or its lease; 0 where it is unknown."""
    try:
        file_size(path)  # refuses pipes, whose reading need never end
        with path.open("rb") as file:
            file.seek(OWNER_OFFSET)
            return int(file.read(20))
    except (StgaError, OSError, ValueError):
        lease = _lease_of(path)
        return (SoftFileLease(lease).pid or 0) if lease.is_file() else 0


def _file_lock(path: Path, timeout_s: float) -> FileLock:
    return FileLock(path, timeout=timeout_s, poll_interval=RETRY_INTERVAL_S, fallback_to_soft=False)


def _lease_of(path: Path) -> Path:
    return path.with_name(f"{path.name}.lease")


def _renewed_s(path: Path) -> float | None:
    """When a lease was renewed last, by the clock of the storage; None where there is none."""
    try:
        return path.stat().st_mtime
    except OSError:
        return None


def _is_renewed(lease: Path) -> bool:
    """Whether a process renewed it within EXPIRY_S, by the clock of the storage."""
    before = _renewed_s(lease)
    with suppress(OSError), tempfile.TemporaryFile(dir=lease.parent) as now:
        return before is not None and os.fstat(now.fileno()).st_mtime - before < EXPIRY_S
    return False
