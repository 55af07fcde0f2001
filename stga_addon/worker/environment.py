"""The training runtime: a Python with torch that trains beside Blender; found, tested or made here.

`python -m stga_addon.worker.environment test FOLDER PYTHON` and `… make FOLDER` are workers with a status in
FOLDER/task (`process`).
FOLDER/venv-… is an environment that was made, `ready` in it is there once it has passed the test.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import Any

from ..errors import StgaError
from . import process as task
from .environment_check import NEEDED

DEVICES = ("auto", "cpu", "cuda")
OLDEST = 3, 11
"""Python that can train."""
SIZES_GB = {"cpu": 1.5, "cuda": 2.0, "pypi": 6.0}
"""Room that a runtime takes: measured; with the package warp-lang, which is all that a GPU needs beside; and with the
torch that PyPI has for Linux, measured."""
OLDEST_CUDA = 12
"""Of the driver, for warp-lang."""
INDEX = "https://download.pytorch.org/whl/cpu"
"""PyTorch's CPU build: on a GPU, too, the kernels are ours, and the CUDA build, which PyPI has for Linux, takes
gigabytes. Everything else comes from PyPI, or the mirror of it that pip is configured for."""
REASONS = {
    "No space left on device": "the disk is full",
    "ensurepip": "this Python has no ensurepip; choose another one (3.11 or newer), or install python3-venv",
    "connection broken by": "the package indexes cannot be reached; check network and proxy, or use a folder of wheels",
    "No matching distribution": "{}: none that fits this Python and system",
}
"""What a failing step printed, {} -> what to tell a person; the first that fits."""
READY, PROMPT = "ready", "$ "
PROBE_S = 180.0
"""The first import of torch from a slow disk."""


def task_folder(folder: Path) -> Path:
    return folder / "task"


def made_python(folder: Path) -> Path | None:
    """The interpreter of the runtime that was made in `folder`; None where there is none, or it never got ready."""
    made = (venv_python(ready.parent) for ready in folder.glob(f"venv-*/{READY}"))
    return next((python for python in made if python.exists()), None)


def venv_python(venv: Path) -> Path:
    return venv / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def missing_here() -> list[str]:
    """What training needs and this interpreter lacks, as pip calls it."""
    return [package for module, package in NEEDED.items() if find_spec(module) is None]


def testing_arguments(folder: Path, python: str) -> list[str]:
    """What a worker's interpreter runs, after `-m`, to test another one."""
    return ["stga_addon.worker.environment", "test", str(folder), python]


def making_arguments(folder: Path, python: str, device: str, wheels: Path | None) -> list[str]:
    """The same to make a runtime of the interpreter `python`."""
    offline = ["--wheels", str(wheels)] if wheels else []
    return ["stga_addon.worker.environment", "make", str(folder), "--python", python, "--device", device, *offline]


def probe(python: str) -> str:
    """One line on an interpreter that can train: versions and device.

    Raises StgaError where it cannot be started or lacks something, which the sentence names.
    """
    command = [python, "-m", "stga_addon.worker.environment_check"]
    environment = task.environment(os.environ)
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PROBE_S, check=False)
    except OSError as error:
        raise StgaError(f"{python}: cannot be started as a Python interpreter ({error.strerror or error})") from error
    except subprocess.TimeoutExpired as error:
        raise StgaError(f"{python}: did not answer within {PROBE_S:.0f} s") from error
    print(done.stdout + done.stderr, flush=True)
    try:
        return describe(python, json.loads(done.stdout.strip().splitlines()[-1]))
    except (ValueError, IndexError) as error:
        raise StgaError(f"{python}: is no Python that can run this add-on (exit status {done.returncode})") from error


def describe(python: str, report: dict[str, Any]) -> str:
    """The line of `probe` from what probe.py prints. Raises StgaError where something is missing."""
    version, found, broken = report["python"], report["found"], report["broken"]
    if tuple(int(part) for part in version.split(".")[:2]) < OLDEST:
        raise StgaError(f"{python}: is Python {version}, training needs 3.11 or newer")
    missing = [package for module, package in NEEDED.items() if module in broken]
    if missing:
        why = next((text for text in broken.values() if not text.startswith("ModuleNotFoundError")), "")
        failed = f" ({why})" if why else ""
        raise StgaError(f"{python}: Python {version} lacks {', '.join(missing)}{failed}; install that with pip")
    return f"Python {version}, torch {found['torch']}, numba {found['numba']}, {report['device']}"


def device_for(device: str, nvidia_smi: str | None) -> str:
    """The device to install for: "cpu", or "cuda" where the driver that `nvidia-smi` reports is new enough.

    device: "auto" takes what there is. nvidia_smi: its output, None where there is none.
    Raises StgaError where CUDA was chosen and the driver cannot do it.
    """
    if device == "cpu":
        return "cpu"
    reported = re.search(r"CUDA Version:\s*((\d+)\.\d+)", nvidia_smi or "")
    if reported and int(reported[2]) >= OLDEST_CUDA:
        return "cuda"
    if device == "auto":
        return "cpu"
    has = f"the NVIDIA driver goes up to CUDA {reported[1]}" if reported else "nvidia-smi finds no NVIDIA GPU"
    raise StgaError(f"{has}, training needs CUDA {OLDEST_CUDA} or newer: update the driver or choose the CPU")


