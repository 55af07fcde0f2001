"""Which images of a calibration show the same moment, by their names and poses."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from .sources import natural_order

MAX_SHIFT = 0.05
"""Distance that the noise of a calibration moves a camera that stands still, as a fraction of the
median distance of the rig's cameras from their center."""
MAX_TURN_DEG = 3.0
"""Angle that the noise of a calibration turns a camera that stands still."""
MIN_STILL = 0.9
"""Least fraction of a rig's images whose poses agree with that of their camera."""
MIN_LISTED = 0.5
"""Least fraction of the cameras of which a folder of a moment has an image."""
SEPARATORS = re.compile(r"[/_\-. ]+")
"""Marks between the parts of a name."""
OTHER_WORDS = ("mask", "alpha", "matte", "depth", "normal", "seg", "landmark")
"""Words in the names of folders that hold other pictures of the images' names."""


class Moments(NamedTuple):
    """Cameras and moments of images, in their order.

    cameras    name of the camera of each image, where `is_rig`; else the images' names
    timesteps  its moment, numbered from 0 in natural order of the names; all 0 if not `is_rig`
    is_rig     whether cameras that stand still show several moments; otherwise a still scene is
               filmed from one place after the other, or by a camera each: one moment
    """

    cameras: tuple[str, ...]
    timesteps: tuple[int, ...]
    is_rig: bool


def find_moments(names: Sequence[str], poses: Sequence[np.ndarray]) -> Moments:
    """Judge images by their names (paths with forward slashes, without suffix) and poses (4, 4)
    from world to camera.

    They are of a rig if some part of the name (a folder, the file's name, or a part of that) says
    which camera took them, such that the poses of each camera's images agree within the noise of a
    calibration, while cameras differ. Otherwise all show one moment.
    """
    found = [
        split
        for split in _splits(names)
        if _may_be_rig(split) and _stands_still([camera for camera, _ in split], poses)
    ]
    if not found:
        return Moments(tuple(names), (0,) * len(names), False)
    split = min(found, key=lambda each: len({camera for camera, _ in each}))
    order = sorted({moment for _, moment in split}, key=natural_order)
    number = {moment: place for place, moment in enumerate(order)}
    return Moments(
        tuple(camera for camera, _ in split), tuple(number[moment] for _, moment in split), True
    )


_Split = list[tuple[str, str]]
"""(camera, moment) of each name."""


def _splits(names: Sequence[str]) -> Iterator[_Split]:
    """Ways to read names as camera and moment: folder and file, either way, then the parts of
    file names in one folder."""
    paths = [name.rpartition("/") for name in names]
    folders = [folder for folder, _, _ in paths]
    files = [file for _, _, file in paths]
    if len(set(folders)) > 1:
        yield list(zip(folders, files, strict=True))
        yield list(zip(files, folders, strict=True))
        return
    parts = [re.split(r"([_\-. ]+)", file) for file in files]  # every second one a separator
    if len({len(part) for part in parts}) == 1:
        for place in range(1, len(parts[0]), 2):
            first = ["".join(part[:place]) for part in parts]
            second = ["".join(part[place + 1 :]) for part in parts]
            yield list(zip(first, second, strict=True))
            yield list(zip(second, first, strict=True))


def _may_be_rig(split: _Split) -> bool:
    """Whether several cameras have an image each at several moments, most of them at all."""
    cameras = Counter(camera for camera, _ in split)
    moments = Counter(moment for _, moment in split)
    if len(cameras) < 2 or np.median([*cameras.values()]) <= 1 or len(set(split)) < len(split):
        return False
    return len(split) >= MIN_LISTED * len(cameras) * len(moments)


def _stands_still(cameras: Sequence[str], poses: Sequence[np.ndarray]) -> bool:
    """Whether the poses of each camera's images agree, but those of the cameras do not."""
    rotations = np.array([pose[:3, :3] for pose in poses])
    shifts = np.array([pose[:3, 3] for pose in poses])
    places = -np.einsum("nji,nj->ni", rotations, shifts)
    of_camera = np.array(cameras)
    chosen = np.zeros(len(cameras), int)
    for camera in set(cameras):
        rows = np.flatnonzero(of_camera == camera)
        middle = np.median(places[rows], axis=0)
        chosen[rows] = rows[np.linalg.norm(places[rows] - middle, axis=1).argmin()]
    centers = places[np.unique(chosen)]
    extent = float(np.median(np.linalg.norm(centers - centers.mean(axis=0), axis=1)))
    shift = np.linalg.norm(places - places[chosen], axis=1)
    cosine = (np.einsum("nij,nij->n", rotations, rotations[chosen]) - 1) / 2
    turn = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    still = (shift <= MAX_SHIFT * extent) & (turn <= MAX_TURN_DEG)
    return extent > 0 and bool(np.mean(still) >= MIN_STILL)


def central_pose(poses: Sequence[np.ndarray]) -> int:
    """Index of the pose whose camera is nearest to the median place: of a camera that stands
    still, whose calibrations differ by noise."""
    places = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    return int(np.linalg.norm(places - np.median(places, axis=0), axis=1).argmin())


def images_by_camera(
    cameras: Sequence[str], images: Iterable[str]
) -> dict[str, dict[str, str]] | None:
    """Camera -> moment -> name, of images whose names (paths without suffix) hold the camera's
    name in one and the same place; None where there is no such place for all cameras.

    cameras: names of several, such as 222200036 or cam_222200036; images: such as
    frame_00000/cam_222200036 or 00012_cam_222200036. What is left of the name is the moment.
    """
    known = {tuple(filter(None, SEPARATORS.split(camera))): camera for camera in cameras}
    parts = {name: tuple(filter(None, SEPARATORS.split(name))) for name in images}
    lengths = {len(part) for part in known}
    best: dict[str, dict[str, str]] | None = None
    most = 0
    for length in sorted(lengths, reverse=True) if len(lengths) == 1 else ():
        for from_end in (True, False):
            for place in range(max(map(len, parts.values()), default=0)):
                found = _assigned(known, parts, length, place, from_end)
                count = sum(map(len, found.values()))
                if len(found) == len(cameras) and count > most:
                    best = found
                    most = count
    return best


def _assigned(
    known: Mapping[tuple[str, ...], str],
    parts: Mapping[str, tuple[str, ...]],
    length: int,
    place: int,
    from_end: bool,
) -> dict[str, dict[str, str]]:
    """`images_by_camera`, with camera names of `length` parts at one place, from either end."""
    kinds: dict[str, dict[str, dict[str, str]]] = {}
    for name, part in parts.items():
        start = len(part) - length - place if from_end else place
        camera = known.get(part[start : start + length]) if start >= 0 else None
        if camera is not None:
            moment = "_".join((*part[:start], *part[start + length :]))
            kind = re.sub(r"\d+", "#", moment, flags=re.ASCII)
            kinds.setdefault(kind, {}).setdefault(camera, {}).setdefault(moment, name)
    return max(kinds.values(), key=_likeliness, default={})


def _likeliness(found: dict[str, dict[str, str]]) -> tuple[int, bool, int]:
    """Sort key of folders of images and masks with the same names: most cameras first, then folders
    that are not called masks, then the most images."""
    moments = [moment.lower() for images in found.values() for moment in images]
    is_other = any(word in moments[0] for word in OTHER_WORDS)
    return len(found), not is_other, len(moments)
