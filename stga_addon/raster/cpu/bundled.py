"""Kernels that an edition of the extension brings compiled, so that the first training does not
wait for a compiler.

They need x86-64-v3: AVX2, FMA and what else NEEDED_FEATURES lists. A processor with AVX-512
compiles its own in the background, which are faster, and uses these until then.
"""

import os
import platform
import shutil
from contextlib import suppress
from pathlib import Path
from uuid import uuid4

from llvmlite.binding import get_host_cpu_features
from numba.core import config
from numba.core.caching import UserProvidedCacheLocator

from ..kernel_cache import NATIVE_KERNELS, has_kernels

PACKAGE = "stga_addon"
"""Name under which workers import the package. A compiled kernel refers to its modules by name;
inside of Blender they have other names, and other kernels."""
BUNDLE = Path(__file__).with_name("compiled")
"""Folder of Numba's cache files; only in an edition that brings them."""
PROCESSOR = "x86-64-v3"
"""LLVM's name of the processor for which the bundled kernels are compiled."""
MACHINES = ("x86_64", "AMD64")
"""Names of that kind of processor in `platform.machine`."""
NEEDED_FEATURES = ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")
FASTER_FEATURE = "avx512f"


def kernel_folder(native: Path, beside: Path) -> tuple[Path, bool]:
    """The folder of compiled kernels, and whether they are the bundled ones.

    native: that of this processor's kernels; beside: of bundled ones where the processor is faster
    with its own. Has to be called before Numba compiles or loads anything: the name of the
    processor is a part of a kernel's key.
    """
    features = get_host_cpu_features()
    runs = platform.machine() in MACHINES and all(features.get(name) for name in NEEDED_FEATURES)
    if not BUNDLE.is_dir() or not runs or not __name__.startswith(f"{PACKAGE}."):
        return native, False
    faster = features.get(FASTER_FEATURE)
    if faster and (NATIVE_KERNELS in os.environ or has_kernels(native)):
        return native, False
    folder = beside if faster else native
    with suppress(OSError):  # they are compiled then
        _copy_bundle(folder)
    vars(config).update(CPU_NAME=PROCESSOR, CPU_FEATURES="")
    return folder, True


def _copy_bundle(folder: Path) -> None:
    """Copy the bundle to where Numba looks for kernels of these files: it writes there, which an
    extension must not."""
    if has_kernels(folder):
        return
    path = folder / UserProvidedCacheLocator.get_suitable_cache_subpath(__file__)
    path.mkdir(parents=True, exist_ok=True)
    for file in sorted(BUNDLE.iterdir()):  # an index, .nbi, after what it names, .nbc
        partial = path / f"{file.name}.{uuid4().hex}"
        shutil.copyfile(file, partial)
        os.replace(partial, path / file.name)