def nvidia_smi() -> str | None:
    """What nvidia-smi prints; None where it is not there or finds no GPU."""
    try:
        done = subprocess.run(["nvidia-smi"], capture_output=True, text=True, timeout=20, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


@dataclass(frozen=True)
class InstallStep:
    """What a person reads, a command, and whether making the runtime goes on where it fails."""

    message: str
    command: list[str]
    optional: bool = False


def steps(venv: Path, python: str, device: str, wheels: Path | None, system: str = sys.platform) -> list[InstallStep]:
    """What makes a runtime, in turn; `wheels` is a folder to install from without a network."""
    pip = [str(venv_python(venv)), "-m", "pip", "install", "--no-input", "--disable-pip-version-check"]
    packages = [*NEEDED.values(), *(["warp-lang"] if device == "cuda" else [])]
    too_old = f"sys.version_info < {OLDEST} and 'ERROR: Python %d.%d is too old' % sys.version_info[:2]"
    first = [
        InstallStep("looking at that Python", [python, "-c", f"import sys; sys.exit({too_old})"]),
        InstallStep("making the environment", [python, "-m", "venv", str(venv)]),
    ]
    if wheels is not None:
        offline = ["--no-index", "--find-links", str(wheels)]
        return [*first, InstallStep("installing from the folder of wheels", [*pip, *offline, *packages])]
    small = InstallStep(
        "installing PyTorch's CPU build", [*pip, "--no-deps", "--index-url", INDEX, "torch"], optional=True
    )
    rest = InstallStep("installing torch and other packages", [*pip, *packages])
    return [*first, small, rest] if system == "linux" else [*first, rest]


def make(folder: Path, python: str, device: str = "auto", wheels: Path | None = None) -> str:
    """Make a runtime in `folder` of the interpreter `python` and return the line of `probe`.

    It takes the place of an earlier one only once it has passed. Cancelled, it leaves nothing behind and returns "".
    Raises StgaError with the step that failed.
    """
    with task.telling(task_folder(folder)) as teller:
        device = device_for(device, nvidia_smi())
        free = shutil.disk_usage(folder).free / 1e9
        if free < SIZES_GB[device]:
            raise StgaError(f"{folder}: has {free:.1f} GB free, the runtime needs {SIZES_GB[device]:.1f} GB")
        venv = next(path for number in count(1) if not (path := folder / f"venv-{number}").exists())
        todo = steps(venv, python, device, wheels)
        try:
            for number, step in enumerate(todo):
                if not _run(teller, number / (len(todo) + 1), step):
                    shutil.rmtree(venv, ignore_errors=True)
                    return ""
            teller.tell(len(todo) / (len(todo) + 1), "testing")
            line = probe(str(venv_python(venv)))
        except StgaError:
            shutil.rmtree(venv, ignore_errors=True)
            raise
        (venv / READY).touch()
        _remove_others(folder, venv)
        teller.tell(1.0, line)
    return line


def _remove_others(folder: Path, venv: Path) -> None:
    """Remove the environments beside `venv`: the one that it replaces, and what killed makers left."""
    for other in folder.glob("venv-*"):
        if other != venv:
            (other / READY).unlink(missing_ok=True)  # on Windows, a worker at work keeps the rest from being removed
            shutil.rmtree(other, ignore_errors=True)


def try_python(folder: Path, python: str) -> str:
    """`probe`, telling in the folder's task."""
    with task.telling(task_folder(folder)) as teller:
        teller.tell(0.0, "testing")
        line = probe(python)
        teller.tell(1.0, line)
    return line


def _run(teller: task.Teller, share: float, step: InstallStep) -> bool:
    """Run a step whose output goes where this process' goes; False where it was cancelled.

    Raises StgaError where it fails and must not.
    """
    print(PROMPT + " ".join(step.command), flush=True)
    try:
        child = subprocess.Popen(step.command, stdin=subprocess.DEVNULL)
    except OSError as error:
        raise StgaError(f"{step.command[0]}: cannot be started ({error.strerror or error})") from error
    while child.poll() is None:
        line = task.log_lines(teller.folder, 9)[-1:]  # pip's may be long
        if teller.tell(share, step.message, line[0].strip() if line else ""):
            child.terminate()
            child.wait()
            return False
        time.sleep(0.2)
    if child.returncode and not step.optional:
        raise StgaError(f"{step.message}: failed, {_reason(task.log_lines(teller.folder, 20), child.returncode)}")
    return True


def _reason(lines: Sequence[str], code: int) -> str:
    """Why a step failed, from the end of what it and those before it printed."""
    lines = lines[max((row for row, line in enumerate(lines) if line.startswith(PROMPT)), default=-1) + 1 :]
    known = [reason.format(line) for sign, reason in REASONS.items() for line in lines if sign in line]
    errors = [line for line in reversed(lines) if "error" in line.lower()]
    return next(iter([*known, *errors]), f"exit status {code}")


def main(arguments: Sequence[str] | None = None) -> int:
    top = argparse.ArgumentParser(prog="python -m stga_addon.worker.environment", description=__doc__)
    commands = top.add_subparsers(dest="command", required=True)
    tested = commands.add_parser("test")
    tested.add_argument("folder", type=Path)
    tested.add_argument("python")
    made = commands.add_parser("make")
    made.add_argument("folder", type=Path)
    made.add_argument("--python", default=sys.executable)
    made.add_argument("--device", choices=DEVICES, default="auto")
    made.add_argument("--wheels", type=Path)
    options = vars(top.parse_args(arguments))
    try:
        print({"test": try_python, "make": make}[options.pop("command")](**options))
    except StgaError as error:
        print(f"stga: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
