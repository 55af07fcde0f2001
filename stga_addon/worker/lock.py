"""A file that one process holds: the system's own lock, which ends with its process, however that ends."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

PATIENCE_S = 0.3
"""How long a lock is asked for again: somebody may only be looking whether it is held."""


@contextmanager
def held(path: Path) -> Iterator[None]:
    """Hold the file for this process, whose number it contains, for people.

    Raises BlockingIOError while another process holds it, OSError where it cannot be written.
    """
    file = _hold_patiently(path)
    try:
        yield
    finally:
        if os.name == "nt":  # where an open file cannot be removed; elsewhere its name goes before the lock does
            file.close()
        with suppress(OSError):
            path.unlink()
        file.close()


def is_held(path: Path) -> bool:
    """Whether a living process holds the file; False where there is none, or none that can be read."""
    try:
        with path.open("r+" if os.name == "nt" else "r", encoding="ascii") as file:
            _lock(file, shared=True)
            return False
    except BlockingIOError:
        return True
    except OSError:
        return False


def owner(path: Path) -> int:
    """The process that the file names; 0 where it names none."""
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return 0


def _hold_patiently(path: Path) -> IO[str]:
    until = time.monotonic() + PATIENCE_S
    while True:
        try:
            return _hold(path)
        except BlockingIOError:
            if time.monotonic() > until:
                raise
            time.sleep(0.02)


def _hold(path: Path) -> IO[str]:
    while True:
        file = path.open("a+", encoding="ascii")
        try:
            _lock(file)
            # Its last owner may have removed the name between our opening and locking it: then it guards nothing.
            if os.name == "nt" or _is_named(path, file):
                file.truncate(0)
                file.write(str(os.getpid()))
                file.flush()
                return file
        except BaseException:
            file.close()
            raise
        file.close()


def _is_named(path: Path, file: IO[str]) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


if os.name == "nt":
    import msvcrt

    def _lock(file: IO[str], shared: bool = False) -> None:
        file.seek(1 << 30)  # far behind the content, which stays readable
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
        except OSError as error:
            raise BlockingIOError(error.errno, error.strerror) from error
        file.seek(0)

else:
    import fcntl

    def _lock(file: IO[str], shared: bool = False) -> None:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
