"""Range of strain that a run has trained on, within which its avatar's colors and positions follow
strain.

strain_range.npz   `strain_range` (F, 2, 3) float32 of a run, and `identity`: the digest of the
                   run's
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ...avatar.file import Avatar, read_avatar
from ...avatar.strain import COLOR_RANGE, color_range, seen_range, strain_basis
from ...capture.model import Capture
from ...errors import StgaError
from ...files import read_npz, write_npz
from .folder import AVATAR, Continuation, Run

STRAIN_RANGE = "strain_range.npz"
OLDER_COLORS = "colors follow strain as in an earlier version; train it anew"


def trained_strain_range(
    capture: Capture, mesh: Callable[[int], np.ndarray], continuation: Continuation | None
) -> np.ndarray:
    """`Avatar.strain_range` (F, 2, 3) of a run: what all its training timesteps show, and what its
    parent's did.

    mesh: timestep -> (V, 3) that is trained on; one at a time is held. Within COLOR_RANGE.
    """
    limits = color_range(len(capture.faces))
    basis = strain_basis(capture.neutral, capture.faces, limits)
    timesteps = sorted({view.timestep for view in capture.views["train"]})
    seen = seen_range(basis, (mesh(timestep) for timestep in timesteps))
    parent = None if continuation is None else read_avatar(continuation.parent / AVATAR)
    if parent is None or not parent.follows_strain:
        return seen  # it follows strain only from here on
    if parent.strain_range is None:
        return limits
    low, high = (np.stack([seen[:, k], parent.strain_range[:, k]]) for k in range(2))
    lowest, highest = np.maximum(low.min(0), limits[:, 0]), np.minimum(high.max(0), limits[:, 1])
    return np.stack([lowest, highest], axis=1)


def strain_range_of(folder: Path, capture: Capture, run: Run) -> np.ndarray | None:
    """The range (F, 2, 3) of a run that has begun in the folder, measured and written where the
    folder has no file yet.

    None where nothing follows strain, and with refined tracking, which moves the meshes while it
    trains. Raises StgaError where the file is damaged, or of another run or mesh.
    """
    if not run.settings.follows_strain or run.settings.tracking:
        return None
    assert run.identity is not None
    path, identity = folder / STRAIN_RANGE, run.identity.digest.encode()
    shape = len(capture.faces), *COLOR_RANGE.shape
    if not path.exists():
        limits = trained_strain_range(capture, capture.mesh, run.continuation)
        arrays = {"strain_range": limits, "identity": np.frombuffer(identity, np.uint8)}
        write_npz(path, arrays, compressed=True)
        return limits
    arrays = read_npz(path)
    found, stored = arrays.get("strain_range"), arrays.get("identity")
    if stored is None or stored.tobytes() != identity:
        raise StgaError(f"{path}: belongs to another run than run.json beside it; remove it")
    if found is None or found.dtype != np.float32 or found.shape != shape:
        other = "no such array" if found is None else f"{found.dtype} {found.shape}"
        raise StgaError(f"{path}: expected 'strain_range', float32 {shape}, found {other}")
    if not _is_color_range(found):
        text = "is not within the range that colors are trained to follow; remove it"
        raise StgaError(f"{path}: 'strain_range' {text}")
    return found


def require_color_range(path: Path, avatar: Avatar) -> None:
    """Raise StgaError, naming the path, where an avatar follows strain beyond COLOR_RANGE.

    An earlier version trained it: more training would change it at once.
    """
    limits = avatar.strain_range
    if avatar.follows_strain and (limits is None or not _is_color_range(limits)):
        raise StgaError(f"{path}: {OLDER_COLORS}")


def _is_color_range(limits: np.ndarray) -> bool:
    """Whether limits (F, 2, 3) lie within COLOR_RANGE; not so where one is NaN."""
    return bool(((limits[:, 0] >= COLOR_RANGE[0]) & (limits[:, 1] <= COLOR_RANGE[1])).all())
