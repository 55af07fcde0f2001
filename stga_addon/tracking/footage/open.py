"""Opening footage: a calibration and the frames of its cameras."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from os.path import isdir, isfile, realpath
from pathlib import Path

import numpy as np

from ...capture.camera import Camera, camera_from_gl
from ...capture.images import image_size
from ...capture.model import View
from ...errors import StgaError
from . import video
from .calibrations import EXPECTED, find_calibration, read_calibration
from .clocks import clock_offsets
from .file_types import is_video
from .focal_tags import photo_focal, video_focal
from .given_masks import with_masks
from .image_frames import ImageFrames
from .lens import Lens
from .model import Footage, FootageCamera, Frames
from .sequences import (
    FrameRange,
    Sequence,
    frames_per_second,
    open_sequence,
    recorded_size,
    sequence_size,
    synchronized,
)
from .shots import Shot
from .sources import Sources, find_sources, sequence_files, sequence_names, still_image
from .undistort import undistortion

ALL_FRAMES = FrameRange()
USUAL_VIEW_DEG = 65.0
"""Angle of view of an unknown camera over the image's diagonal: that of a phone."""


def open_footage(
    path: Path,
    cameras: Path | None = None,
    frames: FrameRange = ALL_FRAMES,
    focal: float | None = None,
    mattes: Path | None = None,
) -> Footage:
    """Open footage: cameras and file names now, frames when they are asked for.

    path     folder with an image, a folder of images or a video for each camera; or one video
    cameras  calibration file or folder; None: the one in `path` (`find_calibration`)
    focal    focal length in pixels of a single camera without a calibration; None: what its file
             says, else `usual_focal`
    mattes   folder of masks that stand in for the footage's own, named as its images; those of a
             video's frames by camera and number, counted from 0, as in left/00012.png
    Cameras with a folder or video show sequences; where all have one image, it shows one timestep.
    Raises StgaError in one sentence naming file, field and what was expected, also for a missing
    image.
    """
    sources, root = _sources(path)
    footage = _open(path, root, sources, cameras, frames, focal)
    plated = tuple(
        replace(camera, plate=sources.plates.get(camera.name)) for camera in footage.cameras
    )
    footage = replace(footage, cameras=plated)
    return footage if mattes is None else with_masks(footage, sources, mattes)


def _open(
    path: Path,
    root: Path,
    sources: Sources,
    cameras: Path | None,
    frames: FrameRange,
    focal: float | None,
) -> Footage:
    calibration = (
        cameras if cameras is not None else find_calibration(root) if isdir(path) else None
    )
    if calibration is None:
        return _single_camera(root, sources, frames, focal)
    if focal is not None:
        raise StgaError(f"{calibration}: has focal lengths; expected none besides")
    shots, warnings = read_calibration(calibration, partial(_image_size, sources))
    found = _calibrated(root, sources, calibration, shots, frames)
    warnings = (*warnings, *found.warnings)
    return replace(found, keeps_world=all(shot.keeps_world for shot in shots), warnings=warnings)


def _calibrated(
    root: Path, sources: Sources, calibration: Path, shots: list[Shot], frames: FrameRange
) -> Footage:
    timed = any(shot.timestep is not None for shot in shots)
    names = [] if timed else sequence_names(sources, (shot.label for shot in shots))
    if (frames.offsets or frames.sync != "none") and not any(names):
        raise StgaError(
            f"{calibration}: lists images, which offsets do not apply to; expected none"
        )
    if timed:
        found = _listed_cameras(
            [shot for shot in shots if frames.selects(shot.timestep or 0)], calibration
        )
        return _footage(
            root, found, next((shot.fps for shot in shots if shot.fps is not None), None)
        )
    if any(names):
        rig = _by_name(shots, names, root)
        sequences = {name: open_sequence(sequence_files(sources, name)) for name in rig}
        return _rig(root, sources, sequences, rig, frames)
    return _footage(root, _listed_cameras(_with_stills(shots, sources), calibration))


