"""Tracking of a head: footage and a head model to a capture."""

import hashlib
import shutil
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from os.path import realpath
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.camera import Camera
from ..capture.mesh_geometry import silhouette
from ..capture.model import evenly_spread
from ..capture.open import BUNDLED_MODEL
from ..errors import StgaError
from ..files import read_json, replacing, write_json
from ..flame.forward import RIGID_SIZE
from ..flame.model import BUNDLED_HEAD
from ..schema import to_json
from ..worker.helpers import Helpers
from .camera_scale import scale_warnings
from .contact_sheet import write_contact_sheet
from .correspondence import calibrate
from .dense import fit_dense
from .dense_head import REGIONS
from .face_networks import FaceNetworks
from .fit import (
    MAX_HEAD_SCALE,
    MIN_FACE_M,
    HeadFit,
    TimestepLandmarks,
    determines_pose,
    fit_head,
    in_cameras_world,
    is_face,
    is_metric,
)
from .focal_length import solved_focal
from .folder import LANDMARKS_FOLDER, PLACES_FILE, REPORT_FILE, SHEET_FILE, image_name, is_written
from .footage.model import Footage, FootageCamera
from .footage.stored import StoredFrames, with_stored
from .head_model import HeadModel, read_head_model
from .landmarks import (
    CameraLandmarks,
    Report,
    check_count,
    detect_landmarks,
    read_landmarks,
    read_places,
    write_landmarks,
    write_places,
)
from .mattes import with_mattes
from .pictures import Show, picture_of_first_frame, picture_of_fit
from .posed_points import PosedPoints, SurfacePoints
from .seen_surface import RecordedTake
from .surface import fit_surface
from .torso import follow_torso
from .torso_motion import TORSO_KEY, TorsoMotion, write_torso_points
from .write_capture import posed_mesh, write_capture

OUTLIER_FACTOR, MIN_OUTLIER_SHARE = 4.0, 0.03
"""A camera is at fault whose landmarks miss the fitted head by this many times those of the others, and by this share
of the face's size."""
MAX_USUAL_SHARE = 0.04
"""Median over the cameras, beyond which they do not see one head: up to 0.016 on sound footage; the demo's gives 0.06
where no camera is in step with another, and 0.2 mirrored."""


@dataclass(frozen=True)
class TrackingReport:
    """What `track` found, as written to tracking.json.

    reprojection_px  camera -> timestep -> median distance in pixels of its landmarks from those of the fitted head
    interpolated     timesteps without a face, filled from their neighbors
    scale            meters per unit of the cameras' world
    warnings         one sentence each
    image_misfit     region of the face -> timestep -> share of the images' points that are not explained, from 0 to 1;
                     empty for takes too short for dense tracking
    torso            how the torso moves; None where that cannot be told
    focal_px, focal  focal length of a single camera without a calibration, else None; and `Footage.focal`
    """

    reprojection_px: Mapping[str, Mapping[int, float]]
    interpolated: tuple[int, ...]
    scale: float
    warnings: tuple[str, ...]
    image_misfit: Mapping[str, Mapping[int, float]] = field(default_factory=dict)
    torso: TorsoMotion | None = None
    focal_px: float | None = None
    focal: str = "calibration"

    @property
    def median_px(self) -> float:
        return float(np.median([error for errors in self.reprojection_px.values() for error in errors.values()]))


