"""The kernels that the tests share: those of the complete edition, compiled once, before the tests
start.

`python tests/kernels.py`, which `make test` runs beside the linters, compiles all of them in one
process, in most of a minute, and keeps what raster/kernel_bits.py printed there. Without, as after
a change, a test compiles what it needs.
"""

import os
import shutil
import sys
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock
from uuid import uuid4
from zlib import crc32

from filelock import FileLock

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from stga_addon.development import compiled_kernels
from stga_addon.development.wheels import Target, this_platform

TARGET = Target(this_platform(), "{}.{}".format(*sys.version_info[:2]), ("4.2.0", ""))
KERNEL_BITS = Path(__file__).with_name("raster") / "kernel_bits.py"
BITS = """
import contextlib, runpy
path = os.environ["NUMBA_CACHE_DIR"] + "/bits.txt"
with open(path, "w") as file, contextlib.redirect_stdout(file):
    runpy.run_path({!r})
print("""
SCRIPT = compiled_kernels.SCRIPT.replace("from", "os.cpu_count = lambda: 1\nfrom", 1)
SCRIPT = SCRIPT.replace("print(", BITS.format(str(KERNEL_BITS)))


def bundle(compiles=True):
    """Folder of the kernels and their bits.txt; None where no edition brings any, or where it
    should not compile."""
    with TemporaryDirectory() as name, mock.patch.object(compiled_kernels, "SCRIPT", SCRIPT):
        wheels = Path(name)
        (wheels / f"numba-{version('numba')}-tests{crc32(KERNEL_BITS.read_bytes())}").touch()
        folder = compiled_kernels.kernels_folder(TARGET, wheels)
        if not compiles:
            return folder if _are_newer(folder / "bits.txt") else None
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(folder.with_name(f"{folder.name}.lock")):
            if not _are_newer(folder / "bits.txt"):
                # half of them, or of files of another time: not loaded
                shutil.rmtree(folder, ignore_errors=True)
                compiled_kernels.compile_kernels(TARGET, wheels)
        return folder if folder.exists() else None


def _are_newer(bits):
    """Whether the kernels were compiled, to the end, after their sources were written."""
    sources = compiled_kernels.ROOT.joinpath("stga_addon/raster/cpu").glob("*.py")
    return bits.exists() and bits.stat().st_mtime >= max(path.stat().st_mtime for path in sources)


def shared_kernels():
    """Environment variables of processes that use a copy of the bundle, and add to it; none where
    there is no bundle of the sources as they are, or Numba is told already what to do."""
    folder = bundle(compiles=False)
    if folder is None or any(name.startswith("NUMBA_") for name in os.environ):
        return {}
    used = folder.with_name(f"{folder.name}-used")
    if not _are_newer(used / "bits.txt"):
        partial = used.with_name(f"{used.name}.{uuid4().hex}")
        shutil.copytree(folder, partial)
        shutil.rmtree(used, ignore_errors=True)
        partial.rename(used)
    processor = compiled_kernels.PROCESSORS[TARGET.platform]
    return {"NUMBA_CACHE_DIR": str(used), "NUMBA_CPU_NAME": processor, "NUMBA_CPU_FEATURES": ""}


if __name__ == "__main__":
    print(bundle() or "no kernels are bundled for this platform")
