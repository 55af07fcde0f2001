"""Lease of a batch's folder: one batch works in it, whichever machine it is started on.

batch.lock   a file lock, which ends with its process; on one machine that is enough
batch.lease  who works here, with a count that rises every BEAT_S: for storage whose locks other machines do not see, or
             that has none. A holder that stands still for EXPIRY_S (a suspended machine, storage that hangs) can lose
             the lease to another batch; it notices at its next beat.
"""

import os
import platform
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from ..errors import StgaError
from ..files import read_json, write_json
from ..worker.lock import BEAT_S, EXPIRY_S, NO_LOCKS, hold_lock, lock_owner

LOCK, LEASE = "batch.lock", "batch.lease"
LOOK_INTERVAL_S = 0.5


class Lease:
    """This process' lease of a folder; `is_lost` once another process has taken it."""

    def __init__(self, folder: Path) -> None:
        self._path, self._token, self._count = folder / LEASE, secrets.token_hex(8), 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="stga lease", daemon=True)
        self.is_lost = False

    def take(self, has_lock: bool) -> None:
        """Raise StgaError where another process keeps it. has_lock: the folder's lock is held."""
        found = _read(self._path)
        here = found.get("host") == platform.node()
        if found and not (has_lock and here):
            deadline = time.monotonic() + EXPIRY_S
            while time.monotonic() < deadline and _read(self._path):
                if _read(self._path) != found:
                    raise StgaError(_held(self._path.parent, found))
                time.sleep(LOOK_INTERVAL_S)
        self._beat()
        if not has_lock:  # two processes may have come this far: the last to write has it
            time.sleep(2 * LOOK_INTERVAL_S)
            if _read(self._path).get("token") != self._token:
                raise StgaError(_held(self._path.parent, _read(self._path)))
        self._thread.start()

    def give_back(self) -> None:
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()
        if _read(self._path).get("token") == self._token:
            with suppress(OSError):
                self._path.unlink()

    def _keep(self) -> None:
        while not self._ended.wait(BEAT_S):
            if _read(self._path).get("token") not in (None, self._token):
                self.is_lost = True
                return
            with suppress(StgaError):  # storage that does not answer for a moment
                self._beat()

    def _beat(self) -> None:
        self._count += 1
        owner = {"host": platform.node(), "process": os.getpid(), "token": self._token, "count": self._count}
        write_json(self._path, owner)


@contextmanager
def hold_folder(folder: Path) -> Iterator[Lease]:
    """Hold a batch's folder, which is made. Raises StgaError while another batch works in it."""
    with ExitStack() as lock:
        has_lock = True
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock.enter_context(hold_lock(folder / LOCK, beats=False))
        except BlockingIOError as error:
            owner = f"process {lock_owner(folder / LOCK)}"
            raise StgaError(f"{folder}: another batch is working in this folder ({owner})") from error
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise StgaError(f"{folder}: cannot be written ({error.strerror or error})") from error
            has_lock = False
        lease = Lease(folder)
        try:
            lease.take(has_lock)
            yield lease
        finally:
            lease.give_back()


def _read(path: Path) -> dict[str, Any]:
    """Content of the lease; empty where there is none."""
    try:
        values = read_json(path)
    except StgaError:
        return {}
    return values if isinstance(values, dict) else {}


def _held(folder: Path, owner: dict[str, Any]) -> str:
    return (
        f"{folder}: another batch is working in this folder (process {owner.get('process')} on {owner.get('host')}); "
        f"if it has ended, remove {folder / LEASE}"
    )