def track(
    footage: Footage,
    head_file: Path | None,
    out: Path,
    landmarks: Path | None = None,
    meshes: bool = False,
    world: str = "auto",
    mattes: bool = True,
    report: Report = lambda stage, done, total: None,
    show: Show = lambda draw: None,
) -> TrackingReport:
    """Track the head that the footage shows, and write a capture into the folder `out`.

    head_file: a head model; None: the bundled one, which is copied into the capture.
    landmarks: folder of landmark files in place of the networks'.
    mattes: whether they are made for frames without a mask (`with_mattes`).
    What was detected is kept in OUT/landmarks, mattes in OUT/fg_masks, frames of videos in OUT/images: called again
    after an interruption, those cameras and frames are not worked on again. world: "head": meters as the head's size
    says, y up, the head near the origin; "keep": that of the cameras, which is scaled about its origin where it is not
    in meters; "auto": as the calibration says, else "head". show: given pictures of how the head fits, the first one
    within seconds.
    Raises StgaError.
    """
    if is_written(out):
        raise StgaError(f"{out}: already holds a capture; give another --out")
    if Path(realpath(out)) == footage.root:
        raise StgaError(f"{out}: is the folder of the footage; give another --out")
    head, is_new = read_head_model(head_file), not out.exists()
    footage, source = _stored(footage, out), _source(footage, head_file, landmarks)
    if landmarks is not None:
        found = read_landmarks(footage, landmarks)
        _check_faces(footage, found)
        places_file = landmarks / PLACES_FILE
        places, reliable = read_places(places_file, len(head.model.faces))
        _begin(out, source)
        for timestep, camera in footage.views():
            if isinstance(camera.frames, StoredFrames):
                camera.image(timestep)  # in order, before helping processes ask for some
    else:
        detector = FaceNetworks()
        report("Head model", 0, 1)
        places, reliable = calibrate(head.model, detector, str(head_file or BUNDLED_HEAD))
        _begin(out, source)
        places_file = out / LANDMARKS_FOLDER / PLACES_FILE
        write_places(places_file, places, reliable)
        show(partial(picture_of_first_frame, head, footage, detector, places, reliable))
        try:
            found = detect_landmarks(footage, detector, out / LANDMARKS_FOLDER, report)
            _check_faces(footage, found)
        except StgaError:
            if is_new:  # what it holds is of no use for other footage
                shutil.rmtree(out)
            raise
    check_count(found, places)
    neutral = places.on(head.model.v_template, head.model.faces)
    if np.ptp(neutral[reliable], axis=0).max() < MIN_FACE_M:
        raise StgaError(f"{places_file}: face: its landmarks lie in one point of the head model; expected a face")
    detected, found = found, _reliable(found, reliable)
    take = _take(footage, found, reliable, neutral)
    if not take:
        raise StgaError(f"{footage.root}: shows too few landmarks of a face in each of its frames")
    if footage.focal == "usual":
        report("Focal length", 0, 1)
        footage = _with_focal(footage, solved_focal(head, places, reliable, take))
        take = _take(footage, found, reliable, neutral)
    keep = world == "keep" or (world == "auto" and footage.keeps_world)
    metric = keep and is_metric(head, places, reliable, take)
    fit = fit_head(head, places, reliable, take, report, metric)
    _check_cameras(footage, reprojection_errors(fit, places, reliable, take, footage, found))
    show(partial(picture_of_fit, fit, footage))
    recorded = RecordedTake(places, reliable, take, partial(_images, footage), partial(_masks, footage), metric)
    with Helpers() as helpers:
        fit, misfits = by_images(head, fit, recorded, helpers, report)
    show(partial(picture_of_fit, fit, footage))
    fit = in_cameras_world(fit) if keep else fit
    errors = reprojection_errors(fit, places, reliable, take, footage, found)
    parameters = interpolated(fit.parameters, footage.timesteps)
    cameras = {camera.name: fit.to_capture.camera(camera.camera) for camera in footage.cameras}
    matte_warnings: tuple[str, ...] = ()
    if mattes:

        def head_pixels(timestep: int, camera: FootageCamera) -> np.ndarray:
            return silhouette(posed_mesh(fit, parameters[timestep]), fit.head.model.faces, cameras[camera.name])

        plates = [camera.plate for camera in footage.cameras if camera.plate is not None]
        source = {**source, "plates": [list(map(str, plates)), _state(plates)]}
        footage, matte_warnings = with_mattes(footage, head_pixels, out, source, report)
    torso = follow_torso(fit, parameters, footage, report)
    result = TrackingReport(
        {name: {t: px for t, (px, _) in own.items()} for name, own in errors.items()},
        tuple(t for t in footage.timesteps if t not in fit.parameters),
        fit.to_capture.scale,
        _warnings(footage, found, fit, keep and not metric)
        + scale_warnings(fit, places, reliable, footage, found)
        + matte_warnings,
        misfits,
        torso.motion,
        None if footage.focal == "calibration" else footage.cameras[0].camera.fl_x,
        footage.focal,
    )
    write_json(out / REPORT_FILE, _as_json(result))
    report("Contact sheet", 0, 1)
    write_contact_sheet(
        out / SHEET_FILE,
        footage,
        cameras,
        lambda timestep: posed_mesh(torso.fit, torso.parameters[timestep], torso.offsets.get(timestep)),
        fit.head.model.faces,
        result.reprojection_px,
        result.image_misfit,
    )
    if landmarks is not None:  # what a correction of the capture starts from
        write_landmarks(out / LANDMARKS_FOLDER, detected, places, reliable)
    if torso.points is not None:
        write_torso_points(out, torso.points)
    if head_file is None:
        with replacing(out / BUNDLED_MODEL) as copy:
            shutil.copyfile(BUNDLED_HEAD, copy)
    write_capture(out, footage, torso.fit, torso.parameters, torso.offsets, meshes, report)
    return result


