"""The Python that tracks and trains: Blender's own with the packages, or a chosen one."""

import os
import sys
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from ..errors import StgaError

REQUIREMENTS = {  # Module -> requirement of tracking and training, as in `pyproject.toml`
    "numpy": "numpy>=1.26,<3",
    "torch": "torch>=2.4,<3",
    "numba": "numba>=0.60,<1",
    "scipy": "scipy>=1.11,<2",
    "PIL": "pillow>=10,<14",
    "platformdirs": "platformdirs>=4,<5",
    "trimesh": "trimesh>=4,<6",
    "tqdm": "tqdm>=4.60,<5",
    "filelock": "filelock>=4,<5",
    "matplotlib": "matplotlib>=3.8,<4",
    "av": "av>=14,<19",
    "cv2": "opencv-python-headless>=4.12,<5",
}
"""Module -> requirement of tracking and training, as in `pyproject.toml`."""
GPU_REQUIREMENT = "wgpu>=0.32,<1"
"""Trains on a GPU; without it, or where it has no driver, the CPU trains."""
CAMERAS_REQUIREMENT = "pycolmap>=4,<5"
"""Finds the cameras of images without a calibration; without it, only that is refused."""
PYTHON_VARIABLE = "STGA_PYTHON"  # Names the training Python, above every other choice: for farms
BLENDER_VARIABLE = "STGA_BLENDER"  # The command that starts Blender on a machine that renders


def package_name(requirement: str) -> str:
    return requirement.partition(">=")[0]


@cache
def this_python() -> str:
    """Path of the interpreter whose library this process runs; workers of this Python are started
    with it.

    Embedded in Blender, `sys.executable` is what Python finds by its name: beside Blender's library
    in official builds, but a stranger's where Blender uses the system's library and another program
    of that name comes first on PATH.
    """
    prefix = Path(sys.prefix)
    if Path(sys.executable).is_relative_to(prefix):
        return sys.executable
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    names = (f"bin/python{version}", "bin/python3")
    if os.name == "nt":
        names = ("bin/python.exe", "python.exe")
    paths = (prefix / name for name in names)
    return next((str(path) for path in paths if path.is_file()), sys.executable)


def find_training_python(preferred: str = "") -> str:
    """The interpreter that tracks and trains: $STGA_PYTHON, else `preferred`, else this one. Raises
    StgaError where this one is left and lacks packages."""
    chosen = os.environ.get(PYTHON_VARIABLE) or preferred
    if chosen:  # without a folder, a program that is found on PATH
        return os.path.abspath(chosen) if os.path.dirname(chosen) else chosen
    missing = missing_packages()
    if missing:
        version = sys.version.split()[0]
        raise StgaError(
            f"{this_python()} (Python {version}) lacks {', '.join(missing)}. Install the complete "
            "edition of the add-on, or choose a Python that has them in its preferences or by "
            f"{PYTHON_VARIABLE}"
        )
    return this_python()


def missing_packages() -> list[str]:
    """What tracking and training need and this interpreter lacks, by the names of the packages."""
    return [
        package_name(text) for module, text in REQUIREMENTS.items() if find_spec(module) is None
    ]
