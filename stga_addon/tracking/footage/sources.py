"""Files of footage in a folder: an image, a folder of images or a video for each camera."""

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path, PurePosixPath

from ...capture.transforms import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from ...errors import StgaError, shorten

UNREAD_SUFFIXES = (
    *(".heic", ".heif", ".avif", ".jxl", ".jp2", ".tga", ".exr", ".hdr", ".psd", ".dng", ".cr2"),
    *(".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf", ".braw", ".r3d", ".ari", ".crm"),
)
"""Suffixes of pictures and videos that are not read."""
CONTAINERS = ("images", "frames", "videos", "input")
"""Folders that gather those of the cameras; their names are no part of a camera's. Of pictures of
the same names in several, the first are used."""
ORIGINALS = "input"
"""Container of the images before undistortion, by 3DGS's convert.py."""
MASK_FOLDERS = ("masks", "fg_masks", "alpha_map", "alpha_maps")
"""Folders of masks at the top of the footage, or beside the folders of images, as NeRSemble has one
in each timestep's folder; a frame rate may follow (alpha_map-73fps)."""

PLATE_FOLDER = "plates"  # Holds an image without the person for each camera, of its name
MAX_DEPTH = 4
MAX_FILES = 1_000_000


def is_video(path: Path) -> bool:
    """Whether a path has the name of a video file."""
    return path.suffix.lower() in VIDEO_SUFFIXES


@dataclass
class Sources:
    """Files of a footage folder, by path below it without suffix and without a leading "images/"
    and the like.

    images   "cam01/0001" -> files
    folders  "cam01" -> its images, in natural order; "" for those that lie at the top
    videos   "cam01" -> files
    plates   "cam01" -> file
    masks    as `images`; COLMAP's names ("0001.jpg.png") are "0001.jpg"
    files    all images and videos, also those of the same names as others, which are not used
    unread   pictures and videos in formats that are not read
    """

    root: Path
    images: dict[str, list[Path]] = field(default_factory=dict)
    folders: dict[str, list[Path]] = field(default_factory=dict)
    videos: dict[str, list[Path]] = field(default_factory=dict)
    masks: dict[str, list[Path]] = field(default_factory=dict)
    plates: dict[str, Path] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    unread: list[Path] = field(default_factory=list)

    @cached_property
    def images_by_name(self) -> dict[str, list[Path]]:
        """Images by their names without folders and suffix."""
        named: dict[str, list[Path]] = {}
        for path in chain.from_iterable(self.images.values()):
            named.setdefault(path.stem, []).append(path)
        return named

    def name_of(self, path: Path) -> str:
        """Path below the footage, without suffix and without a leading "images/" and the like."""
        return _without_container(path.relative_to(self.root).with_suffix("").as_posix())

    def mask_of(self, image: Path) -> Path | None:
        """The mask with the same path below one of `MASK_FOLDERS`, or beside the image's folder."""
        key = self.name_of(image)
        name = _without_container(image.relative_to(self.root).as_posix())
        folders = key.split("/")[:-2]
        beside = "/".join([*folders, image.stem]) if folders else ""
        found = (self.masks[each] for each in (key, name, beside) if each in self.masks)
        return next((files[0] for files in found), None)


def find_sources(root: Path, containers: Sequence[str] = CONTAINERS) -> Sources:
    """List the visible files, four levels deep. containers: which images are used where several of
    them hold images of the same names. Raises StgaError for over a million files, OSError for a
    folder that cannot be listed."""
    sources = Sources(root)
    count = 0
    folders: dict[str, dict[str, list[Path]]] = {}

    def refuse(error: OSError) -> None:
        raise error

    for folder, names, files in os.walk(root, onerror=refuse):
        depth = len(Path(folder).relative_to(root).parts)
        names[:] = sorted(name for name in names if not name.startswith(".") and depth < MAX_DEPTH)
        count += len(files)
        if count > MAX_FILES:
            raise StgaError(
                f"{root}: holds more than {MAX_FILES} files; expected a folder of footage"
            )
        visible = (name for name in files if not name.startswith("."))
        for path in (Path(folder, name) for name in sorted(visible, key=natural_order)):
            key = sources.name_of(path)
            suffix = path.suffix.lower()
            parts = path.relative_to(root).parts
            first = parts[0] if len(parts) > 1 else ""
            mask_folder = next(filter(_is_mask_folder, parts[:-1]), None)
            if suffix in VIDEO_SUFFIXES:
                sources.videos.setdefault(key, []).append(path)
                sources.files.append(path)
            elif suffix in UNREAD_SUFFIXES:
                sources.unread.append(path)
            elif suffix not in IMAGE_SUFFIXES:
                continue
            elif mask_folder is not None:
                rest = [part for part in parts[:-1] if part != mask_folder]
                name = "/".join((*rest, path.stem))
                sources.masks.setdefault(_without_container(name), []).append(path)
            elif first == PLATE_FOLDER:
                sources.plates.setdefault("/".join((*parts[1:-1], path.stem)), path)
            else:
                by_container = folders.setdefault(key.rpartition("/")[0], {})
                by_container.setdefault(first if first in CONTAINERS else "", []).append(path)
                sources.files.append(path)
    for name, contained in folders.items():
        for path in _without_copies(contained, containers):
            sources.images.setdefault(sources.name_of(path), []).append(path)
            sources.folders.setdefault(name, []).append(path)
    _name_by_folder(sources)
    return sources


