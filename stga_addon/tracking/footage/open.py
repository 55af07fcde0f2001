"""Opening footage: a calibration and the frames of its cameras."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from os.path import exists, realpath
from pathlib import Path

import numpy as np

from ...capture.camera import camera_from_gl, scaled_to
from ...capture.images import image_size, is_inverted, is_turned, stored_mask
from ...capture.lens import Lens, Undistortion, undistortion
from ...capture.model import View, evenly_spread
from ...capture.transforms import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from ...errors import StgaError, listed
from ...files import is_file, is_folder
from ...schema import check_encodable
from .calibrations import EXPECTED, calibration_above, find_calibration, read_calibration
from .colmap import is_distorted, model_suffix
from .focal_tags import photo_focal, video_focal
from .json_cameras import camera_names
from .model import Footage, FootageCamera, Frames, ImageFrames
from .moments import central_pose, find_moments, images_by_camera
from .sequences import FrameRange, Sequence, open_sequence, sequence_size, synchronized
from .shots import Shot
from .sources import (
    CONTAINERS,
    ORIGINALS,
    Sources,
    calibration_images,
    find_sources,
    frame_number,
    images_of,
    is_video,
    natural_order,
    sequence_files,
    sequence_names,
    stem_of,
    still_image,
)
from .video import Video, VideoFrames, first_frames

ALL_FRAMES = FrameRange()
"""Range without ends: every frame is used."""
MAX_MEASURED_MASKS = 6
"""Masks, evenly spread over cameras and timesteps, that show what 255 means."""
TYPICAL_VIEW_DEG = 65.0
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
             says, else `typical_focal`
    mattes   folder of masks that stand in for the footage's own, named as its images; those of a
             video's frames by camera and number, counted from 0, as in left/00012.png
    Cameras with a folder or video show sequences; where all have one image, it shows one timestep.
    Raises StgaError in one sentence naming file, field and what was expected, also for a missing
    image.
    """
    root = Path(realpath(path))  # Path.resolve raises RuntimeError for a loop of links
    warnings: tuple[str, ...] = ()
    if is_folder(path):
        if cameras is None:
            cameras, warnings = find_calibration(root)
        root, containers = (root, CONTAINERS) if cameras is None else _workspace(root, cameras)
        sources = find_sources(root, containers)
    elif is_file(path) and is_video(path):
        sources = Sources(root.parent, videos={root.stem: [root]}, files=[root])
    else:
        raise StgaError(f"{path}: {_no_footage(path)}")
    if cameras is None and is_folder(path):
        cameras = _calibration_around(sources)
        warnings = () if cameras is None else (f"{cameras}: is the calibration of {root}",)
    if cameras is None:
        footage = _single_camera(sources, frames, focal)
    elif focal is not None:
        raise StgaError(f"{cameras}: has focal lengths; expected none besides")
    else:
        shots, sentences = read_calibration(cameras, partial(_image_size, sources))
        footage = _calibrated(sources, cameras, shots, frames)
        keeps_world = all(shot.keeps_world for shot in shots)
        warnings = (*warnings, *sentences, *footage.warnings)
        footage = replace(footage, keeps_world=keeps_world, warnings=warnings)
    if sources.unread:
        names = [path.relative_to(root).as_posix() for path in sources.unread]
        unread = f"{root}: does not read {listed(names)}; expected {', '.join(IMAGE_SUFFIXES)}"
        footage = replace(footage, warnings=(*footage.warnings, unread))
    plated = tuple(
        replace(camera, plate=sources.plates.get(camera.name)) for camera in footage.cameras
    )
    footage = replace(footage, cameras=plated)
    if mattes is None:
        unused = _unused_masks(sources, plated)
        return _masks_as_meant(replace(footage, warnings=(*footage.warnings, *unused)))
    if not is_folder(mattes):
        raise StgaError(f"{mattes}: is not a folder; expected one of mattes")
    given = find_sources(Path(realpath(mattes)))
    masked = tuple(_masked(camera, sources, given, len(plated) == 1) for camera in plated)
    return _masks_as_meant(replace(footage, cameras=masked))


