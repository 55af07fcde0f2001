"""Files of footage in a folder: an image, a folder of images or a video for each camera."""

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from ...errors import StgaError, shorten

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".m4v", ".webm", ".mts", ".mxf")
CONTAINERS = ("images", "frames", "videos", "input")
"""Folders that gather those of the cameras; their names are no part of a camera's."""
MASK_FOLDERS = ("masks", "fg_masks")
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
    """

    root: Path
    images: dict[str, list[Path]] = field(default_factory=dict)
    folders: dict[str, list[Path]] = field(default_factory=dict)
    videos: dict[str, list[Path]] = field(default_factory=dict)
    masks: dict[str, list[Path]] = field(default_factory=dict)
    plates: dict[str, Path] = field(default_factory=dict)

    def name_of(self, path: Path) -> str:
        """Path below the footage, without suffix and without a leading "images/" and the like."""
        return _without_container(path.relative_to(self.root).with_suffix("").as_posix())

    def mask_of(self, image: Path) -> Path | None:
        """The mask with the same path below one of `MASK_FOLDERS`."""
        key = self.name_of(image)
        name = _without_container(image.relative_to(self.root).as_posix())
        return next(iter(self.masks.get(key) or self.masks.get(name, [])), None)


def find_sources(root: Path) -> Sources:
    """List the visible files, four levels deep. Raises StgaError for over a million files, OSError
    for a folder that cannot be listed."""
    sources = Sources(root)
    count = 0

    def refuse(error: OSError) -> None:
        raise error

    for folder, names, files in os.walk(root, onerror=refuse):
        depth = len(Path(folder).relative_to(root).parts)
        names[:] = sorted(name for name in names if not name.startswith(".") and depth < MAX_DEPTH)
        count += len(files)
        if count > MAX_FILES:
            many = f"more than {MAX_FILES} files; expected a folder of footage"
            raise StgaError(f"{root}: holds {many}")
        visible = (name for name in files if not name.startswith("."))
        for path in (Path(folder, name) for name in sorted(visible, key=natural_order)):
            key = sources.name_of(path)
            suffix = path.suffix.lower()
            first, _, rest = path.relative_to(root).as_posix().partition("/")
            name = rest.rpartition(".")[0]
            if suffix in VIDEO_SUFFIXES:
                sources.videos.setdefault(key, []).append(path)
            elif suffix not in IMAGE_SUFFIXES:
                continue
            elif first in MASK_FOLDERS:
                sources.masks.setdefault(_without_container(name), []).append(path)
            elif first == PLATE_FOLDER:
                sources.plates.setdefault(name, path)
            else:
                sources.images.setdefault(key, []).append(path)
                sources.folders.setdefault(key.rpartition("/")[0], []).append(path)
    return sources


def sequence_names(sources: Sources, labels: Iterable[str]) -> list[str | None]:
    """For each label, the name of its camera's folder or video; None where it has neither. The name
    is the label, with or without suffix and leading folders; or the folder of the image that the
    camera was calibrated with, where no other camera's lies there."""
    labels = list(labels)
    parents = [_stem(label).rpartition("/")[0] for label in labels]
    found = []
    for label, parent in zip(labels, parents, strict=True):
        names = _tails(label)
        if parent and parents.count(parent) == 1:
            names += _tails(parent)
        known = (n for n in names if n in sources.videos or (n and n in sources.folders))
        found.append(next(known, None))
    return found


def still_image(sources: Sources, label: str, where: str) -> Path:
    """The image of that name. Raises StgaError where there is none, or more than one."""
    found = next((sources.images[name] for name in _tails(label) if name in sources.images), [])
    if not found:
        missing = f"no image, folder or video of the name {shorten(label)}"
        raise StgaError(f"{where}: {sources.root} has {missing}")
    if len(found) > 1:
        both = f"{found[0]} and {found[1]} are both named {shorten(label)}"
        raise StgaError(f"{where}: {both}; expected one")
    return found[0]


def sequence_files(sources: Sources, name: str) -> Path | list[Path]:
    """The video of a camera, or its images in order. Raises StgaError for both, or two videos."""
    videos = sources.videos.get(name, [])
    images = sources.folders.get(name, [])
    if len(videos) > 1 or (videos and images):
        other = videos[1] if len(videos) > 1 else images[0].parent
        both = f"{videos[0]} and {other} are both named {shorten(name)}"
        raise StgaError(f"{both}; expected one video or folder a camera")
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


def _stem(label: str) -> str:
    """The label without the suffix of an image or video, with forward slashes."""
    path = PurePosixPath(label.replace("\\", "/"))
    known = path.suffix.lower() in (*IMAGE_SUFFIXES, *VIDEO_SUFFIXES)
    return (path.with_suffix("") if known else path).as_posix()


def _tails(label: str) -> list[str]:
    """The label without suffix, then without its first folder, its second, …; none deeper than
    footage is searched."""
    parts = [part for part in _stem(label).split("/") if part not in ("", ".")][-MAX_DEPTH - 1 :]
    return ["/".join(parts[start:]) for start in range(len(parts))]
