"""Opening footage: a calibration and the frames of its cameras."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from os.path import realpath
from pathlib import Path

import numpy as np

from ...capture.camera import camera_from_gl
from ...capture.images import image_size
from ...capture.model import View
from ...errors import StgaError
from ...files import is_file, is_folder
from .calibrations import EXPECTED, find_calibration, read_calibration
from .focal_tags import photo_focal, video_focal
from .model import Footage, FootageCamera, Frames, ImageFrames
from .sequences import FrameRange, Sequence, open_sequence, sequence_size, synchronized
from .shots import Lens, Shot, undistortion
from .sources import (
    Sources,
    find_sources,
    frame_number,
    is_video,
    sequence_files,
    sequence_names,
    still_image,
)
from .video import Video, VideoFrames, first_frames

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
    root = Path(realpath(path))  # Path.resolve raises RuntimeError for a loop of links
    if is_folder(path):
        sources = find_sources(root)
        cameras = find_calibration(root) if cameras is None else cameras
    elif is_file(path) and is_video(path):
        sources = Sources(root.parent, videos={root.stem: [root]})
    else:
        raise StgaError(f"{path}: is neither a folder nor a video; put photos into a folder")
    if cameras is None:
        footage = _single_camera(sources, frames, focal)
    elif focal is not None:
        raise StgaError(f"{cameras}: has focal lengths; expected none besides")
    else:
        shots, warnings = read_calibration(cameras, partial(_image_size, sources))
        footage = _calibrated(sources, cameras, shots, frames)
        keeps_world = all(shot.keeps_world for shot in shots)
        warnings = (*warnings, *footage.warnings)
        footage = replace(footage, keeps_world=keeps_world, warnings=warnings)
    plated = tuple(replace(own, plate=sources.plates.get(own.name)) for own in footage.cameras)
    if mattes is None:
        return replace(footage, cameras=plated)
    if not is_folder(mattes):
        raise StgaError(f"{mattes}: is not a folder; expected one of mattes")
    given = find_sources(Path(realpath(mattes)))
    masked = tuple(_masked(camera, sources, given, len(plated) == 1) for camera in plated)
    return replace(footage, cameras=masked)


def _calibrated(
    sources: Sources, calibration: Path, shots: list[Shot], frames: FrameRange
) -> Footage:
    timed = any(shot.timestep is not None for shot in shots)
    names = [] if timed else sequence_names(sources, (shot.label for shot in shots))
    if any(names):  # a folder of images or a video for each camera
        found: dict[str, Shot] = {}
        for shot, name in zip(shots, names, strict=True):
            if name is None:
                missing = "has no folder or video of this camera, though it has of others"
                raise StgaError(f"{shot.where}: {sources.root} {missing}")
            if name in found:
                same = f"are both of camera {name}; expected different names"
                raise StgaError(f"{shot.where}: and {found[name].where} {same}")
            found[name] = shot
        sequences = {name: open_sequence(sequence_files(sources, name)) for name in found}
        return _rig(sources, found, sequences, frames)
    if frames.offsets or frames.sync != "none":
        lists = "lists images, which offsets do not apply to; expected none"
        raise StgaError(f"{calibration}: {lists}")
    fps = next((shot.fps for shot in shots if timed and shot.fps is not None), None)
    chosen = [shot for shot in shots if frames.selects(shot.timestep or 0)]
    listed = _listed_cameras(chosen if timed else _with_stills(shots, sources), calibration)
    return Footage(sources.root, listed, fps)


def _masked(
    camera: FootageCamera, recorded: Sources, given: Sources, single: bool
) -> FootageCamera:
    """The camera with masks of a folder. single: it needs no folder of its own."""
    frames = camera.frames
    masks = {}
    files = [*(given.folders.get("", []) if single else ()), *given.folders.get(camera.name, [])]
    by_number = {frame_number(path): path for path in files}
    for timestep in camera.timesteps:
        source = Path(frames.source(timestep))
        if isinstance(frames, VideoFrames):
            expected = f"{camera.name}/{frames.numbers[timestep]:05d}"
            path = by_number.get(frames.numbers[timestep])
        else:
            inside = source.is_relative_to(recorded.root)
            expected = recorded.name_of(source) if inside else source.stem
            path = next(iter(given.images.get(expected) or given.masks.get(expected, [])), None)
        if path is None:
            raise StgaError(f"{given.root}: has no matte of {source}; expected {expected}.png")
        masks[timestep] = View(timestep, 0, camera.camera, camera.name, source, path)
    if isinstance(frames, VideoFrames):
        return replace(camera, frames=VideoFrames(frames.video, frames.numbers, masks))
    views = {t: replace(view, mask=masks[t].mask) for t, view in frames.views.items()}
    return replace(camera, frames=ImageFrames(views))


def _rig(
    sources: Sources,
    shots: Mapping[str, Shot],
    sequences: Mapping[str, Sequence],
    frames: FrameRange,
) -> Footage:
    videos = [own for own in sequences.values() if isinstance(own, Video)]
    warnings = [warning for video in videos for warning in video.warnings]
    recorded, fps, sentences = synchronized(sequences, shots, sources, frames)
    cameras = tuple(_camera(name, shots[name], recorded[name]) for name in shots)
    return Footage(sources.root, cameras, fps, warnings=(*warnings, *sentences))


def _camera(name: str, shot: Shot, frames: Frames) -> FootageCamera:
    width = shot.camera.width
    height = shot.camera.height
    for path, size in frames.sizes():
        if size != (width, height):
            expected = f"but {shot.where} has {width} x {height}"
            raise StgaError(f"{path}: has {size[0]} x {size[1]} pixels, {expected}")
    found = undistortion(shot.camera, shot.lens, shot.where)
    return FootageCamera(name, shot.camera if found is None else found.camera, frames, found)


def _single_camera(sources: Sources, frames: FrameRange, focal: float | None) -> Footage:
    """Footage of one camera without a calibration; its world is the camera's, y up."""
    names = sorted({*sources.videos, *sources.folders})
    root = sources.root
    if len(names) != 1:
        found = f"{len(names)} cameras" if names else "neither images nor videos"
        expected = f"expected {EXPECTED}, or one camera"
        raise StgaError(f"{root}: has {found} and no calibration; {expected}")
    sequence = open_sequence(sequence_files(sources, names[0]))
    known = "given"
    width, height = sequence_size(sequence)
    if focal is None:
        if isinstance(sequence, Video):
            focal = video_focal(sequence.path, width, height)
            known = "file"
        else:
            focal = photo_focal(sequence[0], width, height)
            known = "file"
    if focal is None:
        focal = usual_focal(width, height)
        known = "usual"
    if focal < 1:
        raise StgaError(f"Focal length: expected at least 1 pixel, not {focal:g}")
    camera = camera_from_gl(np.eye(4), width, height, focal, focal, width / 2, height / 2)
    name = names[0] or root.name
    shot = Shot(name, camera, Lens(), str(root))
    return replace(_rig(sources, {name: shot}, {name: sequence}, frames), focal=known)