def _sources(path: Path) -> tuple[Sources, Path]:
    root = Path(realpath(path))  # Path.resolve raises RuntimeError for a loop of links
    if isdir(path):
        return find_sources(root), root
    if isfile(path) and is_video(path):
        return Sources(root.parent, videos={root.stem: [root]}), root.parent
    raise StgaError(f"{path}: is neither a folder nor a video; put photos into a folder")


def _footage(
    root: Path,
    cameras: tuple[FootageCamera, ...],
    fps: float | None = None,
    warnings: tuple[str, ...] = (),
) -> Footage:
    timesteps = {timestep for camera in cameras for timestep in camera.timesteps}
    return Footage(root, cameras, tuple(sorted(timesteps)), fps, warnings=warnings)


# Sequences: a folder of images or a video for each camera


def _by_name(shots: list[Shot], names: list[str | None], root: Path) -> dict[str, Shot]:
    """Camera -> its shot. Raises StgaError for a camera without recording, and for two with the
    same."""
    found: dict[str, Shot] = {}
    for shot, name in zip(shots, names, strict=True):
        if name is None:
            raise StgaError(
                f"{shot.where}: {root} has no folder or video of this camera, though it has of others"
            )
        if name in found:
            raise StgaError(
                f"{shot.where}: and {found[name].where} are both of camera {name}; expected different names"
            )
        found[name] = shot
    return found


def _rig(
    root: Path,
    sources: Sources,
    sequences: Mapping[str, Sequence],
    shots: Mapping[str, Shot],
    frames: FrameRange,
) -> Footage:
    fps = frames_per_second(sequences)
    videos = {
        name: sequence for name, sequence in sequences.items() if isinstance(sequence, video.Video)
    }
    warnings = tuple(warning for each in videos.values() for warning in each.warnings)
    if frames.sync != "none":
        if len(videos) < max(2, len(sequences)) or fps is None:
            raise StgaError(
                f"{root}: expected a video of each of several cameras, whose clocks --sync compares"
            )
        found, sentences = clock_offsets(videos, fps, frames.sync)
        frames, warnings = (
            replace(frames, offsets={**found, **frames.offsets}),
            (*warnings, *sentences),
        )
    recorded = synchronized(sequences, shots, sources, frames)
    return _footage(
        root, tuple(_camera(name, shots[name], recorded[name]) for name in shots), fps, warnings
    )


def _camera(name: str, shot: Shot, frames: Frames) -> FootageCamera:
    if isinstance(frames, ImageFrames):
        frames.require_sizes(name)
    found = undistortion(shot.camera, shot.lens, shot.where)
    return FootageCamera(name, shot.camera if found is None else found.camera, frames, found)


def _single_camera(
    root: Path, sources: Sources, frames: FrameRange, focal: float | None
) -> Footage:
    """Footage of one camera without a calibration; its world is the camera's, y up."""
    names = sorted({*sources.videos, *sources.folders})
    if len(names) != 1:
        found = f"{len(names)} cameras" if names else "neither images nor videos"
        raise StgaError(
            f"{root}: has {found} and no calibration; expected {EXPECTED}, or one camera"
        )
    sequence: Sequence = open_sequence(sequence_files(sources, names[0]))
    width, height = sequence_size(sequence)
    pixels, known = (
        (focal, "given") if focal is not None else _stated_focal(sequence, width, height)
    )
    if pixels < 1:
        raise StgaError(f"Focal length: expected at least 1 pixel, not {pixels:g}")
    camera = camera_from_gl(np.eye(4), width, height, pixels, pixels, width / 2, height / 2)
    name = names[0] or root.name
    shot = Shot(name, camera, Lens(), str(root))
    return replace(_rig(root, sources, {name: sequence}, {name: shot}, frames), focal=known)


