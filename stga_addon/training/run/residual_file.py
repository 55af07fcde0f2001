"""File of a run folder with the error of its avatar on each triangle."""

from pathlib import Path

import numpy as np

from ...errors import StgaError
from ...files import read_npz, write_npz

RESIDUALS = "residuals.npz"


def write_residuals(folder: Path, mean: np.ndarray) -> None:
    """Write mean (F,): mean absolute error (0…1) of what each triangle's splats show, NaN where that is unknown."""
    write_npz(folder / RESIDUALS, {"residual": mean.astype(np.float32)}, compressed=True)


def read_residuals(folder: Path, faces: int) -> np.ndarray:
    """(F,) float32 as written. Raises StgaError where there is no such file, or it is of another mesh."""
    path = folder / RESIDUALS
    residual = read_npz(path).get("residual")
    if residual is None or residual.dtype != np.float32 or residual.shape != (faces,):
        found = "no such array" if residual is None else f"{residual.dtype} {residual.shape}"
        raise StgaError(f"{path}: expected 'residual', float32 ({faces},), found {found}")
    return residual
