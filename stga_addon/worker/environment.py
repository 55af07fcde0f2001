"""Training environment: the Python with torch that trains beside Blender, and how it is found.

In the environment's folder, `venv-N` is an environment that `requests.environment_make` made, in which the file `ready`
says that it passed the check, and `choice.json` names an interpreter that is used instead.
"""

import os
import re
import sys
from importlib.util import find_spec
from pathlib import Path

from ..errors import StgaError
from ..files import read_json
from .environment_use import READY
from .own_python import own_python
from .requirements import REQUIREMENTS, package_name

PYTHON_VARIABLE = "STGA_PYTHON"
"""Environment variable that names the interpreter that trains, above every other choice: for render farms."""
BLENDER_VARIABLE = "STGA_BLENDER"
"""Environment variable with the command that starts Blender on a machine that renders .blend files."""
CHOICE_FILE = "choice.json"
ADAPTERS_FILE = "adapters.json"


def find_training_python(folder: Path, preferred: str = "") -> str:
    """The interpreter that trains.

    In this order: $STGA_PYTHON, `preferred` (Blender's preferences), the stored choice, the environment made in
    `folder`, this interpreter. Raises StgaError where this one is left and lacks packages.
    """
    chosen = os.environ.get(PYTHON_VARIABLE) or preferred or stored_choice(folder) or str(made_python(folder) or "")
    if chosen:  # without a folder, a program that is found on PATH
        return os.path.abspath(chosen) if os.path.dirname(chosen) else chosen
    missing = missing_packages()
    if missing:
        version = sys.version.split()[0]
        raise StgaError(
            f"No training environment: {own_python()} (Python {version}) lacks {', '.join(missing)}. Install the "
            "complete edition of the add-on, choose a Python that has them in its preferences or with `blender "
            f"--background --command stga environment use PATH`, or set {PYTHON_VARIABLE}"
        )
    return own_python()


def stored_choice(folder: Path) -> str:
    """The interpreter chosen with `stga environment use`; "" where none was.

    Raises StgaError where the file is malformed.
    """
    path = folder / CHOICE_FILE
    if not path.exists():
        return ""
    values = read_json(path)
    python = values.get("python") if isinstance(values, dict) else None
    if not isinstance(python, str):
        raise StgaError(f"{path}: 'python' is not a path; remove the file or choose an interpreter again")
    return python


def stored_adapters(folder: Path) -> list[str]:
    """The GPUs that the interpreter which was checked last can train on, as `--device gpu:NAME` names them."""
    try:
        names = read_json(folder / ADAPTERS_FILE)
    except StgaError:
        return []
    return [name for name in names if isinstance(name, str)] if isinstance(names, list) else []


def status_folder(folder: Path) -> Path:
    return folder / "status"


def made_python(folder: Path) -> Path | None:
    """The interpreter of the newest environment in `folder` that passed its check; None where there is none."""
    pythons = (venv_python(venv) for venv in reversed(environments(folder)) if (venv / READY).exists())
    return next((python for python in pythons if python.exists()), None)


def venv_python(venv: Path) -> Path:
    return venv / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def missing_packages() -> list[str]:
    """What training needs and this interpreter lacks, by the names of the packages."""
    return [package_name(text) for module, text in REQUIREMENTS.items() if find_spec(module) is None]


def environments(folder: Path) -> list[Path]:
    """The environments in `folder`, complete or not, oldest first."""
    return sorted((venv for venv in folder.glob("venv-*") if environment_number(venv)), key=environment_number)


def environment_number(venv: Path) -> int:
    """N of a folder venv-N; 0 of any other."""
    number = venv.name.removeprefix("venv-")
    return int(number) if re.fullmatch(r"[1-9]\d{0,8}", number, re.ASCII) else 0