def _masks_as_meant(footage: Footage) -> Footage:
    """The footage with masks that are 255 outside of the head read the other way around, and a
    sentence about that."""
    masks = [
        view
        for camera in footage.cameras
        for view in _mask_views(camera.frames).values()
        if view.mask is not None
    ]
    measured = evenly_spread(masks, MAX_MEASURED_MASKS)
    try:
        if not measured or not all(is_inverted(stored_mask(view)) for view in measured):
            return footage
    except StgaError:  # what needs the file says so
        return footage
    cameras = tuple(
        replace(camera, frames=_with_inverted(camera.frames)) for camera in footage.cameras
    )
    sentence = f"{footage.root}: masks are 255 outside of the head; they are read the other way"
    return replace(footage, cameras=cameras, warnings=(*footage.warnings, sentence))


def _with_inverted(frames: Frames) -> Frames:
    """The frames with views whose masks are inverted as they are read."""
    views = _mask_views(frames)
    inverted = {t: replace(view, is_mask_inverted=True) for t, view in views.items()}
    if isinstance(frames, VideoFrames):
        return VideoFrames(frames.video, frames.numbers, inverted or None)
    return ImageFrames(inverted)


def _mask_views(frames: Frames) -> Mapping[int, View]:
    """Timestep -> the view that names its mask, if there is one."""
    return frames.masks or {} if isinstance(frames, VideoFrames) else frames.views


def sized(footage: Footage, size: float) -> Footage:
    """The footage with images of a fraction of the recorded size."""
    cameras = []
    for recorded in footage.cameras:
        ideal = recorded.camera.scaled(size)
        known = recorded.undistortion or Undistortion(recorded.camera, Lens(), ideal)
        cameras.append(replace(recorded, camera=ideal, undistortion=replace(known, camera=ideal)))
    return replace(footage, cameras=tuple(cameras))


def _no_footage(path: Path) -> str:
    """Description of a path that is neither a folder nor a video."""
    if not exists(path):
        return "does not exist"
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return "is one image; put photos into a folder"
    suffixes = ", ".join(VIDEO_SUFFIXES)
    return f"is neither a folder nor a video; expected a folder of photos or one of {suffixes}"


def _workspace(root: Path, calibration: Path) -> tuple[Path, tuple[str, ...]]:
    """The folder of a calibration's images, and which are used of several of the same names: beside
    `sparse`, where COLMAP's undistortion writes them; of 3DGS's `distorted` the originals."""
    calibration = Path(realpath(calibration))
    if not calibration.is_relative_to(root) or not model_suffix(calibration):
        return root, CONTAINERS
    if is_distorted(calibration.relative_to(root)):
        return root, (ORIGINALS, *CONTAINERS)
    above = [calibration, *calibration.parents]
    inside = above[: above.index(root)]
    return next(
        (folder for folder in inside if is_folder(folder / CONTAINERS[0])), root
    ), CONTAINERS


def _calibration_around(sources: Sources) -> Path | None:
    """A calibration in a folder around that of the images, which names cameras of theirs."""
    found = calibration_above(sources.root)
    if found is None:
        return None
    return found if images_by_camera(camera_names(found), sources.images) else None


def _calibrated(
    sources: Sources, calibration: Path, shots: list[Shot], frames: FrameRange
) -> Footage:
    timed = any(shot.timestep is not None for shot in shots)
    messages: tuple[str, ...] = ()
    if not timed:
        shots, messages = _one_a_camera(shots, calibration)
    names = [] if timed else sequence_names(sources, (shot.label for shot in shots))
    if any(names):  # a folder of images or a video for each camera
        found: dict[str, Shot] = {}
        for shot, name in zip(shots, names, strict=True):
            if name is None:
                raise StgaError(
                    f"{shot.where}: {sources.root} has no folder or video of this camera, "
                    "though it has of others"
                )
            if name in found:
                raise StgaError(
                    f"{shot.where}: and {found[name].where} are both of camera {name}; "
                    "expected different names"
                )
            found[name] = shot
        files = {name: sequence_files(sources, name) for name in found}
        sequences = {name: open_sequence(paths) for name, paths in files.items()}
        used = [
            path for file in files.values() for path in ([file] if isinstance(file, Path) else file)
        ]
        used += [path for shot in shots for path in calibration_images(sources, shot.label)]
        footage = _rig(sources, found, sequences, frames)
        unused = _unused(sources, calibration, used)
        return replace(footage, warnings=(*messages, *footage.warnings, *unused))
    if frames.offsets or frames.sync != "none":
        raise StgaError(
            f"{calibration}: lists images, which offsets do not apply to; expected none"
        )
    fps = next((shot.fps for shot in shots if timed and shot.fps is not None), None)
    if not timed:
        shots, sentences = _with_images(shots, sources)
        messages += sentences
    unused = _unused(sources, calibration, [shot.image for shot in shots if shot.image is not None])
    timesteps = frames.chosen(sorted({shot.timestep or 0 for shot in shots}))
    chosen = [shot for shot in shots if (shot.timestep or 0) in timesteps]
    cameras, sentences = _with_sentences(str(sources.root), _listed_cameras(chosen, calibration))
    return Footage(sources.root, cameras, fps, warnings=(*messages, *sentences, *unused))


