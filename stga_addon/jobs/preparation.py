"""Compilation ahead of a training: `python -m stga_addon.jobs.preparation`, which Blender starts
with a capture.

The first training on a machine compiles Numba's kernels, and bytecode of the packages that an
extension brings.
"""

import os
from contextlib import suppress
from importlib import import_module

from ..raster.kernel_cache import OWN_KERNELS
from ..worker.launch import PREPARING, cache_folder
from ..worker.lock import hold_lock
from .perform import load_ahead


def prepare() -> None:
    """Compile what a training runs; no effect while another process does, or without room."""
    os.environ[OWN_KERNELS] = "1"
    folder = cache_folder()
    with suppress(OSError):  # BlockingIOError among them
        folder.mkdir(parents=True, exist_ok=True)
        with hold_lock(folder / PREPARING):
            from ..raster.cpu.precompile import rasterizer_helper

            rasterizer_helper()
            load_ahead()
            from ..training.optimize.precompile import compile_for_cpu

            compile_for_cpu()
            # The first lists the machine's fonts; torch's bytecode is not written by `load_ahead`.
            for library in ("matplotlib.font_manager", "torch"):
                with suppress(ImportError):
                    import_module(library)


if __name__ == "__main__":
    prepare()
