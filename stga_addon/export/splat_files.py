"""Reading of world-space splats of any kind of file: PLY, SPZ, .splat."""

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np

from ..avatar.splats import SH_C0, Splats, in_world
from ..errors import StgaError
from ..files import is_folder, read_bytes
from ..progress import Log, warn
from .ply import MAX_SPLAT_BYTES, READ_FILES, read_ply
from .spz import read_spz

GAUSSIAN_OUTPUT = "point_cloud/iteration_*/*.ply"
"""Paths at which 3D Gaussian Splatting writes the splats of an iteration."""
CONVERTED = "are not read; save them as .ply, for example with SuperSplat"
"""What a message says of files with UNREAD_SUFFIXES."""

UNREAD_SUFFIXES = {
    ".ksplat": "mkkellogg's splats",
    ".sog": "PlayCanvas' SOG",
    ".sogs": "PlayCanvas' SOG",
    ".splatv": "4D splats",
    ".spx": "Reall3D's splats",
    ".lcc": "XGRIDS' splats",
    ".rad": "Spark's splats",
    ".gsz": "packed splats",
    ".glb": "splats in glTF",
    ".gltf": "splats in glTF",
    ".usd": "splats in USD",
    ".usda": "splats in USD",
    ".usdc": "splats in USD",
    ".usdz": "splats in USD",
    ".pt": "PyTorch's checkpoints",
    ".pth": "PyTorch's checkpoints",
    ".ckpt": "PyTorch's checkpoints",
}
"""Suffix of files of splats, which are not read -> what they are."""
SPLAT_ROW = np.dtype(
    [("xyz", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)]
)
"""Row of antimatter15's .splat: linear scales; red, green, blue, opacity; w, x, y, z from -1 to
1."""


def is_splats(path: Path) -> bool:
    """Whether a path is named as a file of splats that are bound to no head, or is the output of 3D
    Gaussian Splatting."""
    return path.suffix.lower() in (*READERS, *UNREAD_SUFFIXES) or latest_iteration(path) is not None


def latest_iteration(folder: Path) -> Path | None:
    """The splats of the last iteration in a folder of 3D Gaussian Splatting's output, or of tools
    that write as it does; None for others."""
    found = {}
    for path in folder.glob(GAUSSIAN_OUTPUT) if is_folder(folder) else ():
        number = path.parent.name.rpartition("_")[2]
        if number.isascii() and number.isdigit():
            found[int(number)] = path
    return found[max(found)] if found else None


def read_splats(path: Path, log: Log = warn) -> Splats:
    """World-space splats of a .ply, .spz or .splat file, with harmonics of degree 0 to 3.

    Rows that hold a value that is not finite are left out. `log` gets a sentence about what was
    left out or repaired. Raises StgaError naming the file, also for other kinds of files.
    """
    latest = latest_iteration(path)
    if latest is not None:
        log(f"{path}: {latest.relative_to(path).as_posix()} is used")
        path = latest
    suffix = path.suffix.lower()
    if suffix not in READERS:
        kind = UNREAD_SUFFIXES.get(suffix, f"files named {suffix}")
        raise StgaError(f"{path}: {kind} {CONVERTED}; expected {READ_FILES}")
    splats = READERS[suffix](path, log)
    if not len(splats):
        raise StgaError(f"{path}: holds no splats")
    finite = np.ones(len(splats), bool)
    for each in fields(splats):
        values = getattr(splats, each.name).reshape(len(splats), -1)
        finite &= np.isfinite(values).all(axis=1)
    if finite.all():
        return splats
    lost = f"{len(finite) - finite.sum()} of {len(finite)} splats hold values that are not finite"
    if not finite.any():
        raise StgaError(f"{path}: {lost}")
    log(f"{path}: left out splats: {lost}")
    return splats.rows(finite)


def read_splat(path: Path, log: Log = warn) -> Splats:
    """The splats of a .splat file, without harmonics above degree 0. Raises StgaError."""
    data = read_bytes(path, MAX_SPLAT_BYTES)
    if not data or len(data) % SPLAT_ROW.itemsize:
        raise StgaError(
            f"{path}: is not a readable .splat file: has {len(data)} bytes, which are no rows "
            f"of {SPLAT_ROW.itemsize}; expected {READ_FILES}"
        )
    table = np.frombuffer(data, SPLAT_ROW)
    fraction = table["color"].astype(np.float32) / 255
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scale = np.log(table["scale"])
        opacity = np.log(fraction[:, 3] / (1 - fraction[:, 3]))
    return in_world(
        table["xyz"],
        (table["rotation"].astype(np.float32) - 128) / 128,
        log_scale,
        opacity,
        ((fraction[:, :3] - 0.5) / SH_C0)[:, None],
    )


READERS: dict[str, Callable[[Path, Log], Splats]] = {
    ".ply": read_ply,
    ".spz": read_spz,
    ".splat": read_splat,
}
"""Suffix -> reader."""