def _stated_focal(sequence: Sequence, width: int, height: int) -> tuple[float, str]:
    """Pixels of the recording, and where they are from (`Footage.focal`)."""
    if isinstance(sequence, video.Video):
        stated = video_focal(sequence.path, width, height)
    else:
        stated = photo_focal(sequence[0], width, height)
    return (usual_focal(width, height), "usual") if stated is None else (stated, "file")


def usual_focal(width: int, height: int) -> float:
    """Focal length in pixels of a phone's images of that size."""
    return math.hypot(width, height) / 2 / math.tan(math.radians(USUAL_VIEW_DEG / 2))


# Images that the calibration lists


def _with_stills(shots: Iterable[Shot], sources: Sources) -> list[Shot]:
    """Shots with their image, after which they are named, and which shows the only timestep.

    Raises StgaError for two of the same pose: the images of a camera that stands still are a
    sequence.
    """
    found, poses = [], dict[bytes, Shot]()
    for shot in shots:
        other = poses.setdefault(_pose(shot), shot)
        if other is not shot:
            raise StgaError(
                f"{shot.where}: has the pose of {other.label}; expected a timestep_index, or one image of each camera"
            )
        listed = shot.image if shot.image is not None and isfile(shot.image) else None
        image = listed or still_image(sources, shot.label, shot.where)
        inside = image.is_relative_to(sources.root)
        mask = shot.mask or (sources.mask_of(image) if inside else None)
        name = shot.camera_name or (sources.name_of(image) if inside else image.stem)
        found.append(replace(shot, image=image, mask=mask, timestep=0, camera_name=name))
    return found


def _image_size(sources: Sources, label: str) -> tuple[int, int]:
    """Size of the images of a label; for calibrations that do not hold it."""
    name = sequence_names(sources, [label])[0]
    if name is not None:
        return recorded_size(sequence_files(sources, name))
    return image_size(still_image(sources, label, f"camera {label}"))


def _listed_cameras(shots: list[Shot], calibration: Path) -> tuple[FootageCamera, ...]:
    """One camera for all shots with the same name (where they have one), pose and lens."""
    if not shots:
        raise StgaError(f"{calibration}: none of its frames are in the chosen range")
    groups: dict[object, list[Shot]] = {}
    for shot in shots:
        groups.setdefault(_identity(shot), []).append(shot)
    names = [group[0].camera_name or group[0].label for group in groups.values()]
    cameras: list[FootageCamera] = []
    for name, group in zip(names, groups.values(), strict=True):
        unique = name if names.count(name) == 1 else f"{name} at timestep {group[0].timestep}"
        if unique in (camera.name for camera in cameras):
            raise StgaError(
                f"{group[0].where}: two cameras are named {unique}; expected different names"
            )
        cameras.append(_camera(unique, group[0], ImageFrames(_views(unique, group))))
    return tuple(cameras)


def _identity(shot: Shot) -> object:
    camera: Camera = shot.camera
    intrinsics = camera.width, camera.height, camera.fl_x, camera.fl_y, camera.cx, camera.cy
    return shot.camera_name, intrinsics, _pose(shot), shot.lens


def _pose(shot: Shot) -> bytes:
    # Adding zero turns -0 into 0, whose bytes differ.
    return bytes((np.round(shot.camera.world_to_camera, 6) + 0.0).tobytes())


def _views(name: str, shots: list[Shot]) -> dict[int, View]:
    views: dict[int, View] = {}
    for shot in sorted(shots, key=lambda shot: shot.timestep or 0):
        timestep = shot.timestep or 0
        if shot.image is None:
            raise StgaError(f"{shot.where}: names no image")
        if timestep in views and views[timestep].image != shot.image:
            raise StgaError(f"{shot.where}: camera {name} has two images at timestep {timestep}")
        for path in filter(None, (shot.image, shot.mask)):
            if not isfile(path):
                raise StgaError(f"{path}: does not exist, but {shot.where} names it")
        views[timestep] = View(timestep, 0, shot.camera, shot.label, shot.image, shot.mask)
    return views