def _is_mask_folder(name: str) -> bool:
    return re.sub(r"-[\d.]+fps$", "", name) in MASK_FOLDERS


def _name_by_folder(sources: Sources) -> None:
    """Name videos after their folders, where several cameras have a folder each with one video, and
    with one image at most, from which the camera was calibrated."""
    folders = {name: name.rpartition("/")[0] for name in sources.videos}
    if len(folders) < 2 or "" in folders.values() or len(set(folders.values())) < len(folders):
        return
    images = [sources.folders.get(folder, []) for folder in folders.values()]
    if any(len(image) > 1 for image in images) or not set(folders.values()).isdisjoint(
        sources.videos
    ):
        return
    for folder in folders.values():
        sources.folders.pop(folder, None)
    sources.videos = {folders[name]: files for name, files in sources.videos.items()}


def _without_copies(parts: Mapping[str, list[Path]], containers: Sequence[str]) -> list[Path]:
    """The images of a folder, by container, without containers that hold the same names as one
    before them."""
    used = {""}
    known = set[str]()
    for container in containers:
        names = {path.stem for path in parts.get(container, ())}
        if known.isdisjoint(names):
            used.add(container)
            known |= names
    return [path for container, paths in parts.items() if container in used for path in paths]


def sequence_names(sources: Sources, labels: Iterable[str]) -> list[str | None]:
    """For each label, the name of its camera's folder or video; None where it has neither. The name
    is the label, with or without suffix and leading folders; or the folder of the image that the
    camera was calibrated with, where no other camera's lies there."""
    labels = list(labels)
    parents = [stem_of(label).rpartition("/")[0] for label in labels]
    found = []
    for label, parent in zip(labels, parents, strict=True):
        names = _tails(label)
        if parent and parents.count(parent) == 1:
            names += _tails(parent)
        known = (n for n in names if n in sources.videos or (n and n in sources.folders))
        found.append(next(known, None))
    return found


def calibration_images(sources: Sources, label: str) -> list[Path]:
    """The images of a label, with which the camera of a recording was calibrated."""
    return next((sources.images[name] for name in _tails(label) if name in sources.images), [])


def images_of(sources: Sources, label: str) -> list[Path]:
    """The images of that name: in that folder, else in any."""
    tails = _tails(label)
    found = calibration_images(sources, label)
    return found or (sources.images_by_name.get(tails[-1], []) if tails else [])


def still_image(sources: Sources, label: str, where: str) -> Path:
    """The image of that name, in that folder or, where only one has it, in another. Raises
    StgaError where there is none, or more than one."""
    found = images_of(sources, label)
    if not found:
        raise StgaError(
            f"{where}: {sources.root} has no image, folder or video of the name {shorten(label)}"
        )
    if len(found) > 1:
        raise StgaError(
            f"{where}: {found[0]} and {found[1]} are both named {shorten(label)}; expected one"
        )
    return found[0]


def sequence_files(sources: Sources, name: str) -> Path | list[Path]:
    """The video of a camera, or its images in order. Raises StgaError for both, or two videos."""
    videos = sources.videos.get(name, [])
    images = sources.folders.get(name, [])
    if len(videos) > 1 or (videos and images):
        other = videos[1] if len(videos) > 1 else images[0].parent
        raise StgaError(
            f"{videos[0]} and {other} are both named {shorten(name)}; expected one video or "
            "folder a camera"
        )
    return videos[0] if videos else images


def natural_order(name: str) -> list[tuple[int, str]]:
    """Sort key by which 2 comes before 10."""
    parts = re.split(r"([0-9]+)", name)  # every second one a number, of any length
    digits = [part.lstrip("0") for part in parts]
    return [(len(digits[n]), digits[n]) if n % 2 else (0, parts[n]) for n in range(len(parts))]


def frame_number(path: Path) -> int | None:
    """The last number in a file's name."""
    found = re.findall(r"\d+", path.stem)
    return int(found[-1]) if found else None


def _without_container(path: str) -> str:
    first, separator, rest = path.partition("/")
    return rest if separator and first in CONTAINERS else path


def stem_of(label: str) -> str:
    """The label without the suffix of an image or video, with forward slashes."""
    path = PurePosixPath(label.replace("\\", "/"))
    known = path.suffix.lower() in (*IMAGE_SUFFIXES, *VIDEO_SUFFIXES)
    return (path.with_suffix("") if known else path).as_posix()


def _tails(label: str) -> list[str]:
    """The label without suffix, then without its first folder, its second, …; none deeper than
    footage is searched."""
    parts = [part for part in stem_of(label).split("/") if part not in ("", ".")][-MAX_DEPTH - 1 :]
    return ["/".join(parts[start:]) for start in range(len(parts))]
