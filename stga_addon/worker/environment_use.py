"""Records which processes run in a training environment, so that it is not removed meanwhile."""

import os
import sys
from contextlib import ExitStack, suppress
from pathlib import Path

from .lock import hold_lock, is_locked

READY = "ready"
"""File in an environment that this add-on made and checked."""
USERS_FOLDER = "users"
"""Holds a lock file for every process that runs in the environment, named after the process number."""

_held = ExitStack()


def mark_environment_used(prefix: Path = Path(sys.prefix)) -> None:
    """Keep the environment of this process from being removed until the process ends; nothing for other Pythons."""
    if (prefix / READY).is_file():
        users = prefix / USERS_FOLDER
        with suppress(OSError):  # a folder that cannot be written, whose environment nobody removes
            users.mkdir(exist_ok=True)
            _held.enter_context(hold_lock(users / str(os.getpid())))


def environment_users(prefix: Path) -> list[int]:
    """Numbers of the processes that run in the environment."""
    locks = [path for path in (prefix / USERS_FOLDER).glob("*") if path.name.isdecimal()]
    return sorted(int(path.name) for path in locks if is_locked(path))
