"""A face in footage: landmarks, detected or read, of a camera whose lens is known."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from ..capture.camera import Camera
from ..errors import StgaError
from ..flame.model import BUNDLED_HEAD
from . import fit as head_fit
from . import folder
from .correspondence import calibrate
from .face_networks import FaceNetworks
from .fit import RecordedTake, TimestepLandmarks
from .focal_length import RATIOS, FocalEstimate, estimated_focal
from .footage.model import Footage, FootageCamera
from .landmark_bias import without_bias
from .landmarks import (
    CameraLandmarks,
    check_count,
    detect_landmarks,
    read_landmarks,
    read_places,
    write_places,
)
from .opened import OpenedFootage, begin_landmarks
from .pictures import picture_of_first_frame
from .stages import Stage, Workers

BUNDLED_PLACES = Path(__file__).parent / "networks/bundled_head_places.npz"
"""Landmarks on the bundled head, as `calibrate` finds them; made by
`development/bundled_head.py`."""
MIN_FACE_FRACTION = 1 / 3  # Least fraction of the timesteps at which a face is detected
FACE_REMEDY = "where the face is too small in the frame, crop the video to head and shoulders"
MIN_FACE_PIXELS = 1.0  # Extent of the landmarks in an image below which they are one point


@dataclass(frozen=True)
class RecordedFootage:
    """Footage and its landmarks.

    detected  by camera, whether reliable or not
    take      those that the head is fitted to
    focal     how well the focal length of a single camera without calibration is known; None where
              it was not estimated
    """

    opened: OpenedFootage
    detected: Mapping[str, CameraLandmarks]
    take: RecordedTake
    focal: FocalEstimate | None = None

    @property
    def footage(self) -> Footage:
        return self.opened.footage

    @property
    def blind_cameras(self) -> list[str]:
        """Names of those that see no reliable landmark."""
        seen = {name: own for name, own in self.detected.items() if own.confidence.any()}
        sees = {name for name, own in seen.items() if own.confidence[:, self.take.reliable].any()}
        return [name for name in self.detected if name not in sees]


def record(opened: OpenedFootage, workers: Workers) -> RecordedFootage:
    """The landmarks of the networks, kept in the capture's folder, or those of the options' folder.
    Raises StgaError where there are too few, and an interruption leaves what is detected."""
    given = opened.options.landmarks
    detected, take = _detected(opened, workers) if given is None else _read(opened, given)
    check_count(detected, take.places)
    neutral = _neutral(opened, take)
    if np.ptp(neutral[take.reliable], axis=0).max() < head_fit.MIN_FACE_M:
        places = (given or opened.out / folder.LANDMARKS_FOLDER) / folder.PLACES_FILE
        raise StgaError(
            f"{places}: face: its landmarks lie in one point of the head model; expected a face"
        )
    found = _with_timesteps(RecordedFootage(opened, detected, take))
    if not found.take.landmarks:
        raise StgaError(
            f"{opened.footage.root}: shows too few landmarks of a face in each of its frames"
        )
    return found


def with_focal(
    recorded: RecordedFootage, workers: Workers, likely: Camera | None
) -> RecordedFootage:
    """The footage of a single camera of unknown lens with a focal length that is estimated, or with
    that of `likely` where it is within the estimate's interval."""
    footage = recorded.footage
    if footage.focal != "usual":
        return recorded
    workers.report(Stage.FOCAL_LENGTH, 0, len(RATIOS))
    (camera,) = footage.cameras
    estimate: FocalEstimate = workers.helpers.run(
        estimated_focal,
        (recorded.opened.head, recorded.take),
        lambda steps: workers.report(Stage.FOCAL_LENGTH, steps, len(RATIOS)),
    )
    pixels = estimate.pixels
    source = "estimated"
    if likely is not None:
        sides = [max(own.width, own.height) for own in (camera.camera, likely)]
        known = likely.fl_x * sides[0] / sides[1]
        if estimate.low <= known <= estimate.high:
            pixels = known
            source = "avatar"
    moved = replace(camera, camera=replace(camera.camera, fl_x=pixels, fl_y=pixels))
    footage = replace(footage, cameras=(moved,), focal=source)
    opened = replace(recorded.opened, footage=footage)
    return _with_timesteps(replace(recorded, opened=opened, focal=estimate))


def in_world(recorded: RecordedFootage) -> RecordedFootage:
    """The footage whose cameras' world is known to be in meters or not."""
    opened = recorded.opened
    metric = opened.keeps_world and head_fit.is_metric(opened.head, recorded.take)
    return replace(recorded, take=replace(recorded.take, metric=metric))


