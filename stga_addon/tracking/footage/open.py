"""Opening footage: a calibration file and the frames of its cameras."""

from collections.abc import Iterable
from os.path import isdir, isfile
from pathlib import Path

import numpy as np

from ...capture.model import View
from ...capture.transforms import SPLITS
from ...errors import StgaError
from .image_frames import ImageFrames
from .model import Footage, FootageCamera
from .nerfstudio import read_nerfstudio
from .shots import Shot
from .undistort import undistortion

TRANSFORMS = ("transforms.json", *(f"transforms_{split}.json" for split in SPLITS))


def open_footage(folder: Path, cameras: Path | None = None, principal_point: str | None = None) -> Footage:
    """Open footage: cameras and file names now, frames when they are asked for.

    cameras: the calibration file; None: the one that `folder` holds.
    principal_point: what `cy` means in transforms files, as in `read_transforms`; None: by the file's author.
    Raises StgaError in one sentence naming file, field and what was expected, also for a missing image.
    """
    if not isdir(folder):
        raise StgaError(f"{folder}: is not a folder; expected that of the footage")
    root = folder.resolve()
    shots = [shot for path in _calibration_files(root, cameras) for shot in read_nerfstudio(path, principal_point)]
    return _footage(root, _cameras(shots))


def _calibration_files(root: Path, given: Path | None) -> list[Path]:
    if given is not None:
        return [given]
    found = [root / name for name in TRANSFORMS if (root / name).is_file()]
    if not found:
        raise StgaError(f"{root}: has no cameras; expected {' or '.join(TRANSFORMS[:2])}")
    return found[:1] if found[0].name == TRANSFORMS[0] else found


def _footage(root: Path, cameras: tuple[FootageCamera, ...]) -> Footage:
    timesteps = {timestep for camera in cameras for timestep in camera.timesteps}
    return Footage(root, cameras, tuple(sorted(timesteps)))


def _cameras(shots: Iterable[Shot]) -> tuple[FootageCamera, ...]:
    """One camera for all shots with the same name (where they have one), pose and lens."""
    groups: dict[object, list[Shot]] = {}
    for shot in shots:
        groups.setdefault(_identity(shot), []).append(shot)
    names = [group[0].camera_name or group[0].label for group in groups.values()]
    return tuple(
        _camera(name if names.count(name) == 1 else f"{name} at timestep {group[0].timestep}", group)
        for name, group in zip(names, groups.values(), strict=True)
    )


def _identity(shot: Shot) -> object:
    camera = shot.camera
    intrinsics = camera.width, camera.height, camera.fl_x, camera.fl_y, camera.cx, camera.cy
    # Adding zero turns -0 into 0, whose bytes differ.
    pose = (np.round(camera.world_to_camera, 6) + 0.0).tobytes()
    return shot.camera_name, intrinsics, pose, shot.lens


def _camera(name: str, shots: list[Shot]) -> FootageCamera:
    views: dict[int, View] = {}
    for shot in sorted(shots, key=lambda shot: shot.timestep or 0):
        timestep = shot.timestep or 0
        if timestep in views and views[timestep].image != shot.image:
            raise StgaError(f"{shot.where}: camera {name} has two images at timestep {timestep}")
        for path in filter(None, (shot.image, shot.mask)):
            if not isfile(path):
                raise StgaError(f"{path}: does not exist, but {shot.where} names it")
        assert shot.image is not None
        views[timestep] = View(timestep, 0, shot.camera, shot.label, shot.image, shot.mask)
    found = undistortion(shots[0].camera, shots[0].lens, shots[0].where)
    camera = shots[0].camera if found is None else found.camera
    return FootageCamera(name, camera, ImageFrames(views), found)
