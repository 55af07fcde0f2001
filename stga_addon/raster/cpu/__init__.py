"""Numba kernels: the only code here written for a machine first and a reader second.

Rules that keep LLVM vectorizing the inner loops: they run over contiguous float32, hold no branch (selects
instead), use float32 constants only, and address several per-pixel values as offsets into one flat array, so
that no run-time alias checks are needed.
"""

import os
from typing import Any

import numba
from numba.core import config
from platformdirs import user_cache_path

# Reassociation and contraction let reductions vectorize; NaN and infinity keep their meaning, because a broken
# splat must be recognised and dropped.
FASTMATH = {"reassoc", "contract", "nsz", "arcp"}

# Compiled kernels are kept between processes, but never in the package's own folder: an installed extension must
# not write there. One folder per package name, because a cached kernel refers to its modules by name, and the same
# files may be imported as `stga_addon` and as part of an extension.
KERNEL_CACHE_FOLDER = os.environ.get("NUMBA_CACHE_DIR") or str(
    user_cache_path("stga", appauthor=False) / "kernels" / __name__
)


def _cached(**options: Any) -> Any:
    def decorate(function: Any) -> Any:
        before = vars(config)["CACHE_DIR"]
        vars(config)["CACHE_DIR"] = KERNEL_CACHE_FOLDER  # read while decorating; other users of Numba keep their own
        try:
            return numba.njit(fastmath=FASTMATH, error_model="numpy", cache=True, **options)(function)
        finally:
            vars(config)["CACHE_DIR"] = before

    return decorate


jit = _cached(nogil=True)
# What other kernels call. Without forcing LLVM to inline it, a process that compiles calls the function as it was
# optimized alone, and one that loads the kernel from the cache calls the copy in there, whose last bits differ.
part_jit = _cached(forceinline=True)
inline_jit = numba.njit(fastmath=FASTMATH, error_model="numpy", inline="always")