def _unused(sources: Sources, calibration: Path, used: Iterable[Path]) -> tuple[str, ...]:
    """A sentence about images and videos without a camera, by folder where none of it has one."""
    rest = set(sources.files).difference(used)
    if not rest:
        return ()
    folders = Counter(path.parent for path in sources.files)
    left_out = Counter(path.parent for path in rest)
    names = []
    for folder, count in left_out.items():
        if count > 1 and count == folders[folder] and folder != sources.root:
            names.append(f"{folder.relative_to(sources.root).as_posix()} ({count})")
        else:
            paths = sorted((path for path in rest if path.parent == folder), key=str)
            names += [path.relative_to(sources.root).as_posix() for path in paths]
    kinds = {is_video(path) for path in rest}
    what = "images" if kinds == {False} else "videos" if kinds == {True} else "images and videos"
    counted = f"{len(rest)} of {len(sources.files)} {what} have no camera in {calibration}"
    return (f"{sources.root}: {counted}: {listed(sorted(names))}",)


def _unused_masks(sources: Sources, cameras: Iterable[FootageCamera]) -> tuple[str, ...]:
    """Sentences about masks of no image and plates of no camera."""
    frames = [camera.frames for camera in cameras]
    views = (
        view for frame in frames if isinstance(frame, ImageFrames) for view in frame.views.values()
    )
    used = {view.mask for view in views} | {sources.mask_of(path) for path in sources.files}
    masks = [path for mask in sources.masks.values() for path in mask if path not in used]
    known = {camera.name for camera in cameras}
    plates = [path for name, path in sources.plates.items() if name not in known]
    sentences = []
    for kind, paths in (("masks are of no image", masks), ("plates are of no camera", plates)):
        if paths:
            names = [path.relative_to(sources.root).as_posix() for path in paths]
            sentences.append(f"{sources.root}: {len(paths)} {kind}: {listed(names)}")
    return tuple(sentences)


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
    sequences = {
        name: _as_calibrated(sequence, shots[name]) for name, sequence in sequences.items()
    }
    videos = [sequence for sequence in sequences.values() if isinstance(sequence, Video)]
    warnings = [warning for video in videos for warning in video.sentences]
    recorded, fps, sentences = synchronized(sequences, shots, sources, frames)
    cameras, messages = _with_sentences(
        str(sources.root), (_camera(name, shots[name], recorded[name]) for name in shots)
    )
    return Footage(sources.root, cameras, fps, warnings=(*warnings, *sentences, *messages))


def _as_calibrated(sequence: Sequence, shot: Shot) -> Sequence:
    """A video as it is stored, where its camera was calibrated so: programs that save its frames as
    images ignore that pixels are not square."""
    size = shot.camera.width, shot.camera.height
    if isinstance(sequence, Video) and size == sequence.stored != sequence.size:
        return sequence.as_stored()
    return sequence


def _camera(name: str, shot: Shot, frames: Frames) -> tuple[FootageCamera, tuple[str, ...]]:
    """The camera, and sentences about what its frames are different from its calibration. Raises
    StgaError for frames of another shape."""
    messages: tuple[str, ...] = ()
    if isinstance(frames, ImageFrames) and shot.is_as_stored:
        frames, messages = _as_stored(shot, frames)
    width = shot.camera.width
    height = shot.camera.height
    sizes = dict(frames.sizes())
    first = next(iter(sizes.values()))
    scaled = scaled_to(shot.camera, first)
    if first != (width, height) and scaled is not None and set(sizes.values()) == {first}:
        shot = replace(shot, camera=scaled)
        if isinstance(frames, ImageFrames):
            views = {t: replace(view, camera=scaled) for t, view in frames.views.items()}
            frames = ImageFrames(views)
        both = f"{first[0]} x {first[1]} pixels, the calibration of {width} x {height}"
        messages += (f"images are of {both}, which is scaled by {first[0] / width:.4g}",)
    for path, size in sizes.items():
        check_encodable(path)
        if size != (shot.camera.width, shot.camera.height):
            raise StgaError(
                f"{path}: has {size[0]} x {size[1]} pixels, but {shot.where} has {width} x {height}"
            )
    found = undistortion(shot.camera, shot.lens, shot.where)
    return FootageCamera(
        name, shot.camera if found is None else found.camera, frames, found
    ), messages