def usual_focal(width: int, height: int) -> float:
    """Focal length in pixels of a phone's images of that size."""
    return math.hypot(width, height) / 2 / math.tan(math.radians(USUAL_VIEW_DEG / 2))


# Images that the calibration lists


def _with_stills(shots: Iterable[Shot], sources: Sources) -> list[Shot]:
    """Shots with their image, after which they are named, and which shows the only timestep; no two
    of the same pose: the images of a camera that stands still are a sequence."""
    found = []
    poses = dict[bytes, Shot]()
    for shot in shots:
        other = poses.setdefault(_pose(shot), shot)
        if other is not shot:
            expected = "expected a timestep_index, or one image of each camera"
            raise StgaError(f"{shot.where}: has the pose of {other.label}; {expected}")
        listed = shot.image if shot.image is not None and is_file(shot.image) else None
        image = listed or still_image(sources, shot.label, shot.where)
        inside = image.is_relative_to(sources.root)
        mask = shot.mask or (sources.mask_of(image) if inside else None)
        name = shot.camera_name or (sources.name_of(image) if inside else image.stem)
        found.append(replace(shot, image=image, mask=mask, timestep=0, camera_name=name))
    return found


def _image_size(sources: Sources, label: str) -> tuple[int, int]:
    """Size of the images of a label; for calibrations that do not hold it."""
    name = sequence_names(sources, [label])[0]
    if name is None:
        return image_size(still_image(sources, label, f"camera {label}"))
    files = sequence_files(sources, name)
    return first_frames(files)[0] if isinstance(files, Path) else image_size(files[0])


def _listed_cameras(shots: list[Shot], calibration: Path) -> tuple[FootageCamera, ...]:
    """One camera for all shots with the same name (where they have one), pose and lens."""
    if not shots:
        raise StgaError(f"{calibration}: none of its frames are in the chosen range")
    groups: dict[object, list[Shot]] = {}
    for shot in shots:
        camera = shot.camera
        intrinsics = camera.width, camera.height, camera.fl_x, camera.fl_y, camera.cx, camera.cy
        identity = shot.camera_name, intrinsics, _pose(shot), shot.lens
        groups.setdefault(identity, []).append(shot)
    names = [group[0].camera_name or group[0].label for group in groups.values()]
    cameras: list[FootageCamera] = []
    for name, group in zip(names, groups.values(), strict=True):
        unique = name if names.count(name) == 1 else f"{name} at timestep {group[0].timestep}"
        if unique in (camera.name for camera in cameras):
            same = f"two cameras are named {unique}; expected different names"
            raise StgaError(f"{group[0].where}: {same}")
        views: dict[int, View] = {}
        for shot in sorted(group, key=lambda shot: shot.timestep or 0):
            timestep = shot.timestep or 0
            if shot.image is None:
                raise StgaError(f"{shot.where}: names no image")
            if timestep in views and views[timestep].image != shot.image:
                two = f"camera {unique} has two images at timestep {timestep}"
                raise StgaError(f"{shot.where}: {two}")
            for path in filter(None, (shot.image, shot.mask)):
                if not is_file(path):
                    raise StgaError(f"{path}: does not exist, but {shot.where} names it")
            views[timestep] = View(timestep, 0, shot.camera, shot.label, shot.image, shot.mask)
        cameras.append(_camera(unique, group[0], ImageFrames(views)))
    return tuple(cameras)


def _pose(shot: Shot) -> bytes:
    # Adding zero turns -0 into 0, whose bytes differ.
    return bytes((np.round(shot.camera.world_to_camera, 6) + 0.0).tobytes())
