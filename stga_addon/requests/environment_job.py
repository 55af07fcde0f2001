"""Environment job: checks, makes and removes the training environment; finding it is `worker.environment`.

`python -m stga_addon.requests.environment_job check FOLDER PYTHON` and `… make FOLDER` are workers with their status in
FOLDER/status.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import StgaError
from ..files import write_json
from ..worker.environment import (
    ADAPTERS_FILE,
    CHOICE_FILE,
    environment_number,
    environments,
    status_folder,
    venv_python,
)
from ..worker.environment_use import READY, environment_users
from ..worker.launch import start_python
from ..worker.requirements import (
    DETECTOR_REQUIREMENTS,
    GPU_REQUIREMENT,
    REQUIREMENTS,
    TRACKING_REQUIREMENTS,
    package_name,
)
from ..worker.status import StatusWriter, log_lines, status_writer

MIN_PYTHON = 3, 11
SIZE_GB, PYPI_SIZE_GB = 1.5, 6.0
"""Measured size of an environment; and with the CUDA build of torch that PyPI has for Linux."""
TRACKING_GB = 0.3
"""Measured size of what tracking needs in addition."""
TORCH_CPU_INDEX = "https://download.pytorch.org/whl/cpu"
"""PyTorch's CPU build serves GPUs as well, since the kernels are WebGPU's; the CUDA build, which PyPI has for Linux,
takes gigabytes. Everything else comes from PyPI, or the mirror that pip is configured for."""
FAILURE_REASONS = {
    "No space left on device": "the disk is full",
    "ensurepip": "this Python has no ensurepip; choose another one (3.11 or newer), or install python3-venv",
    "connection broken by": "the package index cannot be reached; check network and proxy, or use a folder of wheels",
    "No matching distribution": "{}: no version fits this Python and system",
}
"""Text in a failing command's output -> reason to show; {} is the line. The first that matches."""
COMMAND_PREFIX = "$ "
CHECK_TIMEOUT_S = 180.0
"""The first import of torch from a slow disk."""
POLL_INTERVAL_S = 0.2


# Checking


def check_python(python: str, folder: Path | None = None) -> str:
    """One line on an interpreter that can train: versions and device.

    folder: of the environment, where the GPUs are stored for `stored_adapters`.
    Raises StgaError where it cannot be started or lacks something, which the sentence names.
    """
    with start_python(
        python, ["stga_addon.requests.environment_check"], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, errors="replace",
    ) as child:  # fmt: skip
        try:
            output, errors = child.communicate(timeout=CHECK_TIMEOUT_S)
        except subprocess.TimeoutExpired as error:
            child.kill()
            raise StgaError(f"{python}: did not answer within {CHECK_TIMEOUT_S:.0f} s") from error
    try:
        report = json.loads(output.strip().splitlines()[-1])
        line = describe_check(python, report)
        if folder is not None:
            write_json(folder / ADAPTERS_FILE, report["adapters"])
        return line
    except (ValueError, IndexError, KeyError, TypeError) as error:
        with suppress(OSError):  # the stream may be closed
            print(output + errors, file=sys.stderr, flush=True)
        raise StgaError(f"{python}: is not a Python that runs this add-on (exit status {child.returncode})") from error


def describe_check(python: str, report: dict[str, Any]) -> str:
    """The line of `check_python` from what environment_check.py prints. Raises StgaError where something is missing."""
    version, versions, failures = report["python"], report["versions"], report["failures"]
    if tuple(int(part) for part in version.split(".")[:2]) < MIN_PYTHON:
        raise StgaError(f"{python}: is Python {version}, training needs 3.11 or newer")
    missing = [package_name(text) for module, text in REQUIREMENTS.items() if module in failures]
    if missing:
        why = next((text for text in failures.values() if not text.startswith("ModuleNotFoundError")), "")
        failed = f" ({why})" if why else ""
        raise StgaError(f"{python}: Python {version} lacks {', '.join(missing)}{failed}; install that with pip")
    detector = f", mediapipe {versions['mediapipe']}" if "mediapipe" in versions else ""
    detector = f", mediapipe fails ({failures['mediapipe']})" if "mediapipe" in failures else detector
    return f"Python {version}, torch {versions['torch']}, numba {versions['numba']}{detector}, {report['device']}"


