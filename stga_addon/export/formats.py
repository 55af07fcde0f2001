"""Export formats: a table of their writers, and export of an avatar in one of them."""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..avatar.embedding import to_world
from ..avatar.file import Avatar
from ..avatar.offsets import COLOR, OFFSETS
from ..avatar.splats import Splats, at_degree
from ..errors import StgaError
from ..flame.sequence import FlameSequence
from ..format import format_bytes
from .gltf import write_gltf
from .playback import Playback, check_rate
from .ply import SplatFrames, ply_bytes, write_gaussian_avatars, write_ply, write_ply_sequence
from .rig import Meshes, RiggedAvatar, rigged_avatar
from .skinned_gltf import write_skinned_gltf
from .spz import write_spz
from .usd import usd_bytes, write_usd
from .web.page import web_bytes, write_web


@dataclass(frozen=True)
class Content:
    """An avatar to be exported; `meshes` and `sequence` as `export_avatar` takes them.

    python  the interpreter that writes what this one lacks packages for (`write_usd`); "": none
    """

    avatar: Avatar
    meshes: Meshes = ()
    sequence: FlameSequence | None = None
    playback: Playback = field(default_factory=Playback)
    python: str = ""

    def frames(self, path: Path) -> Iterator[tuple[int, Splats]]:
        """The splats in world space on each mesh, with its number. Raises StgaError naming `path`
        where there is no mesh or no splat."""
        if not len(self.avatar.splats):
            raise StgaError(f"{path}: the avatar has no splats to export")
        number = None
        for number, mesh in self.meshes:
            yield number, to_world(self.avatar.splats, self.avatar.frames(mesh))
        if number is None:
            raise StgaError(f"{path}: there is no posed mesh")

    def first_frame(self, path: Path) -> Splats:
        """The splats in world space on the first mesh. Raises StgaError as `frames`."""
        return next(self.frames(path))[1]

    @property
    def for_linear_light(self) -> "Content":
        return replace(self, avatar=self.avatar.for_linear_light)

    @property
    def splats(self) -> Splats:
        return self.avatar.splats

    @property
    def antialiased(self) -> bool:
        return self.avatar.antialiased

    @property
    def moving_color(self) -> bool:
        """Whether the harmonics differ between frames by little."""
        return any(OFFSETS[name].target == COLOR for name in self.avatar.driven_offsets)

    def rigged(self, path: Path) -> RiggedAvatar:
        """The avatar with what moves it. Raises StgaError naming `path` where there is no pose."""
        motion_only = self.playback.motion_only
        controls = self.playback.controls
        try:
            return rigged_avatar(self.avatar, self.meshes, self.sequence, motion_only, controls)
        except ValueError as error:
            raise StgaError(f"{path}: the avatar cannot be exported ({error})") from error


@dataclass(frozen=True)
class WorldContent:
    """Any splats to be exported, in world space: numbered frames of them, whose number, order and
    values may differ, and how they play. Harmonics are of the degree of the first frame. python: as
    of `Content`."""

    numbered: SplatFrames
    playback: Playback
    python: str = ""
    antialiased: bool = False
    moving_color: bool = False

    def frames(self, path: Path) -> Iterator[tuple[int, Splats]]:
        """Pairs as of `numbered`."""
        degree = None
        for number, splats in self.numbered:
            degree = splats.sh_degree if degree is None else degree
            yield number, at_degree(splats, degree)

    def first_frame(self, path: Path) -> Splats:
        """The splats of the first frame."""
        return next(self.frames(path))[1]

    @property
    def for_linear_light(self) -> "WorldContent":
        return self


@dataclass(frozen=True)
class Format:
    """A row of FORMATS: what menus and the command line need to know of a format, and its writer.

    label, description  in menus
    suffixes  of the file, the standard one first; none: a folder
    source    "frame": the avatar on one posed mesh; "range": on several; "motion": the avatar and
              its FLAME parameters
    write     writes a `Content`, of splats without a rig also a `WorldContent`, to a path: returns
              the files, None where that is the path alone
    size      bytes that a number of frames of it take, about; of a "range"
    has_rate  whether it records how many frames play in a second
    has_rig   whether it takes the avatar with its rig (`Content.rigged`), and what else `Playback`
              holds; the source is a "range"
    """

    label: str
    description: str
    suffixes: tuple[str, ...]
    source: str
    write: Callable[[Path, Any], list[Path] | None]
    size: Callable[[Any, int], int] = lambda item, frames: frames * ply_bytes(item.splats)
    has_rate: bool = False
    has_rig: bool = False