def by_images(
    head: HeadModel,
    fit: HeadFit,
    take: RecordedTake,
    helpers: Helpers,
    report: Report = lambda stage, done, total: None,
) -> tuple[HeadFit, dict[str, dict[int, float]]]:
    """The fit moved onto what the images show, and region -> timestep -> how badly they are explained (`Misfit`); none
    where the take is too short for dense tracking. `fit` is what `fit_head` returns for `head`."""
    dense = fit_dense(fit, take, helpers, report=report)
    if dense is None:
        return fit_surface(head, fit, take, helpers, report), {}
    take = replace(take, landmarks=dense.landmarks)
    fit = fit_surface(head, dense.fit, take, helpers, report, dense=True)
    dense = fit_dense(fit, take, helpers, True, report)
    assert dense is not None
    regions = {t: own.regions.tolist() for t, own in dense.misfit.items()}
    return dense.fit, {name: {t: own[row] for t, own in regions.items()} for row, name in enumerate(REGIONS)}


def interpolated(parameters: Mapping[int, np.ndarray], timesteps: tuple[int, ...]) -> dict[int, np.ndarray]:
    """Parameters of all timesteps: linear between the known ones, constant before the first and after the last."""
    known = sorted(parameters)
    values = np.stack([parameters[timestep] for timestep in known])
    columns = np.stack([np.interp(timesteps, known, column) for column in values.T], axis=1)
    return dict(zip(timesteps, columns, strict=True))


def reprojection_errors(
    fit: HeadFit,
    places: SurfacePoints,
    reliable: np.ndarray,
    take: Mapping[int, TimestepLandmarks],
    footage: Footage,
    found: Mapping[str, CameraLandmarks],
) -> dict[str, dict[int, tuple[float, float]]]:
    """Camera -> timestep -> median distance of its landmarks from the fitted head's, in pixels and in face sizes."""
    points = PosedPoints(fit.head.model, places)
    errors: dict[str, dict[int, tuple[float, float]]] = {camera.name: {} for camera in footage.cameras}
    for timestep, parameters in fit.parameters.items():
        head = points.positions(parameters[:-RIGID_SIZE], parameters[-RIGID_SIZE:])
        cameras = [name for name, own in found.items() if _row(own, timestep) is not None]
        for name, camera, pixels, confidence in zip(
            cameras, take[timestep].cameras, take[timestep].points, take[timestep].confidence, strict=True
        ):
            use = reliable & (confidence > 0)
            projected, _ = fit.to_capture.camera(camera).project(head[use])
            distance = float(np.median(np.linalg.norm(projected - pixels[use], axis=1)))
            size = float(np.linalg.norm(np.ptp(pixels[use], axis=0)))
            errors[name][timestep] = distance, distance / max(size, 1e-9)
    return errors


def _source(footage: Footage, head_file: Path | None, landmarks: Path | None = None) -> dict[str, Any]:
    """What landmarks and mattes are of; landmarks: the folder that they were read from."""
    return {
        "footage": str(footage.root),
        "cameras": {camera.name: _recording(camera) for camera in footage.cameras},
        "timesteps": list(footage.timesteps),
        "head_model": [str(head_file.resolve()) if head_file else "", _state([head_file or BUNDLED_HEAD])],
        "landmarks": None if landmarks is None else realpath(landmarks),
    }