def check_in_worker(folder: Path, python: str) -> str:
    """`check_python`, with its status in the environment folder."""
    with status_writer(status_folder(folder)) as writer:
        writer.update(0.0, "Testing")
        line = check_python(python, folder)
        writer.update(1.0, line)
    return line


def check_arguments(folder: Path, python: str) -> list[str]:
    """What a worker runs after `python -m` for `check_in_worker`."""
    return ["stga_addon.requests.environment_job", "check", str(folder), python]


def store_choice(folder: Path, python: str) -> str:
    """Use the interpreter `python` from now on; "": none. Returns the line of `check_python`, "" for none.

    Raises StgaError where it cannot train.
    """
    if not python:
        with suppress(OSError):
            (folder / CHOICE_FILE).unlink()
        return ""
    python = os.path.abspath(python)
    line = check_python(python, folder)
    write_json(folder / CHOICE_FILE, {"python": python})
    return line


# Making and removing


def make_arguments(folder: Path, python: str, wheels: Path | None, tracking: bool = False) -> list[str]:
    """What a worker runs after `python -m` for `make_environment`."""
    more = ["--wheels", str(wheels)] if wheels else []
    more += ["--tracking"] if tracking else []
    return ["stga_addon.requests.environment_job", "make", str(folder), "--python", python, *more]


@dataclass(frozen=True)
class InstallStep:
    """A command, the message shown meanwhile, and whether installation goes on where it fails."""

    message: str
    command: list[str]
    optional: bool = False


def install_steps(
    venv: Path, python: str, wheels: Path | None, system: str = sys.platform, tracking: bool = False
) -> list[InstallStep]:
    """The commands that make an environment; `wheels` is a folder to install from without a network."""
    pip = [str(venv_python(venv)), "-m", "pip", "install", "--no-input", "--disable-pip-version-check"]
    packages = [*REQUIREMENTS.values(), *(TRACKING_REQUIREMENTS if tracking else ())]
    too_old = f"sys.version_info < {MIN_PYTHON} and 'ERROR: Python %d.%d is too old' % sys.version_info[:2]"
    first = [
        InstallStep("Checking the Python version", [python, "-c", f"import sys; sys.exit({too_old})"]),
        InstallStep("Creating the virtual environment", [python, "-m", "venv", str(venv)]),
    ]
    if wheels is not None:
        pip += ["--no-index", "--find-links", str(wheels)]
    # A wheel or nothing: its source would have to be built.
    gpu = [*pip, "--only-binary", "wgpu", GPU_REQUIREMENT]
    last = [InstallStep("Installing GPU support", gpu, optional=True)]
    if tracking:
        last.append(InstallStep("Installing the landmark detector", [*pip, "--no-deps", *DETECTOR_REQUIREMENTS]))
    if wheels is not None:
        return [*first, InstallStep("Installing from the folder of wheels", [*pip, *packages]), *last]
    torch = [*pip, "--no-deps", "--index-url", TORCH_CPU_INDEX, REQUIREMENTS["torch"]]
    rest = InstallStep("Installing torch and other packages", [*pip, *packages])
    if system != "linux":
        return [*first, rest, *last]
    return [*first, InstallStep("Installing PyTorch's CPU build", torch, optional=True), rest, *last]


def make_environment(folder: Path, python: str, wheels: Path | None = None, tracking: bool = False) -> str:
    """Make an environment in `folder` from the interpreter `python`; returns the line of `check_python`.

    tracking: with what `stga track` needs, the landmark detector included.

    It replaces earlier ones once it has passed the check; those that processes run in stay until the next time.
    Cancelled, it leaves nothing behind and returns "". Raises StgaError with the step that failed.
    """
    with status_writer(status_folder(folder)) as writer:
        free = shutil.disk_usage(folder).free / 1e9
        needed = SIZE_GB + (TRACKING_GB if tracking else 0)
        if free < needed:
            raise StgaError(f"{folder}: has {free:.1f} GB free, the environment needs {needed:.1f} GB")
        numbers = [environment_number(venv) for venv in environments(folder)]
        venv = folder / f"venv-{max(numbers, default=0) + 1}"
        steps = install_steps(venv, python, wheels, sys.platform, tracking)
        try:
            for number, step in enumerate(steps):
                if not _run(writer, number / (len(steps) + 1), step):
                    shutil.rmtree(venv, ignore_errors=True)
                    return ""
            writer.update(len(steps) / (len(steps) + 1), "Testing")
            line = check_python(str(venv_python(venv)), folder)
        except StgaError:
            shutil.rmtree(venv, ignore_errors=True)
            raise
        (venv / READY).touch()
        store_choice(folder, "")
        _remove(venv for venv in environments(folder)[:-1])
        writer.update(1.0, line)
    return line


