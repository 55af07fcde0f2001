"""The Python that tracks and trains beside Blender: Blender's own where it has the packages, or one that was chosen."""

import os
import sys
from importlib.util import find_spec

from ..errors import StgaError
from .own_python import own_python
from .requirements import REQUIREMENTS, package_name

PYTHON_VARIABLE = "STGA_PYTHON"
"""Environment variable that names the interpreter that tracks and trains, above every other choice: for farms."""
BLENDER_VARIABLE = "STGA_BLENDER"
"""Environment variable with the command that starts Blender on a machine that renders .blend files."""


def find_training_python(preferred: str = "") -> str:
    """The interpreter that tracks and trains: $STGA_PYTHON, else `preferred` (Blender's preferences), else this one.

    Raises StgaError where this one is left and lacks packages.
    """
    chosen = os.environ.get(PYTHON_VARIABLE) or preferred
    if chosen:  # without a folder, a program that is found on PATH
        return os.path.abspath(chosen) if os.path.dirname(chosen) else chosen
    missing = missing_packages()
    if missing:
        version = sys.version.split()[0]
        raise StgaError(
            f"{own_python()} (Python {version}) lacks {', '.join(missing)}. Install the complete edition of the "
            f"add-on, or choose a Python that has them in its preferences or by {PYTHON_VARIABLE}"
        )
    return own_python()


def missing_packages() -> list[str]:
    """What tracking and training need and this interpreter lacks, by the names of the packages."""
    return [package_name(text) for module, text in REQUIREMENTS.items() if find_spec(module) is None]
