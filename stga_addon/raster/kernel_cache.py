"""Whether the rasterizer's kernels are compiled already; numba is not needed for that."""

import os
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from ..worker.launch import BUNDLED, KERNELS, cache_folder

LAST_COMPILED = Path(__file__).with_name("cpu") / "image_loss.py"
"""Module of a kernel that takes long to compile; its index file shows that kernels are compiled."""
NATIVE_KERNELS = "STGA_OWN_KERNELS"
"""Environment variable of a process that compiles for its own processor (`cpu.bundled`)."""


def has_kernels(folder: Path) -> bool:
    """Whether a Numba cache below `folder` holds kernels of the package as it is: an update
    replaces its files."""
    indices = folder.rglob(f"{LAST_COMPILED.stem}.{LAST_COMPILED.stem}-*.nbi")
    return any(index.stat().st_mtime >= LAST_COMPILED.stat().st_mtime for index in indices)


@cache
def prefers_numba() -> bool:
    """Whether this process computes by Numba's kernels what NumPy's can as well: where Numba is
    installed, and has compiled kernels of the package.

    To load and compile takes longer than many images. In Blender's own process the package has
    another name, under which no kernels are compiled.
    """
    if find_spec("numba") is None:
        return False
    name = f"{__package__}.{LAST_COMPILED.parent.name}"
    compiled = os.environ.get("NUMBA_CACHE_DIR") or cache_folder() / KERNELS / name
    return any(has_kernels(folder) for folder in (Path(compiled), cache_folder() / BUNDLED / name))