def _as_stored(shot: Shot, frames: ImageFrames) -> tuple[ImageFrames, tuple[str, ...]]:
    """Frames without EXIF's orientation, where the calibration has the shape of the stored
    pixels."""
    size = shot.camera.width, shot.camera.height
    views = dict(frames.views)
    turned = False
    for timestep, view in views.items():
        if is_turned(view.image) and _has_shape(size, image_size(view.image, True)):
            views[timestep] = replace(view, is_as_stored=True)
            turned = True
    sentence = "images are read as stored, without EXIF's orientation, as they were calibrated"
    return ImageFrames(views), (sentence,) if turned else ()


def _has_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    return (size[0] >= size[1]) == (other[0] >= other[1])


def _with_sentences(
    where: str, cameras: Iterable[tuple[FootageCamera, tuple[str, ...]]]
) -> tuple[tuple[FootageCamera, ...], tuple[str, ...]]:
    """Cameras, and each sentence about them once."""
    listed = list(cameras)
    messages = dict.fromkeys(sentence for _, sentences in listed for sentence in sentences)
    return tuple(camera for camera, _ in listed), tuple(f"{where}: {each}" for each in messages)


def _single_camera(sources: Sources, frames: FrameRange, focal: float | None) -> Footage:
    """Footage of one camera without a calibration; its world is the camera's, y up."""
    names = sorted({*sources.videos, *sources.folders})
    root = sources.root
    if len(names) != 1:
        found = "neither images nor videos"
        if names:
            several = [name or "those at the top" for name in names]
            found = f"{len(names)} cameras ({listed(several)})"
        elif sources.unread:
            found += f" that are read (not {sources.unread[0].name})"
        raise StgaError(
            f"{root}: has {found} and no calibration; expected {EXPECTED}, or one camera"
        )
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
        focal = typical_focal(width, height)
        known = "usual"
    if focal < 1:
        raise StgaError(f"Focal length: expected at least 1 pixel, not {focal:g}")
    camera = camera_from_gl(np.eye(4), (width, height), (focal, focal), (width / 2, height / 2))
    name = names[0] or root.name
    shot = Shot(name, camera, Lens(), str(root))
    return replace(_rig(sources, {name: shot}, {name: sequence}, frames), focal=known)


def typical_focal(width: int, height: int) -> float:
    """Focal length in pixels of a phone's images of that size."""
    return math.hypot(width, height) / 2 / math.tan(math.radians(TYPICAL_VIEW_DEG / 2))


# Images that the calibration lists


def _one_a_camera(shots: list[Shot], calibration: Path) -> tuple[list[Shot], tuple[str, ...]]:
    """A shot for each camera of a rig that stands still, of which several moments were calibrated,
    labelled with its name; and a sentence about it. Shots of one moment stay."""
    moments = find_moments(
        [stem_of(shot.label) for shot in shots], [shot.camera.world_to_camera for shot in shots]
    )
    if not moments.is_rig:
        return shots, ()
    groups: dict[str, list[Shot]] = {}
    for camera, shot in zip(moments.cameras, shots, strict=True):
        groups.setdefault(camera, []).append(shot)
    chosen = []
    for camera, group in groups.items():
        middle = group[central_pose([shot.camera.world_to_camera for shot in group])]
        chosen.append(replace(middle, label=camera, image=None, mask=None, camera_name=None))
    count = len(set(moments.timesteps))
    sentence = (
        f"{calibration}: {len(shots)} images are of {len(groups)} cameras that stand still, at "
        f"{count} moments"
    )
    return chosen, (sentence,)


