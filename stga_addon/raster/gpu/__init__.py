"""GPU rasterizer: Warp kernels for NVIDIA GPUs, which also run on Warp's CPU device for tests.

Formulas, constants and results are those of `cpu/`. One thread a pixel, splat or coefficient; nothing here depends
on the order in which threads run, so the same input gives the same bits (there is no faster, unordered mode). Warp
runs its CPU device one thread after the other, so "all lanes of a warp" is one thread there (see `blend.py`).

Importing this package needs warp-lang, so only what works on its devices may import it.
"""

import os

import warp as wp
from platformdirs import user_cache_path

# Beside Numba's cache and for the same reason: one folder per package name in the user's cache.
wp.config.kernel_cache_dir = os.environ.get("WARP_CACHE_PATH") or str(
    user_cache_path("stga", appauthor=False) / "kernels" / __name__
)
wp.config.log_level = wp.LOG_ERROR  # the training status reports the device and the compilation
