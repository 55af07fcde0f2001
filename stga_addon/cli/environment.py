"""Make, choose, test or remove the training environment: the Python with torch that trains beside Blender.

The variable STGA_PYTHON names a Python that takes precedence over all of these.
"""

import os
import shutil
import sys
import time
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

from ..errors import StgaError
from ..requests.environment_job import CAN_MAKE, check_python, remove_environment, store_choice
from ..requests.open_head import OpenHead
from ..worker.environment import PYTHON_VARIABLE, find_training_python, made_python, status_folder
from ..worker.launch import prepare_status_folder, start_worker
from ..worker.status import inspect_worker, request_cancel
from .arguments import usable_path

NAME, HELP = "environment", "make, choose, test or remove the Python with torch that trains beside Blender"
FOLDER_VARIABLE = "STGA_ENVIRONMENT_FOLDER"
"""Environment variable that names the folder of the environment; Blender sets it for its commands."""
POLL_INTERVAL_S = 0.3


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    parser.add_argument(
        "--folder", type=usable_path, help="folder of the environment (default: in Blender's or your user data)"
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    if CAN_MAKE:
        _add_make(actions)
    use = actions.add_parser("use", help="test a Python that has the packages, and use it")
    use.add_argument("python", metavar="PATH")
    actions.add_parser("test", help="show which Python trains, its versions of torch and numba and its device")
    actions.add_parser("remove", help="remove the environment, and forget the Python chosen with `use`")


def _add_make(actions: Any) -> None:
    make = actions.add_parser("make", help="make an environment with PyTorch, and use it")
    make.add_argument("--wheels", type=usable_path, metavar="FOLDER", help="wheel files, to install without a network")
    make.add_argument("--python", default=sys.executable, metavar="PATH", help="Python 3.11 or newer to make it from")


def run(options: Namespace) -> None:
    folder = (options.folder or _default_folder()).absolute()
    if options.action == "remove":
        print(f"Removed {remove_environment(folder)} environment(s) from {folder}")
        return
    if options.action == "make":
        line, python = _make(folder, options), str(made_python(folder))
    elif options.action == "use":
        python = shutil.which(options.python) or os.path.abspath(options.python)
        line = store_choice(folder, python)
    else:
        python = find_training_python(folder)
        line = check_python(python, folder if folder.is_dir() else None)
    print(f"{python}: {line}")
    used = find_training_python(folder)
    if used != python:
        print(f"{used} takes precedence: {PYTHON_VARIABLE} or the add-on's preferences name it")


def _default_folder() -> Path:
    if os.environ.get(FOLDER_VARIABLE):
        return Path(os.environ[FOLDER_VARIABLE])
    import platformdirs  # Blender, which may lack it, sets the variable

    return platformdirs.user_data_path("stga") / "environment"


def _make(folder: Path, options: Namespace) -> str:
    """Make the environment in a worker, whose log gives the reason of a failure, and print its progress."""
    if options.wheels is not None and not options.wheels.is_dir():
        raise StgaError(f"--wheels: {options.wheels} is not a folder; expected one of wheel files")
    status, message = status_folder(folder), ""
    prepare_status_folder(status)
    wheels = options.wheels and options.wheels.absolute()
    from ..requests.environment_make import make_arguments  # which not every edition has

    making = make_arguments(folder, options.python, wheels)
    worker = start_worker(status, sys.executable, making)
    try:
        while worker.poll() is None:
            now = inspect_worker(status, worker).status.message
            if now != message:
                message = now
                print(message, flush=True)
            time.sleep(POLL_INTERVAL_S)
    except KeyboardInterrupt:
        request_cancel(status)
        worker.wait()
        raise
    final = inspect_worker(status, worker)
    if final.state.failed:
        raise StgaError(final.status.error)
    return final.status.message
