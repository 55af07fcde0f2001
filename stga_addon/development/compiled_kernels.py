"""Compiled kernels for the complete edition (`raster.cpu.bundled`), by a Python of the target where
there is one."""

import hashlib
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from ..errors import StgaError
from .wheels import Target, this_platform

ROOT = Path(__file__).resolve().parents[2]
"""Folder of the repository."""
PROCESSORS = {"linux-x64": "x86-64-v3", "windows-x64": "x86-64-v3"}
"""Blender's name of a platform -> LLVM's name of the processor."""
SCRIPT = """
import os, sys
os.environ.update({environment})
sys.path[:0] = {paths}
from stga_addon.training.optimize.precompile import compile_for_cpu
compile_for_cpu()
print("COMPILED", flush=True)
"""


def compile_kernels(target: Target, wheels: Path, blender: Sequence[str] = ()) -> list[Path]:
    """Numba's cache files of all kernels for any processor of the target's kind; none where no
    Python of the target is
    here: then they are compiled when they are first used.

    wheels: folder of the target's wheels. blender: the command that starts a Blender of the target;
    without it, this Python is used if it is one. Kept in build/kernels until a kernel changes.
    Raises StgaError where compiling fails.
    """
    if target.platform != this_platform() or target.platform not in PROCESSORS:
        return []
    folder = kernels_folder(target, wheels)
    if not _files(folder):
        if blender:
            with _unpacked(wheels) as site:
                _compile(
                    target,
                    [*blender, "--background", "--factory-startup", "--python-expr"],
                    [site],
                    folder,
                )
        elif _is_target(target, wheels):
            _compile(target, [sys.executable, "-c"], [], folder)
    return _files(folder)


def kernels_folder(target: Target, wheels: Path) -> Path:
    """Where the kernels of these sources are kept; one process at a time may compile into it."""
    return ROOT / "build/kernels" / f"{target.name}-{_digest(wheels)}"


def _compile(target: Target, command: Sequence[str], sites: Sequence[Path], folder: Path) -> None:
    environment = {
        "NUMBA_CPU_NAME": PROCESSORS[target.platform],
        "NUMBA_CPU_FEATURES": "",
        "NUMBA_CACHE_DIR": str(folder),
    }
    script = SCRIPT.format(environment=environment, paths=[str(path) for path in (ROOT, *sites)])
    done = subprocess.run([*command, script], capture_output=True, text=True, check=False)
    if "COMPILED" not in done.stdout:
        reason = (done.stderr or done.stdout).strip().splitlines()[-1:] or [
            f"exit status {done.returncode}"
        ]
        raise StgaError(f"{target.name}: the kernels could not be compiled ({reason[0]})")


def _files(folder: Path) -> list[Path]:
    return sorted(file for suffix in ("nbc", "nbi") for file in folder.glob(f"*/*.{suffix}"))


def _digest(wheels: Path) -> str:
    """Digest of the sources that the kernels come from, and of the compiler's version."""
    found = hashlib.sha256()
    for file in sorted(ROOT.joinpath("stga_addon/raster/cpu").glob("*.py")):
        found.update(file.read_bytes())
    for wheel in sorted((*wheels.glob("numba-*"), *wheels.glob("llvmlite-*"))):
        found.update(wheel.name.encode())
    return found.hexdigest()[:16]


def _is_target(target: Target, wheels: Path) -> bool:
    """Whether this Python and its Numba are the target's."""
    try:
        installed = version("numba")
    except PackageNotFoundError:
        return False
    return target.python == "{}.{}".format(*sys.version_info[:2]) and any(
        wheels.glob(f"numba-{installed}-*")
    )


@contextmanager
def _unpacked(wheels: Path) -> Iterator[Path]:
    """A folder with the packages of the wheels, for as long as they are needed."""
    with tempfile.TemporaryDirectory(prefix="stga-") as folder:
        for wheel in sorted(wheels.glob("*.whl")):
            with zipfile.ZipFile(wheel) as archive:
                archive.extractall(folder)
        yield Path(folder)
