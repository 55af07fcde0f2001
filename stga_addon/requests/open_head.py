"""Running a CLI command on the open .blend file: its head as a folder that another Python reads."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..capture.model import Capture
from ..capture.open import open_capture
from ..capture.transforms import PRINCIPAL_POINTS
from ..errors import StgaError, shorten
from ..files import read_json, read_npz, write_json, write_npz

FOLDER = "STGA_HEAD"
"""The environment variable that names the folder."""
HEAD, SELECTION, PLAYED = "head.json", "selection.npz", "played.npz"


@dataclass(frozen=True)
class OpenHead:
    """The head of the .blend file that Blender has open: what a command works on where nothing is named.

    fps        frames per second of the scene
    selection  what the file's vertex groups train, timestep -> (F,) bool; None without any
    played     the capture -> the same with the scene's frames: its meshes are the head's, however it is animated
    """

    capture: Path
    flame: Path | None
    principal_point: str
    avatar: Path | None
    fps: float
    selection: Callable[[], Mapping[int, np.ndarray] | None]
    played: Callable[[Capture], Capture]


def write_head(folder: Path, head: OpenHead, played: bool) -> None:
    """Write the head into the folder; `played`: with the meshes that it plays in the scene's frames.

    Raises StgaError where the capture cannot be read, or the folder not be written.
    """
    paths = {"capture": head.capture, "flame": head.flame, "avatar": head.avatar}
    values = {name: None if path is None else str(path) for name, path in paths.items()}
    write_json(folder / HEAD, {**values, "principal_point": head.principal_point, "fps": head.fps})
    selection = head.selection()
    if selection is not None:
        write_npz(folder / SELECTION, {str(timestep): faces for timestep, faces in selection.items()})
    if played:
        capture = head.played(open_capture(head.capture, head.flame, head.principal_point))
        write_npz(folder / PLAYED, {str(timestep): capture.mesh(timestep) for timestep in capture.timesteps})


def read_head(folder: Path) -> OpenHead:
    """The head that `write_head` wrote. Raises StgaError where there is none or it is damaged."""
    path = folder / HEAD
    values = read_json(path)
    if not isinstance(values, dict) or values.get("principal_point") not in PRINCIPAL_POINTS:
        raise StgaError(f"{path}: is not the head of an open .blend file (principal_point is missing)")
    if not isinstance(values.get("fps"), float) or not 0 < values["fps"] < math.inf:
        raise StgaError(f"{path}: fps is {shorten(values.get('fps'))}, expected a number above 0")
    for name, needed in (("capture", True), ("flame", False), ("avatar", False)):
        value = values.get(name)
        if not isinstance(value, str) and (needed or value is not None):
            raise StgaError(f"{path}: {name} is {shorten(value)}, expected a path")
    flame, avatar = (Path(values[name]) if values.get(name) else None for name in ("flame", "avatar"))

    def selection() -> dict[int, np.ndarray] | None:
        return _by_timestep(folder / SELECTION) if (folder / SELECTION).exists() else None

    def played(capture: Capture) -> Capture:
        meshes = _by_timestep(folder / PLAYED)
        return replace(capture, timesteps=tuple(sorted(meshes)), mesh=meshes.__getitem__, flame=None)

    return OpenHead(Path(values["capture"]), flame, values["principal_point"], avatar, values["fps"], selection, played)


def _by_timestep(path: Path) -> dict[int, np.ndarray]:
    return {int(name): array for name, array in read_npz(path).items()}
