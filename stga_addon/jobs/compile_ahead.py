"""Compiling kernels and loading modules ahead of a training.

`python -m stga_addon.jobs.compile_ahead` is started by Blender with a capture.
"""

import os
from contextlib import suppress
from importlib import import_module
from pkgutil import walk_packages

from ..errors import StgaError
from ..raster.kernel_cache import NATIVE_KERNELS
from ..worker.launch import PREPARING, cache_folder
from ..worker.lock import hold_folder

LOADED_AHEAD = ("avatar", "capture", "flame", "raster.cpu", "training")
"""Rooms that a worker which trains loads before it begins."""
TORCH_MODULES = ("raster.cpu.autograd",)  # Modules in them that import torch, which takes seconds


def begin_training() -> None:
    """Compile beside the work that follows, and load what it needs later."""
    from ..raster.cpu.precompile import begin_compiling

    begin_compiling()
    load_ahead()


def load_ahead() -> None:
    """Load what a training needs later: an add-on's update may exchange the files meanwhile."""
    for room in LOADED_AHEAD:
        package = import_module(f"..{room}", __package__)
        for module in walk_packages(getattr(package, "__path__", ()), f"{package.__name__}."):
            if not module.name.endswith(TORCH_MODULES):
                # a package that not every Python has, and that nothing here needs
                with suppress(ImportError):
                    import_module(module.name)


def compile_ahead() -> None:
    """Compile Numba's kernels and the bytecode of an extension's packages for the first training on
    this machine; no effect while another process does, or without room."""
    os.environ[NATIVE_KERNELS] = "1"
    with suppress(OSError, StgaError), hold_folder(cache_folder(), PREPARING, "preparation"):
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
    compile_ahead()
