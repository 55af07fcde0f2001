"""Numba kernels: the only code here written for a machine first and a reader second.

Rules that keep LLVM vectorising the inner loops: they run over contiguous float32, hold no branch (selects
instead), use float32 constants only, and address several per-pixel values as offsets into one flat array, so
that no run-time alias checks are needed.
"""

import numba
from numba.core import config
from platformdirs import user_cache_path

# Compiled kernels are kept between processes, but never in the package's own folder: an installed extension must
# not write there. NUMBA_CACHE_DIR still wins.
# Numba sets its options as module attributes while it is imported, where mypy cannot see them.
if not config.CACHE_DIR:  # type: ignore[attr-defined]
    config.CACHE_DIR = str(user_cache_path("stga", appauthor=False) / "kernels")  # type: ignore[attr-defined]

# Reassociation and contraction let reductions vectorise; NaN and infinity keep their meaning, because a broken
# splat must be recognised and dropped.
FASTMATH = {"reassoc", "contract", "nsz", "arcp"}

jit = numba.njit(fastmath=FASTMATH, error_model="numpy", cache=True)
parallel_jit = numba.njit(parallel=True, fastmath=FASTMATH, error_model="numpy", cache=True)
inline_jit = numba.njit(fastmath=FASTMATH, error_model="numpy", inline="always")
