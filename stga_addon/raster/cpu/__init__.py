"""CPU rasterizer: Numba kernels and their driver; `layout.py` documents the arrays that they
exchange.

The kernels are written for speed. LLVM vectorizes an inner loop that runs over contiguous float32,
has no branch (selects instead) and no store that may keep the old value, uses float32 constants
only, and addresses several per-pixel values as offsets into one flat array, so that no alias checks
are needed at run time. `tests/raster/test_assembly.py` reads the assembly for several processors.
"""

import os
from pathlib import Path
from typing import Any

import numba
from numba.core import config

from ...worker.launch import BUNDLED, KERNELS, cache_folder
from .bundled import kernel_folder

# Reassociation and contraction let reductions vectorize; NaN and infinity keep their meaning,
# because a broken splat must be recognised and dropped.
FASTMATH = {"reassoc", "contract", "nsz", "arcp"}

# Compiled kernels are kept between processes, but never in the package's own folder: an installed
# extension must not write there. One folder per package name, because a cached kernel refers to its
# modules by name, and the same files may be imported as `stga_addon` and as part of an extension.
KERNEL_CACHE_FOLDER, USES_BUNDLED_KERNELS = kernel_folder(
    Path(os.environ.get("NUMBA_CACHE_DIR") or cache_folder() / KERNELS / __name__),
    cache_folder() / BUNDLED / __name__,
)


def _cached(**options: Any) -> Any:
    def decorate(function: Any) -> Any:
        previous = vars(config)["CACHE_DIR"]
        # read by the decorator; others keep their setting
        vars(config)["CACHE_DIR"] = str(KERNEL_CACHE_FOLDER)
        try:
            return numba.njit(fastmath=FASTMATH, error_model="numpy", cache=True, **options)(
                function
            )
        finally:
            vars(config)["CACHE_DIR"] = previous

    return decorate


jit = _cached(nogil=True, no_cfunc_wrapper=True)
# For functions that kernels call. Unless LLVM inlines them, a process that compiles the kernel
# calls the function as compiled alone, and one that loads it from the cache calls the copy in
# there, whose last bits differ.
part_jit = _cached(forceinline=True, no_cfunc_wrapper=True)
inline_jit = numba.njit(fastmath=FASTMATH, error_model="numpy", inline="always")
