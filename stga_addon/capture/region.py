"""Regions of triangles by name, or from a file that an artist's tool wrote."""

from pathlib import Path

import numpy as np

from ..errors import StgaError
from ..files import read_npz
from ..flame.model import faces_within
from .meshes import read_regions
from .model import Capture

WEIGHTS = "weights"
FILES = (".npz", ".json")
"""Suffixes of region files."""
SELECTED_WEIGHT = 0.5
"""Least weight of a triangle that belongs to the region."""


def is_region_file(name: str) -> bool:
    """Whether a region is named by its file."""
    return Path(name).suffix.lower() in FILES


def find_region(capture: Capture, name: str) -> np.ndarray:
    """(F,) bool: a region of the capture, a vertex mask of FLAME, or the triangles of a region file.

    Raises StgaError where there is none, or it holds no triangle.
    """
    region = _find(capture, name)
    if not region.any():
        raise StgaError(f"region '{name}': holds no triangle")
    return region


def _find(capture: Capture, name: str) -> np.ndarray:
    masks = {} if capture.flame is None else capture.flame.model.masks
    if name in capture.regions:
        return np.asarray(capture.regions[name])
    if name in masks:
        return faces_within(capture.faces, masks[name])
    path = Path(name)
    if path.suffix.lower() == ".npz":
        return _read_weights(path, len(capture.faces))
    if path.suffix.lower() == ".json":
        regions = read_regions(path, capture.faces, len(capture.neutral))
        return np.asarray(np.any([np.zeros(len(capture.faces), bool), *regions.values()], axis=0))
    known = ", ".join(dict.fromkeys([*capture.regions, *masks])) or "none"
    raise StgaError(f"region '{name}': is neither a region of the capture ({known}) nor an .npz or .json file")


def _read_weights(path: Path, faces: int) -> np.ndarray:
    weights = read_npz(path).get(WEIGHTS)
    if weights is None or weights.dtype not in (np.float32, np.float64, np.bool_) or weights.shape != (faces,):
        found = "no such array" if weights is None else f"{weights.dtype} {weights.shape}"
        raise StgaError(f"{path}: expected '{WEIGHTS}', one number from 0 to 1 per triangle ({faces},), found {found}")
    return np.asarray(weights >= SELECTED_WEIGHT)
