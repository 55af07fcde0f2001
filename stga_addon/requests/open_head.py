"""Running a CLI command on the open .blend file: its head as a folder that another Python reads."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..capture.transforms import PRINCIPAL_POINTS
from ..errors import StgaError, shorten
from ..files import read_json, read_npz, write_json, write_npz
from ..schema import from_json, setting, to_json
from .values import Played

FOLDER = "STGA_HEAD"
"""The environment variable that names the folder."""
HEAD, SELECTION, PLAYED = "head.json", "selection.npz", "played.npz"


@dataclass(frozen=True)
class OpenHead:
    """The head of the .blend file that Blender has open: what a command works on where nothing is named.

    fps        frames per second of the scene
    selection  what the file's vertex groups train, timestep -> (F,) bool; None without any
    played     what the head plays in the scene's frames
    """

    capture: Path
    flame: Path | None
    principal_point: str
    avatar: Path | None
    fps: float
    selection: Callable[[], Mapping[int, np.ndarray] | None]
    played: Callable[[], Played]


@dataclass(frozen=True)
class _Stored:
    """What head.json holds; fields as of `OpenHead`."""

    capture: Path
    flame: Path | None
    avatar: Path | None
    principal_point: str = setting(choices=PRINCIPAL_POINTS)
    fps: float = setting(above=0)


def write_head(folder: Path, head: OpenHead, played: bool) -> None:
    """Write the head into the folder; `played`: with the meshes that it plays in the scene's frames.

    Raises StgaError where the capture cannot be read, or the folder not be written.
    """
    write_json(folder / HEAD, to_json(_Stored(head.capture, head.flame, head.avatar, head.principal_point, head.fps)))
    selection = head.selection()
    if selection is not None:
        write_npz(folder / SELECTION, {str(timestep): faces for timestep, faces in selection.items()})
    if played:
        write_npz(folder / PLAYED, {str(frame): mesh for frame, mesh in head.played().meshes.items()})


def read_head(folder: Path) -> OpenHead:
    """The head that `write_head` wrote. Raises StgaError where there is none or it is damaged."""
    path = folder / HEAD
    try:
        stored: _Stored = from_json(_Stored, read_json(path))
    except StgaError as error:
        raise StgaError(f"{path}: is not the head of an open .blend file ({error})") from error

    def selection() -> dict[int, np.ndarray] | None:
        return _read_selection(folder / SELECTION) if (folder / SELECTION).exists() else None

    def played() -> Played:
        return Played(_by_frame(folder / PLAYED), selection=selection())

    return OpenHead(
        stored.capture, stored.flame, stored.principal_point, stored.avatar, stored.fps, selection, played
    )  # fmt: skip


def _read_selection(path: Path) -> dict[int, np.ndarray]:
    """frame -> (F,) bool. Raises StgaError for arrays of another form."""
    selection = _by_frame(path)
    for frame, faces in selection.items():
        if faces.dtype != bool or faces.ndim != 1:
            raise StgaError(f"{path}: frame {frame}: expected bool (F,), got {faces.dtype} {faces.shape}")
    return selection


def _by_frame(path: Path) -> dict[int, np.ndarray]:
    """Arrays by the frames that their names are. Raises StgaError for a name that is none."""
    arrays = read_npz(path)
    for name in arrays:
        if not re.fullmatch(r"-?\d{1,9}", name, re.ASCII):
            raise StgaError(f"{path}: expected frames as names, got {shorten(name)}")
    return {int(name): array for name, array in arrays.items()}
