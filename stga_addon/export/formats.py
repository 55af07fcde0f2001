"""Export of an avatar as files that other viewers and tools open."""

import shutil
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..avatar.embedding import to_world
from ..avatar.file import Avatar
from ..avatar.splats import Splats
from ..errors import StgaError
from ..flame.sequence import FlameSequence
from ..format import format_bytes
from .gaussian_avatars import MOTION_NAME, PLY_NAME, write_gaussian_avatars
from .gltf import write_gltf
from .playback import DEFAULT_FPS, Playback
from .ply import PROPERTIES, write_ply
from .spz import write_spz
from .usd import usd_bytes, write_usd
from .web.write import web_bytes, write_web

Meshes = Iterable[tuple[int, np.ndarray]]
"""Pairs of a number and a posed mesh (V, 3) meters."""


@dataclass(frozen=True)
class Format:
    """What `export_avatar` writes: its name in menus, what it is for, and what it is made of.

    suffixes  of the file, the usual one first; none: a folder
    source    "frame": the avatar on one posed mesh; "range": on several; "motion": the avatar and its FLAME parameters
    has_rate  whether it records how many frames play in a second
    """

    label: str
    description: str
    suffixes: tuple[str, ...]
    source: str
    has_rate: bool = False


FORMATS = {
    "ply": Format("PLY", "The current frame in world space, for any 3D Gaussian Splatting viewer", (".ply",), "frame"),
    "ply-sequence": Format("PLY Sequence", "One PLY in world space for each frame of the scene", (), "range"),
    "gaussian-avatars": Format(
        "GaussianAvatars", "The frames of the scene as point_cloud.ply and flame_param.npz; FLAME heads", (), "motion"
    ),
    "usd": Format("USD", "The frames of the scene as an animated particle field", (".usdc", ".usdz"), "range", True),
    "web": Format(
        "Web Page",
        "The frames of the scene as a page that plays them, or as data for a server",
        (".html", ".stga"),
        "range",
        True,
    ),
    "gltf": Format("glTF", "The current frame, for viewers with KHR_gaussian_splatting", (".glb",), "frame"),
    "spz": Format("SPZ", "The current frame compressed, a tenth of a PLY's size", (".spz",), "frame"),
}


def export_avatar(
    path: Path,
    avatar: Avatar,
    format: str,
    meshes: Meshes = (),
    sequence: FlameSequence | None = None,
    fps: float = DEFAULT_FPS,
    playback: Playback | None = None,
) -> list[Path]:
    """Write an avatar in one of FORMATS; returns the files written.

    path     the file, or the folder of "ply-sequence" (one 00012.ply a mesh, named after its number) and
             "gaussian-avatars" (point_cloud.ply and flame_param.npz)
    meshes   taken one at a time; a "frame" takes the first
    sequence the FLAME motion, for "gaussian-avatars"; for "web", where its rig is to go along
    fps      meshes per second
    playback what else a "web" page shows, and its meshes per second
    Raises StgaError where the suffix is another, the format needs what is not given, or a file cannot be written.
    """
    check_suffix(path, format)
    if format == "gaussian-avatars":
        if sequence is None:
            raise StgaError(f"{path}: the GaussianAvatars format needs the FLAME parameters of a FLAME capture")
        write_gaussian_avatars(path, avatar, sequence)
        return [path / PLY_NAME, path / MOTION_NAME]
    if format == "web":
        return write_web(path, avatar, playback or Playback(fps=fps), (mesh for _, mesh in meshes), sequence)
    frames = _world_frames(path, avatar, meshes)
    match format:
        case "usd":
            write_usd(path, frames, fps, _has_moving_color(avatar))
        case "ply-sequence":
            return [_write_numbered_ply(path, number, world) for number, world in frames]
        case "ply":
            write_ply(path, next(frames)[1])
        case "gltf":
            write_gltf(path, next(frames)[1])
        case "spz":
            write_spz(path, next(frames)[1], avatar.antialiased)
    return [path]


def check_suffix(path: Path, format: str) -> None:
    """Raise StgaError where the path does not end as a file of the format does."""
    suffixes = FORMATS[format].suffixes
    if suffixes and path.suffix.lower() not in suffixes:
        raise StgaError(f"{path}: expected a name that ends in {' or '.join(suffixes)}")


def range_bytes(avatar: Avatar, format: str, frames: int) -> int:
    """Size of the files that a range of frames takes in a format of the source "range"."""
    if format == "usd":
        return usd_bytes(avatar.splats, frames, _has_moving_color(avatar))
    if format == "web":
        return web_bytes(avatar)
    return 4 * len(PROPERTIES) * len(avatar.splats) * frames


def check_free_space(path: Path, size: int) -> None:
    """Raise StgaError where the disk that `path` is to be written to has less than `size` bytes free."""
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    free = shutil.disk_usage(folder).free
    if size > free:
        raise StgaError(
            f"{path}: needs {format_bytes(size)}, but {format_bytes(free)} are free there; choose fewer frames"
        )


def _world_frames(path: Path, avatar: Avatar, meshes: Meshes) -> Iterator[tuple[int, Splats]]:
    """The avatar's splats on each mesh. Raises StgaError where there is no mesh or no splat."""
    if not len(avatar.splats):
        raise StgaError(f"{path}: the avatar has no splats to export")
    number = None
    for number, mesh in meshes:
        yield number, to_world(avatar.splats, avatar.frames(mesh))
    if number is None:
        raise StgaError(f"{path}: there is no posed mesh to export")


def _has_moving_color(avatar: Avatar) -> bool:
    return avatar.splats.strain_color.shape[1] > 0


def _write_numbered_ply(folder: Path, number: int, world: Splats) -> Path:
    path = folder / f"{number:05d}.ply"
    write_ply(path, world)
    return path