def remove_environment(folder: Path) -> int:
    """Remove the environments made in `folder`, and the stored choice; returns how many.

    Raises StgaError while a process runs in one of them, or where one cannot be removed.
    """
    if not (environments(folder) or (folder / CHOICE_FILE).exists() or status_folder(folder).exists()):
        return 0  # and nothing is written where nothing was
    with status_writer(status_folder(folder)) as writer:
        writer.update(0.0, "Removing")
        venvs = environments(folder)
        for venv in venvs:
            users = environment_users(venv)
            if users:
                raise StgaError(f"{venv}: is in use by process {', '.join(map(str, users))}; wait, or cancel training")
        store_choice(folder, "")
        _remove(venvs)
        left = environments(folder)
        if left:
            raise StgaError(f"{left[0]}: cannot be removed completely; remove the folder by hand")
        writer.update(1.0, "Removed")
    return len(venvs)


def _remove(venvs: Iterable[Path]) -> None:
    for venv in venvs:
        with suppress(OSError):
            (venv / READY).unlink(missing_ok=True)  # first, so that no new worker starts from it
        if not environment_users(venv):
            shutil.rmtree(venv, ignore_errors=True)


def _run(writer: StatusWriter, progress: float, step: InstallStep) -> bool:
    """Run a step with this process' output; False where it was cancelled.

    Raises StgaError where it fails and is not optional.
    """
    # Else pip takes what lies on this worker's path for installed.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    with suppress(OSError):  # the stream may be closed
        print(COMMAND_PREFIX + " ".join(step.command), flush=True)
    try:
        child = subprocess.Popen(step.command, env=environment, stdin=subprocess.DEVNULL)
    except OSError as error:
        raise StgaError(f"{step.command[0]}: cannot be started ({error.strerror or error})") from error
    while child.poll() is None:
        line = log_lines(writer.folder, 9)[-1:]  # 9: pip's lines are long
        if writer.update(progress, step.message, line[0].strip() if line else ""):
            child.terminate()
            child.wait()
            return False
        time.sleep(POLL_INTERVAL_S)
    if child.returncode and not step.optional:
        raise StgaError(f"{step.message} failed: {_failure_reason(log_lines(writer.folder, 20), child.returncode)}")
    return True


def _failure_reason(lines: Sequence[str], code: int) -> str:
    """Why a step failed, from the last lines of the log."""
    begin = max((row for row, line in enumerate(lines) if line.startswith(COMMAND_PREFIX)), default=-1) + 1
    known = [reason.format(line) for sign, reason in FAILURE_REASONS.items() for line in lines[begin:] if sign in line]
    errors = [line for line in reversed(lines[begin:]) if "error" in line.lower()]
    return next(iter([*known, *errors]), f"exit status {code}")


def main(arguments: Sequence[str] | None = None) -> int:
    top = argparse.ArgumentParser(prog="python -m stga_addon.requests.environment_job", description=__doc__)
    commands = top.add_subparsers(dest="command", required=True)
    check = commands.add_parser("check")
    check.add_argument("folder", type=Path)
    check.add_argument("python")
    make = commands.add_parser("make")
    make.add_argument("folder", type=Path)
    make.add_argument("--python", default=sys.executable)
    make.add_argument("--wheels", type=Path)
    make.add_argument("--tracking", action="store_true")
    options = vars(top.parse_args(arguments))
    try:
        print({"check": check_in_worker, "make": make_environment}[options.pop("command")](**options))
    except StgaError as error:
        print(f"stga: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
