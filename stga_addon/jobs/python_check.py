"""Whether an interpreter can track and train: `python -m` this module reports its packages and
device as JSON in it, which is judged here."""

import importlib
import json
import os
import platform
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from ..errors import StgaError
from ..worker.training_python import REQUIREMENTS, package_name

MIN_PYTHON = 3, 11
CHECK_TIMEOUT_S = 180.0  # The first import of torch from a slow disk


@dataclass(frozen=True)
class Checked:
    """An interpreter that can track and train: a line on it, and its GPUs as `--device gpu:NAME`
    names them."""

    line: str
    adapters: tuple[str, ...]


def start_check(python: str) -> "subprocess.Popen[str]":
    """The process that `finish_check` judges. Raises StgaError where it cannot start."""
    from ..worker.launch import start_python  # needs a package that this Python may lack

    return start_python(
        python,
        ["stga_addon.jobs.python_check"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
    )


def finish_check(python: str, process: "subprocess.Popen[str]", timeout_s: float) -> Checked:
    """Wait for a check; StgaError, and its end, where it lacks something or does not answer."""
    with process:
        try:
            output, errors = process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired as error:
            process.kill()
            raise StgaError(f"{python}: did not answer within {CHECK_TIMEOUT_S:.0f} s") from error
    try:
        report = json.loads(output.strip().splitlines()[-1])
        return Checked(describe_check(python, report), tuple(report["adapters"]))
    except (ValueError, IndexError, KeyError, TypeError) as error:
        with suppress(OSError):  # the stream may be closed
            print(output + errors, file=sys.stderr, flush=True)
        raise StgaError(
            f"{python}: is not a Python that runs this add-on (exit status {process.returncode})"
        ) from error


def describe_check(python: str, report: dict[str, Any]) -> str:
    """The line of a check by the JSON of `main`. Raises StgaError for what is missing."""
    version = report["python"]
    versions = report["versions"]
    failures = report["failures"]
    if tuple(int(part) for part in version.split(".")[:2]) < MIN_PYTHON:
        raise StgaError(f"{python}: is Python {version}, training needs 3.11 or newer")
    missing = [package_name(text) for module, text in REQUIREMENTS.items() if module in failures]
    if missing:
        whys = [text for text in failures.values() if not text.startswith("ModuleNotFoundError")]
        failed = f" ({whys[0]})" if whys else ""
        raise StgaError(
            f"{python}: Python {version} lacks {', '.join(missing)}{failed}; install that there"
        )
    return (
        f"Python {version}, torch {versions['torch']}, numba {versions['numba']}, "
        f"{report['device']}"
    )


def main() -> None:
    versions = {}
    failures = {}
    for name in REQUIREMENTS:
        try:
            versions[name] = str(getattr(importlib.import_module(name), "__version__", "?"))
        except Exception as error:  # a library that fails to load raises what it likes
            failures[name] = f"{type(error).__name__}: {error}".splitlines()[0]
    # the device to report, which `choose_device` tries later, and GPUs for `--device gpu:NAME`
    device = f"CPU with {os.cpu_count()} threads"
    names = list[str]()
    with suppress(Exception):  # a package is missing, or a driver fails: the CPU trains
        from ..raster.gpu.adapters import adapters, is_software

        found = adapters()
        names = list(found)
        device = next((name for name in names if not is_software(found[name])), device)
    report = {
        "python": platform.python_version(),
        "versions": versions,
        "failures": failures,
        "device": device,
        "adapters": names,
    }
    print(json.dumps(report))


if __name__ == "__main__":
    main()
