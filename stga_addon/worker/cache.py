"""Folder of what is compiled on this machine: kernels, and bytecode of the packages that an extension brings."""

import os
from pathlib import Path

from .lock import is_locked

CACHE_VARIABLE = "STGA_CACHE"
"""Environment variable that names the folder. Blender's extension sets it to one that uninstalling removes."""
KERNELS, BUNDLED, BYTECODE, CHARTS = "kernels", "bundled kernels", "bytecode", "matplotlib"
"""Folders in it: of Numba; of kernels that an edition brings, where this processor is faster with its own
(`raster.cpu.bundled`); of Python (`PYTHONPYCACHEPREFIX`) and of matplotlib."""
PREPARING = "preparing.lock"
"""Held in it by the process that compiles ahead of a training (`perform.preparation`)."""


def cache_folder() -> Path:
    """The folder that CACHE_VARIABLE names, else the user's cache folder."""
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        return Path(named)
    from platformdirs import user_cache_path  # a Python without it, such as Blender's, has the variable

    return user_cache_path("stga", appauthor=False)


def is_preparing() -> bool:
    """Whether a process compiles ahead of a training."""
    return is_locked(cache_folder() / PREPARING)
