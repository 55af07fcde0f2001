"""Export of an avatar as files that other splat viewers open."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ..errors import StgaError
from ..flame.sequence import FlameSequence
from .embedding import to_world
from .file import Avatar
from .gaussian_avatars import MOTION_NAME, PLY_NAME, write_gaussian_avatars
from .ply import write_ply

FORMATS = ("ply", "ply-sequence", "gaussian-avatars")


def export_avatar(
    path: Path,
    avatar: Avatar,
    format: str,
    meshes: Iterable[tuple[int, np.ndarray]] = (),
    sequence: FlameSequence | None = None,
) -> list[Path]:
    """Write an avatar in one of FORMATS; returns the files written.

    format   "ply": world-space splats on the first of `meshes`, in the file `path`;
             "ply-sequence": one such file a mesh in the folder `path`, named 00000.ply after the mesh's number;
             "gaussian-avatars": point_cloud.ply and flame_param.npz of `sequence` in the folder `path`
    meshes   pairs of a number and a posed mesh (V, 3) meters, taken one at a time
    sequence the FLAME motion, for "gaussian-avatars"
    Raises StgaError where the format needs what is not given, or a file cannot be written.
    """
    if format == "gaussian-avatars":
        if sequence is None:
            raise StgaError(f"{path}: the GaussianAvatars format needs the FLAME parameters of a FLAME capture")
        write_gaussian_avatars(path, avatar, sequence)
        return [path / PLY_NAME, path / MOTION_NAME]
    files = []
    for number, mesh in meshes:
        files.append(path if format == "ply" else path / f"{number:05d}.ply")
        write_ply(files[-1], to_world(avatar.splats, avatar.frames(mesh)))
        if format == "ply":
            break
    if not files:
        raise StgaError(f"{path}: there is no posed mesh to export")
    return files