FORMATS: dict[str, Format] = {
    "ply": Format(
        "PLY",
        "The current frame in world space, for any 3D Gaussian Splatting viewer",
        (".ply",),
        "frame",
        lambda path, item: write_ply(path, item.first_frame(path)),
    ),
    "ply-sequence": Format(
        "PLY Sequence",
        "One PLY in world space for each frame of the scene",
        (),
        "range",
        lambda path, item: write_ply_sequence(path, item.frames(path)),
    ),
    "gaussian-avatars": Format(
        "GaussianAvatars",
        "The frames of the scene as point_cloud.ply and flame_param.npz; FLAME heads",
        (),
        "motion",
        lambda path, item: write_gaussian_avatars(path, item.avatar, item.sequence),
    ),
    "usd": Format(
        "USD",
        "The frames of the scene as an animated particle field",
        (".usdc", ".usdz"),
        "range",
        lambda path, item: write_usd(
            path,
            item.for_linear_light.frames(path),
            item.playback.fps,
            item.moving_color,
            item.python,
        ),
        lambda item, frames: usd_bytes(item.splats, frames, item.moving_color),
        has_rate=True,
    ),
    "web": Format(
        "Web Page",
        "The frames of the scene as a page that plays them, or as glTF and the player for a server",
        (".html", ".glb"),
        "range",
        lambda path, item: write_web(path, item.rigged(path), item.playback),
        lambda item, frames: web_bytes(item.avatar),
        has_rate=True,
        has_rig=True,
    ),
    "skinned-gltf": Format(
        "Skinned glTF",
        "The head with bones, sliders, splats and the frames of the scene; elsewhere a plain mesh",
        (".glb",),
        "range",
        lambda path, item: write_skinned_gltf(path, item.rigged(path), item.playback),
        lambda item, frames: web_bytes(item.avatar),
        has_rate=True,
        has_rig=True,
    ),
    "gltf": Format(
        "glTF",
        "The current frame, for viewers with KHR_gaussian_splatting",
        (".glb",),
        "frame",
        lambda path, item: write_gltf(path, item.first_frame(path)),
    ),
    "spz": Format(
        "SPZ",
        "The current frame compressed, a tenth of a PLY's size",
        (".spz",),
        "frame",
        lambda path, item: write_spz(path, item.first_frame(path), item.antialiased),
    ),
}
"""Name on the command line -> format."""


SPLAT_FORMATS = {
    name: format
    for name, format in FORMATS.items()
    if format.source in ("frame", "range") and not format.has_rig
}
"""Those that hold splats alone."""


def export_avatar(
    path: Path,
    avatar: Avatar,
    format: str,
    meshes: Meshes = (),
    sequence: FlameSequence | None = None,
    playback: Playback | None = None,
) -> list[Path]:
    """Write an avatar in one of FORMATS, all of its files or none; returns the files written.

    path     the file, or the folder of "ply-sequence" (one 00012.ply a mesh, named after its
             number; an earlier sequence there is replaced as a whole) and "gaussian-avatars"
             (point_cloud.ply and flame_param.npz)
    meshes   taken one at a time; a "frame" takes the first
    sequence the FLAME motion, for "gaussian-avatars", and where its rig is to go along (`has_rig`)
    playback meshes per second, and what else a format with a rig shows
    Raises StgaError where the suffix is another, the format needs what is not given or has no such
    frame rate, or a file cannot be written.
    """
    playback = playback or Playback()
    return write_content(path, format, Content(avatar, meshes, sequence, playback))


def write_content(path: Path, format: str, content: Content | WorldContent) -> list[Path]:
    """What `export_avatar` does, of what is not an avatar too: in one of SPLAT_FORMATS."""
    check_suffix(path, format)
    if FORMATS[format].has_rate:
        check_rate(path, content.playback.fps)
    return FORMATS[format].write(path, content) or [path]


def check_suffix(path: Path, format: str) -> None:
    """Raise StgaError where the path does not end as a file of the format does."""
    suffixes = FORMATS[format].suffixes
    if suffixes and path.suffix.lower() not in suffixes:
        raise StgaError(f"{path}: expected a name that ends in {' or '.join(suffixes)}")


def check_free_space(path: Path, size: int) -> None:
    """Raise StgaError where the disk that `path` is on has less than `size` bytes free."""
    place = path.absolute()
    folder = next(each for each in (place, *place.parents) if each.is_dir())
    free = shutil.disk_usage(folder).free
    if size > free:
        needed = format_bytes(size)
        found = format_bytes(free)
        raise StgaError(f"{path}: needs {needed}, but {found} are free there; choose fewer frames")