def _detected(
    opened: OpenedFootage, workers: Workers
) -> tuple[dict[str, CameraLandmarks], RecordedTake]:
    """Where the networks find landmarks, kept in the folder; a take without landmarks yet."""
    out = opened.out
    footage = opened.footage
    is_begun = folder.is_begun(out)
    detector = FaceNetworks()
    workers.report(Stage.HEAD_MODEL, 0, 1)
    model = opened.head.model
    if opened.head_file is None and opened.options.person is None:
        places, reliable = read_places(BUNDLED_PLACES, len(model.faces))
    else:
        places, reliable = calibrate(model, detector, str(opened.head_file or BUNDLED_HEAD))
    begin_landmarks(opened)
    kept = out / folder.LANDMARKS_FOLDER
    write_places(kept / folder.PLACES_FILE, places, reliable)
    take = RecordedTake(places, reliable, {})
    workers.show(partial(picture_of_first_frame, opened.head, footage, detector, take), {})
    try:
        neutral = places.on(model.v_template, model.faces)
        unbiased = partial(without_bias, neutral=neutral, reliable=reliable)
        detected = detect_landmarks(footage, detector, unbiased, kept, workers)
        _check_faces(footage, detected)
        _check_fraction(footage, detected)
    except StgaError:
        if not is_begun:  # what it holds is of no use for other footage
            workers.helpers.end()  # which may be writing frames
            folder.clear(out)
        raise
    return detected, take


def _read(
    opened: OpenedFootage, landmarks: Path
) -> tuple[dict[str, CameraLandmarks], RecordedTake]:
    """The landmarks of a folder, and a take without landmarks yet."""
    footage = opened.footage
    detected = read_landmarks(footage, landmarks)
    _check_faces(footage, detected)
    places = read_places(landmarks / folder.PLACES_FILE, len(opened.head.model.faces))
    for timestep, camera in footage.views():
        if camera.kept:
            camera.image(timestep)  # in order, before helping processes ask for some
    begin_landmarks(opened)
    return detected, RecordedTake(*places, {})


def _neutral(opened: OpenedFootage, take: RecordedTake) -> np.ndarray:
    """(N, 3) meters: landmarks on the neutral head."""
    model = opened.head.model
    return take.places.on(model.v_template, model.faces)


def _with_timesteps(recorded: RecordedFootage) -> RecordedFootage:
    """With the timesteps that the head is fitted to, of landmarks that are reliable."""
    take = recorded.take
    neutral = _neutral(recorded.opened, take)
    seen: dict[int, list[tuple[FootageCamera, np.ndarray, np.ndarray]]]
    seen = {timestep: [] for timestep in recorded.footage.timesteps}
    for camera in recorded.footage.cameras:
        own = recorded.detected.get(camera.name)
        if own is not None and own.confidence.any():
            reliable = own.confidence * take.reliable
            rows = zip(own.timesteps.tolist(), own.points, reliable, strict=True)
            for timestep, points, confidence in rows:
                shown = points[confidence > 0]
                if len(shown) and (np.ptp(shown, axis=0) >= MIN_FACE_PIXELS).all():
                    seen[timestep].append((camera, points, confidence))
    landmarks = {}
    for timestep, views in seen.items():
        if views:
            cameras, points, confidence = zip(*views, strict=True)
            together = TimestepLandmarks(
                tuple(camera.camera for camera in cameras),
                np.stack(points),
                np.stack(confidence),
                tuple(camera.name for camera in cameras),
            )
            if head_fit.determines_pose(together, take.reliable, neutral):
                landmarks[timestep] = together
    return replace(recorded, take=replace(take, landmarks=landmarks))


def _check_faces(footage: Footage, found: Mapping[str, CameraLandmarks]) -> None:
    """Raise StgaError where no camera ever sees a face."""
    if not any(camera.confidence.any() for camera in found.values()):
        raise StgaError(
            f"{_first_frame(footage)}: shows no face, nor does any other of "
            f"{len(list(footage.views()))} frames; {FACE_REMEDY}"
        )


def _check_fraction(footage: Footage, found: Mapping[str, CameraLandmarks]) -> None:
    """Raise StgaError where faces are detected at so few timesteps that the take would be a
    guess."""
    seen = {
        timestep
        for camera in found.values()
        for timestep in camera.timesteps[camera.confidence.any(axis=1)].tolist()
    }
    total = len(footage.timesteps)
    if len(seen) < MIN_FACE_FRACTION * total:
        raise StgaError(
            f"{_first_frame(footage)}: a face, and one alone, is found at {len(seen)} of {total} "
            f"timesteps, expected {MIN_FACE_FRACTION:.0%} of them at least; {FACE_REMEDY}, or "
            "choose the frames that show it"
        )


def _first_frame(footage: Footage) -> str:
    timestep, camera = next(iter(footage.views()))
    return camera.source(timestep)