def _with_images(shots: list[Shot], sources: Sources) -> tuple[list[Shot], tuple[str, ...]]:
    """Shots with their images: of one moment where each has one, else of the moments that the
    images' names show, and a sentence about these."""
    if not all(_has_one_image(shot, sources) for shot in shots):
        labels = [stem_of(shot.label).rpartition("/")[2] for shot in shots]
        images = {} if len(set(labels)) < len(labels) else images_by_camera(labels, sources.images)
        moments = sorted({moment for by_moment in (images or {}).values() for moment in by_moment})
        order = {moment: n for n, moment in enumerate(sorted(moments, key=natural_order))}
        found = []
        for shot, label in zip(shots, labels, strict=True):
            for moment, name in (images or {}).get(label, {}).items():
                image = sources.images[name][0]
                moved = replace(shot, image=image, mask=sources.mask_of(image), camera_name=label)
                found.append(replace(moved, timestep=order[moment]))
        if found:
            messages = f"images are of {len(shots)} cameras at {len(order)} moments, by their names"
            return found, (f"{sources.root}: {messages}",) if len(order) > 1 else ()
    return _with_stills(shots, sources), ()


def _has_one_image(shot: Shot, sources: Sources) -> bool:
    is_listed = shot.image is not None and is_file(shot.image)
    return is_listed or len(images_of(sources, shot.label)) == 1


def _with_stills(shots: Iterable[Shot], sources: Sources) -> list[Shot]:
    """Shots with their image, after which they are named, and which shows the only timestep; no two
    of the same pose: the images of a camera that stands still are a sequence."""
    found = []
    poses = dict[bytes, Shot]()
    for shot in shots:
        other = poses.setdefault(_pose(shot), shot)
        if other is not shot:
            raise StgaError(
                f"{shot.where}: has the pose of {other.label}; expected a timestep_index, or "
                "one image of each camera"
            )
        listed = shot.image if shot.image is not None and is_file(shot.image) else None
        image = listed or still_image(sources, shot.label, shot.where)
        inside = image.is_relative_to(sources.root)
        mask = shot.mask or (sources.mask_of(image) if inside else None)
        name = shot.camera_name or (sources.name_of(image) if inside else image.stem)
        found.append(replace(shot, image=image, mask=mask, timestep=0, camera_name=name))
    return found


def _image_size(sources: Sources, label: str) -> tuple[int, int]:
    """Size of the images of a label as stored; for calibrations that do not hold it."""
    name = sequence_names(sources, [label])[0]
    if name is None:
        moments = images_by_camera([label], sources.images) or {label: {}}
        name = next(iter(moments[label].values()), None)
        if name is not None and len(images_of(sources, label)) != 1:
            return image_size(sources.images[name][0], True)
        return image_size(still_image(sources, label, f"camera {label}"), True)
    files = sequence_files(sources, name)
    return first_frames(files).size if isinstance(files, Path) else image_size(files[0], True)


def _listed_cameras(
    shots: list[Shot], calibration: Path
) -> list[tuple[FootageCamera, tuple[str, ...]]]:
    """One camera for all shots with the same name (where they have one), pose and lens."""
    if not shots:
        raise StgaError(f"{calibration}: none of its frames are in the chosen range")
    groups: dict[object, list[Shot]] = {}
    for shot in shots:
        identity = shot.camera_name, shot.camera.intrinsics, _pose(shot), shot.lens
        groups.setdefault(identity, []).append(shot)
    names = [group[0].camera_name or group[0].label for group in groups.values()]
    cameras: list[tuple[FootageCamera, tuple[str, ...]]] = []
    for name, group in zip(names, groups.values(), strict=True):
        unique = name if names.count(name) == 1 else f"{name} at timestep {group[0].timestep}"
        if unique in (camera.name for camera, _ in cameras):
            raise StgaError(
                f"{group[0].where}: two cameras are named {unique}; expected different names"
            )
        views: dict[int, View] = {}
        for shot in sorted(group, key=lambda shot: shot.timestep or 0):
            timestep = shot.timestep or 0
            if shot.image is None:
                raise StgaError(f"{shot.where}: names no image")
            if timestep in views and views[timestep].image != shot.image:
                raise StgaError(
                    f"{shot.where}: camera {unique} has two images at timestep {timestep}"
                )
            for path in filter(None, (shot.image, shot.mask)):
                if not is_file(path):
                    raise StgaError(f"{path}: does not exist, but {shot.where} names it")
            views[timestep] = View(timestep, 0, shot.camera, shot.label, shot.image, shot.mask)
        cameras.append(_camera(unique, group[0], ImageFrames(views)))
    return cameras


def _pose(shot: Shot) -> bytes:
    # Adding zero turns -0 into 0, whose bytes differ.
    return bytes((np.round(shot.camera.world_to_camera, 6) + 0.0).tobytes())