def _begin(out: Path, source: dict[str, Any]) -> None:
    """Record what the landmarks in `out` are of. Raises StgaError where it holds those of other footage."""
    path = out / LANDMARKS_FOLDER / "footage.json"
    if path.exists() and read_json(path) != source:
        raise StgaError(f"{out}: holds landmarks of other footage; give another --out, or delete it")
    write_json(path, source)


def _stored(footage: Footage, out: Path) -> Footage:
    """The footage whose videos are decoded once: their frames are kept as the capture's images."""
    images = {
        camera.name: {t: out / image_name(t, number) for t in camera.timesteps}
        for number, camera in enumerate(footage.cameras)
    }
    return with_stored(footage, images)


def _recording(camera: FootageCamera) -> list[Any]:
    """The first frame, the state of all files, and how frames are undistorted; it changes with offset and lens."""
    pinhole = camera.camera
    first = [camera.source(camera.timesteps[0]), _state(camera.frames.files)]
    if camera.undistortion is None:
        return first
    return [*first, repr(camera.undistortion.lens), pinhole.fl_x, pinhole.fl_y, pinhole.cx, pinhole.cy]


def _state(files: Iterable[Path]) -> str:
    """Changes with the size or the time of modification of one of the files."""
    states = [file.stat() for file in files]
    sizes = repr([(state.st_size, state.st_mtime_ns) for state in states])
    return hashlib.sha256(sizes.encode()).hexdigest()[:16]


def _reliable(found: Mapping[str, CameraLandmarks], reliable: np.ndarray) -> dict[str, CameraLandmarks]:
    """The landmarks with confidence 0 for those that are not reliable; cameras without a face have none at all."""
    return {
        name: replace(own, confidence=own.confidence * reliable) if own.confidence.any() else own
        for name, own in found.items()
    }


def _row(camera: CameraLandmarks, timestep: int) -> int | None:
    """The row of a timestep at which the camera sees a face."""
    rows = np.flatnonzero(camera.timesteps == timestep)
    if not len(rows) or not is_face(camera.points[rows[0]][camera.confidence[rows[0]] > 0]):
        return None
    return int(rows[0])


def _take(
    footage: Footage, found: Mapping[str, CameraLandmarks], reliable: np.ndarray, neutral: np.ndarray
) -> dict[int, TimestepLandmarks]:
    """The timesteps that the head is fitted to; neutral (N, 3): the landmarks on the neutral head."""
    everything = {timestep: _at(footage, found, timestep, len(neutral)) for timestep in footage.timesteps}
    return {timestep: own for timestep, own in everything.items() if determines_pose(own, reliable, neutral)}


def _with_focal(footage: Footage, pixels: float | None) -> Footage:
    """Footage of one camera with a solved focal length; as it is where there is none."""
    if pixels is None:
        return footage
    (camera,) = footage.cameras
    moved = replace(camera, camera=replace(camera.camera, fl_x=pixels, fl_y=pixels))
    return replace(footage, cameras=(moved,), focal="solved")


def _at(footage: Footage, found: Mapping[str, CameraLandmarks], timestep: int, count: int) -> TimestepLandmarks:
    cameras = {camera.name: camera.camera for camera in footage.cameras}
    rows = {name: row for name, own in found.items() if (row := _row(own, timestep)) is not None}
    return TimestepLandmarks(
        tuple(cameras[name] for name in rows),
        np.array([found[name].points[row] for name, row in rows.items()]).reshape(-1, count, 2),
        np.array([found[name].confidence[row] for name, row in rows.items()]).reshape(-1, count),
    )


def _images(footage: Footage, timestep: int, most: int | None = None) -> list[tuple[Camera, np.ndarray]]:
    cameras = _recording_at(footage, timestep, most)
    with ThreadPoolExecutor() as pool:  # decoding of a camera's images needs no lock of Python's
        images = list(pool.map(lambda camera: camera.image(timestep), cameras))
    return [(camera.camera, image) for camera, image in zip(cameras, images, strict=True)]


