"""Environment job: checks, chooses and removes the Python that trains; finding it is `worker.environment`.

`python -m stga_addon.requests.environment_job check FOLDER PYTHON` is a worker with its status in FOLDER/status.
`environment_make` makes environments.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..errors import StgaError, exit_code
from ..files import write_json
from ..worker.environment import (
    ADAPTERS_FILE,
    CHOICE_FILE,
    environments,
    status_folder,
)
from ..worker.environment_use import READY, environment_users
from ..worker.launch import start_python
from ..worker.requirements import REQUIREMENTS, package_name
from ..worker.status import status_writer

MIN_PYTHON = 3, 11
CAN_MAKE = Path(__file__).with_name("environment_make.py").exists()
"""Whether this edition can make an environment: some are built without the installer."""
CHECK_TIMEOUT_S = 180.0
"""The first import of torch from a slow disk."""


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
        raise StgaError(f"{python}: Python {version} lacks {', '.join(missing)}{failed}; install that there")
    return f"Python {version}, torch {versions['torch']}, numba {versions['numba']}, {report['device']}"


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


# Removing


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
        remove_unused(venvs)
        left = environments(folder)
        if left:
            raise StgaError(f"{left[0]}: cannot be removed completely; remove the folder by hand")
        writer.update(1.0, "Removed")
    return len(venvs)


def remove_unused(venvs: Iterable[Path]) -> None:
    """Remove environments that no process runs in."""
    for venv in venvs:
        with suppress(OSError):
            (venv / READY).unlink(missing_ok=True)  # first, so that no new worker starts from it
        if not environment_users(venv):
            shutil.rmtree(venv, ignore_errors=True)


def main(arguments: Sequence[str] | None = None) -> int:
    top = argparse.ArgumentParser(prog="python -m stga_addon.requests.environment_job", description=__doc__)
    check = top.add_subparsers(required=True).add_parser("check")
    check.add_argument("folder", type=Path)
    check.add_argument("python")
    options = vars(top.parse_args(arguments))
    return exit_code(lambda: print(check_in_worker(**options)))


if __name__ == "__main__":
    raise SystemExit(main())
