"""Starts processes in another Python interpreter: workers with a status folder, and others."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..errors import StgaError
from ..files import naming
from .lock import is_locked
from .status import CANCEL_FILE, LOG_FILE, STATUS_FILE, refuse_running_worker, remove_status_folder
from .training_python import this_python

CACHE_VARIABLE = "STGA_CACHE"
"""Environment variable that names the cache folder. Blender's extension sets it to a folder that
uninstalling removes."""
KERNELS = "kernels"
"""Folder in the cache in which Numba keeps compiled kernels."""
BUNDLED = "bundled kernels"
"""Folder in the cache for kernels that the complete edition brings, on a processor that compiles
faster ones into KERNELS (`raster.cpu.bundled`)."""
BYTECODE = "bytecode"
"""Folder in the cache for Python's bytecode (`PYTHONPYCACHEPREFIX`)."""
CHARTS = "matplotlib"
"""Folder in the cache for matplotlib."""
PREPARING = "preparing.lock"
"""File in the cache that is locked by the process that compiles ahead of a training
(`jobs.compile_ahead`)."""
PACKAGES_FOLDER = Path(__file__).resolve().parents[2]
"""The folder that holds `stga_addon`, for a worker's import path."""
NICENESS = 5
"""Added to the nice value of the process that starts a worker, so that Blender's window, or a
terminal, stays responsive."""
BACKGROUND_NICENESS = 15
"""Added for a process that nobody waits for, so that workers come first."""
PR_SET_PDEATHSIG = 1  # Option of prctl(2)
# Windows: own process group, so that closing the console does not end the worker; no console
# window; and BELOW_NORMAL_PRIORITY_CLASS. Elsewhere: an own session.
_DETACHED: dict[str, Any] = {"start_new_session": True}
if os.name == "nt":
    _DETACHED = {"creationflags": 0x00000200 | 0x08000000 | 0x00004000}


def cache_folder() -> Path:
    """The folder that CACHE_VARIABLE names, else the user's cache folder."""
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        return Path(named)
    # a Python without it, such as Blender's, has the variable
    from platformdirs import user_cache_path

    return user_cache_path("stga", appauthor=False)


def is_preparing() -> bool:
    """Whether a process compiles ahead of a training."""
    return is_locked(cache_folder() / PREPARING)


def prepare_status_folder(folder: Path) -> None:
    """Create the status folder, or empty it. Raises StgaError while a worker is running in it, or
    it cannot be written."""
    refuse_running_worker(folder)
    with naming(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name in (STATUS_FILE, CANCEL_FILE, LOG_FILE):
            (folder / name).unlink(missing_ok=True)
        (folder / LOG_FILE).open("xb").close()


def start_worker(folder: Path, python: str, arguments: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start `python -m ARGUMENTS…` at low priority in a prepared status folder; it outlives the
    calling process.

    Raises StgaError where the log cannot be opened; and where the interpreter cannot be started,
    after removing the status files, and the folder if nothing else is in it.
    """
    path = folder / LOG_FILE
    with naming(path):
        log = os.open(path, os.O_WRONLY | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0))
    options: dict[str, Any] = {"stdout": log, "stderr": subprocess.STDOUT, "cwd": folder}
    try:
        return start_in_background(python, arguments, NICENESS, **options)
    except StgaError:
        remove_status_folder(folder)
        raise
    finally:
        os.close(log)


def start_in_background(
    python: str, arguments: Sequence[str], niceness: int = BACKGROUND_NICENESS, **options: Any
) -> subprocess.Popen[bytes]:
    """Start `python -m ARGUMENTS…` at low priority, without output but for the options of Popen."""
    options = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, **options}
    process = start_python(python, arguments, stdin=subprocess.DEVNULL, **options, **_DETACHED)
    if os.name != "nt":  # where it is started with a low one
        with suppress(OSError):  # the process has ended already
            current = os.getpriority(os.PRIO_PROCESS, 0)
            os.setpriority(os.PRIO_PROCESS, process.pid, current + niceness)
    return process


def start_python(
    python: str,
    arguments: Sequence[str],
    variables: Mapping[str, str] | None = None,
    **options: Any,
) -> subprocess.Popen[Any]:
    """Start `python -m ARGUMENTS…` in `worker_environment` and `variables`; options are those of
    Popen. Raises StgaError where the interpreter cannot be started."""
    environment = {**worker_environment(os.environ, python), **(variables or {})}
    try:
        return subprocess.Popen([python, "-m", *arguments], env=environment, **options)
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        reason = getattr(error, "strerror", None) or error
        raise StgaError(
            f"{python}: cannot be started as a Python interpreter ({reason})"
        ) from error


def start_piped(
    python: str, arguments: Sequence[str], variables: Mapping[str, str] | None = None
) -> "subprocess.Popen[bytes]":
    """`start_python` with pipes, of a process that on Linux ends with the thread that starts it, on
    Windows has no console window."""
    options: dict[str, Any] = {"preexec_fn": end_with_this_process()}
    if os.name == "nt":
        options = {"creationflags": 0x08000000}
    options |= {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    return start_python(python, arguments, variables, **options)


def end_with_this_process() -> Callable[[], None] | None:
    """A `preexec_fn` by which Linux kills the started process with the thread that starts it; None
    on other systems, where it goes on to its end."""
    if not sys.platform.startswith("linux"):
        return None
    import ctypes  # before the fork, after which nothing may be imported

    prctl = ctypes.CDLL(None).prctl
    parent = os.getpid()

    def ask() -> None:
        prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it had gone before it was asked
            os._exit(1)

    return ask


def worker_environment(variables: Mapping[str, str], python: str) -> dict[str, str]:
    """Environment variables for the interpreter `python`: the path of this package, and none of
    Blender's own Python.

    Another process of this interpreter finds the packages that this process does, and no others:
    Blender's extensions have a folder for theirs, which its Python does not search by itself, and
    Blender ignores the user's site-packages. As installed by Blender, these packages have no
    bytecode; it is kept in the cache folder, if Blender named one.
    """
    is_this_python = python in (sys.executable, this_python())
    cache = variables.get(CACHE_VARIABLE) if is_this_python else None
    dropped = ("PYTHON",) if is_this_python else ("PYTHONHOME", "PYTHONSTARTUP")
    kept = {name: value for name, value in variables.items() if not name.startswith(dropped)}
    if is_this_python:
        kept["PYTHONNOUSERSITE"] = "1"
    if cache:
        kept["PYTHONPYCACHEPREFIX"] = os.path.join(cache, BYTECODE)
        kept["MPLCONFIGDIR"] = os.path.join(cache, CHARTS)
    else:
        kept["PYTHONDONTWRITEBYTECODE"] = "1"  # the extension's folder belongs to Blender
    path = os.pathsep.join(
        [str(PACKAGES_FOLDER), *filter(None, sys.path if is_this_python else ())]
    )
    always = dict.fromkeys(("PYTHONSAFEPATH", "PYTHONUNBUFFERED", "PYTHONUTF8"), "1")
    return {**kept, **always, "PYTHONPATH": path}


def same_interpreter_environment(variables: Mapping[str, str]) -> dict[str, str]:
    """For another process of this interpreter, with the packages of this one."""
    path = os.pathsep.join([str(PACKAGES_FOLDER), *filter(None, sys.path)])
    return {**variables, "PYTHONPATH": path}