def _masks(footage: Footage, timestep: int, most: int | None = None) -> list[tuple[Camera, np.ndarray]]:
    cameras = _recording_at(footage, timestep, most)
    found = [(camera.camera, camera.mask(timestep)) for camera in cameras]
    return [(camera, mask) for camera, mask in found if mask is not None]


def _recording_at(footage: Footage, timestep: int, most: int | None) -> Sequence[FootageCamera]:
    seen = [camera for camera in footage.cameras if timestep in camera.timesteps]
    return seen if most is None else evenly_spread(seen, most)


def _check_faces(footage: Footage, found: Mapping[str, CameraLandmarks]) -> None:
    """Raise StgaError where no camera ever sees a face."""
    if not any(camera.confidence.any() for camera in found.values()):
        views = list(footage.views())
        raise StgaError(f"{views[0][1].source(views[0][0])}: shows no face, nor does any other of {len(views)} frames")


def _check_cameras(footage: Footage, errors: Mapping[str, Mapping[int, tuple[float, float]]]) -> None:
    """Raise StgaError for a camera whose landmarks do not fit the head that the others see, or where none fits."""
    share = {name: float(np.median([part for _, part in own.values()])) for name, own in errors.items() if own}

    def at_worst(name: str) -> str:
        worst = max(errors[name], key=lambda timestep: errors[name][timestep][1])
        return f"camera {name}: its landmarks are off by {errors[name][worst][0]:.0f} pixels at timestep {worst}"

    for name, value in share.items():
        others = [other for other_name, other in share.items() if other_name != name] or [value]
        if value > max(MIN_OUTLIER_SHARE, OUTLIER_FACTOR * float(np.median(others))):
            raise StgaError(
                f"{at_worst(name)}, far more than those of the other cameras; "
                "check its calibration, synchronization and mirroring"
            )
    if len(share) > 1 and float(np.median(list(share.values()))) > MAX_USUAL_SHARE:
        raise StgaError(
            f"{at_worst(max(share, key=share.__getitem__))}, and those of the other cameras are too; "
            "check the calibration, and whether all are synchronized and none mirrored"
        )


def _warnings(footage: Footage, found: Mapping[str, CameraLandmarks], fit: HeadFit, is_scaled: bool) -> tuple[str, ...]:
    missing = [timestep for timestep in footage.timesteps if timestep not in fit.parameters]
    blind = [name for name, own in found.items() if not own.confidence.any()]
    warnings = list(footage.warnings)
    if missing:
        listed = ", ".join(map(str, missing[:20])) + (", …" if len(missing) > 20 else "")
        warnings.append(f"no face at {len(missing)} of {len(footage.timesteps)} timesteps, interpolated: {listed}")
    if blind:
        warnings.append(f"no face in any frame of: {', '.join(blind)}")
    if len(footage.cameras) == 1:
        warnings.append("one camera: size and distance of the head, and its depth, are those of the average head")
    elif fit.static_offset is None:
        warnings.append(
            "the images do not show the skin's surface sharply enough: the head is fitted to landmarks alone"
        )
    if is_scaled:
        warnings.append(
            f"the cameras' world is kept but for its scale: in meters, the head would be more than "
            f"{MAX_HEAD_SCALE - 1:.0%} off people's; positions are multiplied by {fit.to_capture.scale:.4g}"
        )
    if footage.focal == "usual":
        warnings.append("the focal length is a guess, as the head turns too little to tell; give it if it is known")
    return tuple(warnings)


def _as_json(result: TrackingReport) -> dict[str, Any]:
    return {
        "median_reprojection_px": round(result.median_px, 3),
        "meters_per_unit": result.scale,
        "interpolated": list(result.interpolated),
        "warnings": list(result.warnings),
        "reprojection_px": _rounded(result.reprojection_px),
        "image_misfit": _rounded(result.image_misfit),
        "focal_length_px": None if result.focal_px is None else round(result.focal_px, 1),
        "focal_length_from": result.focal,
        TORSO_KEY: None if result.torso is None else to_json(result.torso),
    }


def _rounded(values: Mapping[str, Mapping[int, float]]) -> dict[str, dict[str, float]]:
    return {name: {str(timestep): round(value, 3) for timestep, value in own.items()} for name, own in values.items()}
