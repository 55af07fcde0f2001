"""Makes a training environment with pip: a worker, `python -m stga_addon.requests.environment_make FOLDER`.

Its status is in FOLDER/status. Editions of the extension that must not install packages are built without this file
(`can_make_environment`).
"""

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..errors import StgaError, exit_code
from ..worker.environment import environment_number, environments, status_folder, venv_python
from ..worker.environment_use import READY
from ..worker.requirements import GPU_REQUIREMENT, REQUIREMENTS
from ..worker.status import StatusWriter, log_lines, status_writer
from . import environment_job
from .environment_job import MIN_PYTHON, remove_unused

SIZE_GB, PYPI_SIZE_GB = 1.5, 6.0
"""Measured size of an environment; and with the CUDA build of torch that PyPI has for Linux."""
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
POLL_INTERVAL_S = 0.2


def make_arguments(folder: Path, python: str, wheels: Path | None) -> list[str]:
    """What a worker runs after `python -m` for `make_environment`."""
    more = ["--wheels", str(wheels)] if wheels else []
    return ["stga_addon.requests.environment_make", str(folder), "--python", python, *more]


@dataclass(frozen=True)
class InstallStep:
    """A command, the message shown meanwhile, and whether installation goes on where it fails."""

    message: str
    command: list[str]
    optional: bool = False


def install_steps(venv: Path, python: str, wheels: Path | None, system: str = sys.platform) -> list[InstallStep]:
    """The commands that make an environment; `wheels` is a folder to install from without a network."""
    pip = [str(venv_python(venv)), "-m", "pip", "install", "--no-input", "--disable-pip-version-check"]
    packages = [*REQUIREMENTS.values()]
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
    if wheels is not None:
        return [*first, InstallStep("Installing from the folder of wheels", [*pip, *packages]), *last]
    torch = [*pip, "--no-deps", "--index-url", TORCH_CPU_INDEX, REQUIREMENTS["torch"]]
    rest = InstallStep("Installing torch and other packages", [*pip, *packages])
    if system != "linux":
        return [*first, rest, *last]
    return [*first, InstallStep("Installing PyTorch's CPU build", torch, optional=True), rest, *last]


def make_environment(folder: Path, python: str, wheels: Path | None = None) -> str:
    """Make an environment in `folder` from the interpreter `python`; returns the line of `check_python`.

    It replaces earlier ones once it has passed the check; those that processes run in stay until the next time.
    Cancelled, it leaves nothing behind and returns "". Raises StgaError with the step that failed.
    """
    with status_writer(status_folder(folder)) as writer:
        free = shutil.disk_usage(folder).free / 1e9
        needed = SIZE_GB
        if free < needed:
            raise StgaError(f"{folder}: has {free:.1f} GB free, the environment needs {needed:.1f} GB")
        numbers = [environment_number(venv) for venv in environments(folder)]
        venv = folder / f"venv-{max(numbers, default=0) + 1}"
        steps = install_steps(venv, python, wheels, sys.platform)
        try:
            for number, step in enumerate(steps):
                if not _run(writer, number / (len(steps) + 1), step):
                    shutil.rmtree(venv, ignore_errors=True)
                    return ""
            writer.update(len(steps) / (len(steps) + 1), "Testing")
            line = environment_job.check_python(str(venv_python(venv)), folder)
        except StgaError:
            shutil.rmtree(venv, ignore_errors=True)
            raise
        (venv / READY).touch()
        environment_job.store_choice(folder, "")
        remove_unused(venv for venv in environments(folder)[:-1])
        writer.update(1.0, line)
    return line


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
    top = argparse.ArgumentParser(prog="python -m stga_addon.requests.environment_make", description=__doc__)
    top.add_argument("folder", type=Path)
    top.add_argument("--python", default=sys.executable)
    top.add_argument("--wheels", type=Path)
    options = vars(top.parse_args(arguments))
    return exit_code(lambda: print(make_environment(**options)))


if __name__ == "__main__":
    raise SystemExit(main())
