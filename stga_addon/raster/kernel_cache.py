"""Whether the rasterizer's kernels are compiled already; numba is not needed to tell."""

from pathlib import Path

LAST_COMPILED = Path(__file__).with_name("cpu") / "image_loss.py"
"""Module of a kernel that takes long to compile; its index file shows that kernels are compiled."""
OWN_KERNELS = "STGA_OWN_KERNELS"
"""Environment variable of a process that compiles for its own processor (`cpu.bundled`)."""


def has_kernels(folder: Path) -> bool:
    """Whether a Numba cache below `folder` holds kernels of the package as it is: an update
    replaces its files."""
    indices = folder.rglob(f"{LAST_COMPILED.stem}.{LAST_COMPILED.stem}-*.nbi")
    return any(index.stat().st_mtime >= LAST_COMPILED.stat().st_mtime for index in indices)
