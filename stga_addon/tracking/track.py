"""Tracking of a head: footage and a head model to a capture."""

import hashlib
import shutil
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from os.path import realpath
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.mesh_geometry import silhouette
from ..capture.model import evenly_spread
from ..capture.open import BUNDLED_MODEL
from ..errors import StgaError
from ..files import read_json, replacing, write_json
from ..flame.model import BUNDLED_HEAD
from ..schema import to_json
from ..worker.helpers import Helpers
from .correspondence import calibrate
from .dense import fit_dense
from .dense_head import REGIONS
from .face_networks import FaceNetworks
from .fit import (
    MAX_HEAD_SCALE,
    MIN_FACE_M,
    ROUNDS,
    HeadFit,
    Pictures,
    RecordedTake,
    TimestepLandmarks,
    determines_pose,
    fit_head,
    in_cameras_world,
    is_face,
    is_metric,
    posed_mesh,
)
from .focal_length import scale_warnings, solved_focal
from .folder import (
    KEPT_FOLDER,
    LANDMARKS_FOLDER,
    PLACES_FILE,
    REPORT_FILE,
    SHEET_FILE,
    TORSO_KEY,
    TorsoMotion,
    image_name,
    is_written,
    write_torso_points,
)
from .footage.model import Footage, FootageCamera
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
from .pictures import Show, picture_of_first_frame, picture_of_fit, write_contact_sheet
from .posed_points import PosedPoints, SurfacePoints, split
from .surface import fit_surface
from .torso import follow_torso
from .write_capture import write_capture

OUTLIER_FACTOR, MIN_OUTLIER_SHARE = 4.0, 0.03
"""A camera is at fault whose landmarks miss the fitted head by this many times those of the others,
and by this share of the face's size."""
MAX_USUAL_SHARE = 0.04
"""Median over the cameras, beyond which they do not see one head: up to 0.016 on sound footage; the
demo's gives 0.06 where no camera is in step with another, and 0.2 mirrored."""


LONG_TAKE = 50
"""From which the fit is worth a helping process: its small matrices are slower in threads."""


@dataclass(frozen=True)
class TrackingReport:
    """What `track` found, as written to tracking.json.

    reprojection_px  camera -> timestep -> median distance in pixels of its landmarks from those of
                     the fitted head
    interpolated     timesteps without a face, filled from their neighbors
    scale            meters per unit of the cameras' world
    warnings         one sentence each
    image_misfit     region of the face -> timestep -> share of the images' points that are not
                     explained, from 0 to 1; empty for takes too short for dense tracking
    torso            how the torso moves; None where that cannot be told
    focal_px, focal  focal length of a single camera without a calibration, else None; and
                     `Footage.focal`
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
        return _median_px(self.reprojection_px)


def track(
    footage: Footage,
    head_file: Path | None,
    out: Path,
    landmarks: Path | None = None,
    meshes: bool = False,
    world: str = "auto",
    mattes: bool = True,
    report: Report = lambda stage, done, total: None,
    show: Show = lambda draw, figures: None,
    person: HeadFit | None = None,
) -> TrackingReport:
    """Track the head that the footage shows, and write a capture into the folder `out`.

    head_file: a head model; None: the bundled one, which is copied into the capture.
    landmarks: folder of landmark files in place of the networks'.
    mattes: whether they are made for frames without a mask (`with_mattes`).
    What was detected is kept in OUT/landmarks, mattes in OUT/fg_masks, frames of videos in
    OUT/images, and in OUT/unfinished what helping processes found: called again after an
    interruption, that is not worked on again.
    world: "head": meters as the head's size says, y up, the head near the origin; "keep": that of
    the cameras, which is scaled about its origin where it is not in meters; "auto": as the
    calibration says, else "head".
    show: given pictures and figures of how the head fits, the first one within seconds.
    person: whose head is known from another take, with `head_file`'s shapes: then only scale,
    expressions and poses are sought, and `end_tracking` is the caller's.
    Raises StgaError.
    """
    if is_written(out):
        raise StgaError(f"{out}: already holds a capture; give another --out")
    if Path(realpath(out)) == footage.root:
        raise StgaError(f"{out}: is the folder of the footage; give another --out")
    head = read_head_model(head_file) if person is None else person.head
    footage, source = _stored(footage, out), _source(footage, head_file, landmarks, head)
    with Helpers(folder=out / KEPT_FOLDER) as helpers:
        if landmarks is None:
            seen = _detected(head, head_file, footage, source, out, helpers, report, show)
        else:
            detected = read_landmarks(footage, landmarks)
            _check_faces(footage, detected)
            places, reliable = read_places(landmarks / PLACES_FILE, len(head.model.faces))
            seen = _Seen(places, reliable, detected)
            for timestep, camera in footage.views():
                if camera.kept:
                    camera.image(timestep)  # in order, before helping processes ask for some
            _begin(out, source)
        check_count(seen.detected, seen.places)
        neutral = seen.places.on(head.model.v_template, head.model.faces)
        if np.ptp(neutral[seen.reliable], axis=0).max() < MIN_FACE_M:
            raise StgaError(
                f"{(landmarks or out / LANDMARKS_FOLDER) / PLACES_FILE}: face: its landmarks lie "
                "in one point of the head model; expected a face"
            )
        take = _take(footage, seen, neutral)
        if not take.landmarks:
            few = "shows too few landmarks of a face in each of its frames"
            raise StgaError(f"{footage.root}: {few}")
        if footage.focal == "usual":  # of one camera
            report("Focal length", 0, 1)
            pixels = solved_focal(head, take)
            if pixels is not None:
                (camera,) = footage.cameras
                moved = replace(camera, camera=replace(camera.camera, fl_x=pixels, fl_y=pixels))
                footage = replace(footage, cameras=(moved,), focal="solved")
            take = _take(footage, seen, neutral)
        keep = world == "keep" or (world == "auto" and footage.keeps_world)
        take = replace(take, metric=keep and is_metric(head, take))
        report("Fit", 0, ROUNDS)

        def count(rounds: int) -> None:
            report("Fit", rounds, ROUNDS)

        fit: HeadFit = (
            helpers.map(fit_head, [(head, take)], count)[0]
            if len(take.landmarks) < LONG_TAKE
            else helpers.run(fit_head, (head, take), count)
        )
        errors = reprojection_errors(fit, take, footage, seen.found)
        _check_cameras(footage, errors)
        show(partial(picture_of_fit, fit, footage), {"error_px": _median_px(errors)})
        take = replace(take, images=partial(_images, footage), masks=partial(_masks, footage))
        fit, misfits = by_images(head, fit, take, helpers, report, person is not None)
        if person is not None:
            fit = replace(fit, shape=person.shape, static_offset=person.static_offset)
        fit = in_cameras_world(fit) if keep else fit
        errors = reprojection_errors(fit, take, footage, seen.found)
        shares = [share for own in misfits.values() for share in own.values()]
        quality = {"error_px": _median_px(errors)}
        quality |= {"unexplained": float(np.mean(shares))} if shares else {}
        show(partial(picture_of_fit, fit, footage), quality)
        parameters = interpolated(fit.parameters, footage.timesteps)
        matte_warnings: tuple[str, ...] = ()
        if mattes:
            plates = [camera.plate for camera in footage.cameras if camera.plate is not None]
            source = {**source, "plates": [list(map(str, plates)), _state(plates)]}
            head_pixels = partial(_head_pixels, fit, parameters)
            footage, matte_warnings = with_mattes(
                footage, head_pixels, out, source, helpers, report
            )
        torso = follow_torso(fit, parameters, footage, helpers, report, person is None)
    result = TrackingReport(
        {name: {t: px for t, (px, _) in own.items()} for name, own in errors.items()},
        tuple(t for t in footage.timesteps if t not in fit.parameters),
        fit.to_capture.scale,
        _warnings(footage, seen.found, fit, keep and not take.metric)
        + scale_warnings(fit, take, footage, seen.found)
        + matte_warnings,
        misfits,
        torso.motion,
        None if footage.focal == "calibration" else footage.cameras[0].camera.fl_x,
        footage.focal,
    )
    write_json(
        out / REPORT_FILE,
        {
            "median_reprojection_px": round(result.median_px, 3),
            "meters_per_unit": result.scale,
            "interpolated": list(result.interpolated),
            "in_order": fit.ordered,
            "warnings": list(result.warnings),
            "reprojection_px": _rounded(result.reprojection_px),
            "image_misfit": _rounded(result.image_misfit),
            "focal_length_px": None if result.focal_px is None else round(result.focal_px, 1),
            "focal_length_from": result.focal,
            TORSO_KEY: None if result.torso is None else to_json(result.torso),
        },
    )
    report("Contact sheet", 0, 1)
    cameras = {camera.name: fit.to_capture.camera(camera.camera) for camera in footage.cameras}
    pixels_of, misfit_of = result.reprojection_px, result.image_misfit

    def mesh(timestep: int) -> np.ndarray:
        return posed_mesh(torso.fit, torso.parameters[timestep], torso.offsets.get(timestep))

    faces = fit.head.model.faces
    write_contact_sheet(out / SHEET_FILE, footage, cameras, mesh, faces, pixels_of, misfit_of)
    if landmarks is not None:  # what a correction of the capture starts from
        write_landmarks(out / LANDMARKS_FOLDER, seen.detected, seen.places, seen.reliable)
    if torso.points is not None:
        write_torso_points(out, torso.points)
    if head_file is None:
        with replacing(out / BUNDLED_MODEL) as copy:
            shutil.copyfile(BUNDLED_HEAD, copy)
    write_capture(out, footage, torso.fit, torso.parameters, torso.offsets, meshes, report)
    if person is None:
        end_tracking(out)
    return result


def end_tracking(out: Path) -> None:
    """Remove what an interrupted tracking goes on from: the capture is whole."""
    shutil.rmtree(out / KEPT_FOLDER, ignore_errors=True)


@dataclass(frozen=True)
class _Seen:
    """Landmarks: places on the head model, which are reliable, and by camera as detected."""

    places: SurfacePoints
    reliable: np.ndarray
    detected: Mapping[str, CameraLandmarks]

    @cached_property
    def found(self) -> dict[str, CameraLandmarks]:
        """Confidence 0 for those that are not reliable; cameras without a face have none."""
        return {
            name: replace(own, confidence=own.confidence * self.reliable)
            if own.confidence.any()
            else own
            for name, own in self.detected.items()
        }


def _detected(
    head: HeadModel, head_file: Path | None, footage: Footage, source: dict[str, Any], out: Path,
    helpers: Helpers, report: Report, show: Show,
) -> _Seen:  # fmt: skip
    """The landmarks that the networks find, kept in `out`."""
    is_new, detector = not out.exists(), FaceNetworks()
    report("Head model", 0, 1)
    places, reliable = calibrate(head.model, detector, str(head_file or BUNDLED_HEAD))
    _begin(out, source)
    write_places(out / LANDMARKS_FOLDER / PLACES_FILE, places, reliable)
    show(partial(picture_of_first_frame, head, footage, detector, places, reliable), {})
    try:
        detected = detect_landmarks(footage, detector, out / LANDMARKS_FOLDER, helpers, report)
        _check_faces(footage, detected)
    except StgaError:
        if is_new:  # what it holds is of no use for other footage
            helpers.end()  # which may be writing frames
            shutil.rmtree(out)
        raise
    return _Seen(places, reliable, detected)


def _head_pixels(
    fit: HeadFit, parameters: Mapping[int, np.ndarray], timestep: int, camera: FootageCamera
) -> np.ndarray:
    """The pixels of the tracked head in a camera's frame; see `mattes.HeadPixels`."""
    mesh, faces = posed_mesh(fit, parameters[timestep]), fit.head.model.faces
    return silhouette(mesh, faces, fit.to_capture.camera(camera.camera))


def by_images(
    head: HeadModel,
    fit: HeadFit,
    take: RecordedTake,
    helpers: Helpers,
    report: Report = lambda stage, done, total: None,
    is_person: bool = False,
) -> tuple[HeadFit, dict[str, dict[int, float]]]:
    """The fit moved onto what the images show, and region -> timestep -> how badly they are
    explained (`Misfit`); none where the take is too short for dense tracking. `fit` is what
    `fit_head` returns for `head`. is_person: the surface is known, and need not be sought."""
    dense = fit_dense(fit, take, helpers, report=report)
    if dense is None:
        return fit if is_person else fit_surface(head, fit, take, helpers, report), {}
    if not is_person:
        take = replace(take, landmarks=dense.landmarks)
        fit = fit_surface(head, dense.fit, take, helpers, report, dense=True)
        dense = fit_dense(fit, take, helpers, True, report)
        assert dense is not None
    misfits = {t: dict(zip(REGIONS, own.tolist(), strict=True)) for t, own in dense.misfit.items()}
    return dense.fit, {name: {t: own[name] for t, own in misfits.items()} for name in REGIONS}


def _median_px(errors: Mapping[str, Mapping[int, float | tuple[float, float]]]) -> float:
    """Of `reprojection_errors`, or of the pixels in them."""
    every = [np.ravel(error)[0] for own in errors.values() for error in own.values()]
    return float(np.median(every))


def interpolated(
    parameters: Mapping[int, np.ndarray], timesteps: tuple[int, ...]
) -> dict[int, np.ndarray]:
    """Parameters of all timesteps: linear between the known ones, constant before and after."""
    known = sorted(parameters)
    values = np.stack([parameters[timestep] for timestep in known]).T
    columns = np.stack([np.interp(timesteps, known, column) for column in values], axis=1)
    return dict(zip(timesteps, columns, strict=True))


def reprojection_errors(
    fit: HeadFit, take: RecordedTake, footage: Footage, found: Mapping[str, CameraLandmarks]
) -> dict[str, dict[int, tuple[float, float]]]:
    """Camera -> timestep -> landmarks' median distance from the head's: pixels, face sizes."""
    points = PosedPoints(fit.head.model, take.places)
    errors: dict[str, dict[int, tuple[float, float]]]
    errors = {camera.name: {} for camera in footage.cameras}
    for timestep, parameters in fit.parameters.items():
        head, own = points.positions(*split(parameters)), take.landmarks[timestep]
        cameras = [name for name, seen in found.items() if _row(seen, timestep) is not None]
        seen = zip(cameras, own.cameras, own.points, own.confidence, strict=True)
        for name, camera, pixels, confidence in seen:
            use = take.reliable & (confidence > 0)
            away = fit.to_capture.camera(camera).project(head[use])[0] - pixels[use]
            distance = float(np.median(np.linalg.norm(away, axis=1)))
            size = float(np.linalg.norm(np.ptp(pixels[use], axis=0)))
            errors[name][timestep] = distance, distance / max(size, 1e-9)
    return errors


def _source(
    footage: Footage, head_file: Path | None, landmarks: Path | None, head: HeadModel
) -> dict[str, Any]:
    """What landmarks and mattes are of; landmarks: the folder that they were read from."""
    model = str(head_file.resolve()) if head_file else ""
    template = hashlib.sha256(head.model.v_template.tobytes()).hexdigest()[:16]
    return {
        "footage": str(footage.root),
        "cameras": {camera.name: _recording(camera) for camera in footage.cameras},
        "timesteps": list(footage.timesteps),
        "head_model": [model, _state([head_file or BUNDLED_HEAD]), template],
        "landmarks": None if landmarks is None else realpath(landmarks),
    }


def _begin(out: Path, source: dict[str, Any]) -> None:
    """Record what the landmarks in `out` are of. Raises StgaError for other footage's."""
    path = out / LANDMARKS_FOLDER / "footage.json"
    if path.exists() and read_json(path) != source:
        other = "holds landmarks of other footage; give another --out, or delete it"
        raise StgaError(f"{out}: {other}")
    write_json(path, source)


def _stored(footage: Footage, out: Path) -> Footage:
    """The footage whose undistorted frames that are no files yet are decoded once: they are kept as
    the capture's images. A file that exists is that of the frame."""
    cameras = []
    for number, camera in enumerate(footage.cameras):
        if camera.undistortion is None and camera.file(camera.timesteps[0]) is None:
            kept = {t: out / image_name(t, number) for t in camera.timesteps}
            camera = replace(camera, kept=kept)
        cameras.append(camera)
    return replace(footage, cameras=tuple(cameras))


def _recording(camera: FootageCamera) -> list[Any]:
    """The first frame, the state of all files, and the undistortion; offsets change it."""
    pinhole = camera.camera
    first = [camera.source(camera.timesteps[0]), _state(camera.frames.files)]
    if camera.undistortion is None:
        return first
    intrinsics = pinhole.fl_x, pinhole.fl_y, pinhole.cx, pinhole.cy
    return [*first, repr(camera.undistortion.lens), *intrinsics]


def _state(files: Iterable[Path]) -> str:
    """Changes with the size or the time of modification of one of the files."""
    states = [file.stat() for file in files]
    sizes = repr([(state.st_size, state.st_mtime_ns) for state in states])
    return hashlib.sha256(sizes.encode()).hexdigest()[:16]


def _row(camera: CameraLandmarks, timestep: int) -> int | None:
    """The row of a timestep at which the camera sees a face."""
    rows = np.flatnonzero(camera.timesteps == timestep)
    if not len(rows) or not is_face(camera.points[rows[0]][camera.confidence[rows[0]] > 0]):
        return None
    return int(rows[0])


def _take(footage: Footage, seen: _Seen, neutral: np.ndarray) -> RecordedTake:
    """The timesteps that the head is fitted to. neutral (N, 3): landmarks on the neutral head."""
    cameras = {camera.name: camera.camera for camera in footage.cameras}
    take = {}
    for timestep in footage.timesteps:
        rows = {name: _row(own, timestep) for name, own in seen.found.items()}
        found = [(name, row) for name, row in rows.items() if row is not None]
        points = np.array([seen.found[name].points[row] for name, row in found])
        confidence = np.array([seen.found[name].confidence[row] for name, row in found])
        own = TimestepLandmarks(
            tuple(cameras[name] for name, _ in found),
            points.reshape(-1, len(neutral), 2),
            confidence.reshape(-1, len(neutral)),
        )
        if determines_pose(own, seen.reliable, neutral):
            take[timestep] = own
    return RecordedTake(seen.places, seen.reliable, take)


def _images(footage: Footage, timestep: int, most: int | None = None) -> Pictures:
    cameras = _recording_at(footage, timestep, most)
    with ThreadPoolExecutor() as pool:  # decoding of a camera's images needs no lock of Python's
        images = list(pool.map(lambda camera: camera.image(timestep), cameras))
    return [(camera.camera, image) for camera, image in zip(cameras, images, strict=True)]


def _masks(footage: Footage, timestep: int, most: int | None = None) -> Pictures:
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
        first = views[0][1].source(views[0][0])
        raise StgaError(f"{first}: shows no face, nor does any other of {len(views)} frames")


def _check_cameras(
    footage: Footage, errors: Mapping[str, Mapping[int, tuple[float, float]]]
) -> None:
    """Raise StgaError for a camera that does not fit what others see, or where none fits."""
    seen = {name: [part for _, part in own.values()] for name, own in errors.items() if own}
    share = {name: float(np.median(own)) for name, own in seen.items()}

    def at_worst(name: str) -> str:
        worst, (pixels, _) = max(errors[name].items(), key=lambda error: error[1][1])
        return f"camera {name}: its landmarks are off by {pixels:.0f} pixels at timestep {worst}"

    for name, value in share.items():
        others = [share[other] for other in share if other != name] or [value]
        if value > max(MIN_OUTLIER_SHARE, OUTLIER_FACTOR * float(np.median(others))):
            raise StgaError(
                f"{at_worst(name)}, far more than those of the other cameras; "
                "check its calibration, synchronization and mirroring"
            )
    if len(share) > 1 and float(np.median(list(share.values()))) > MAX_USUAL_SHARE:
        raise StgaError(
            f"{at_worst(max(share, key=share.__getitem__))}, and those of the other cameras are "
            "too; check the calibration, and whether all are synchronized and none mirrored"
        )


def _warnings(
    footage: Footage, found: Mapping[str, CameraLandmarks], fit: HeadFit, is_scaled: bool
) -> tuple[str, ...]:
    missing = [timestep for timestep in footage.timesteps if timestep not in fit.parameters]
    blind = [name for name, own in found.items() if not own.confidence.any()]
    listed = ", ".join(map(str, missing[:20])) + (", …" if len(missing) > 20 else "")
    share = f"{len(missing)} of {len(footage.timesteps)} timesteps"
    single, scale = len(footage.cameras) == 1, f"{fit.to_capture.scale:.4g}"
    own = {
        f"no face at {share}, interpolated: {listed}": bool(missing),
        f"no face in any frame of: {', '.join(blind)}": bool(blind),
        "one camera: size and distance of the head, and its depth, are those of the average "
        "head": single,
        "the images do not show the skin's surface sharply enough: the head is fitted to "
        "landmarks alone": not single and fit.static_offset is None,
        "the cameras' world is kept but for its scale: in meters, the head would be more than "
        f"{MAX_HEAD_SCALE - 1:.0%} off people's; positions are multiplied by {scale}": is_scaled,
        "the focal length is a guess, as the head turns too little to tell; "
        "give it if it is known": footage.focal == "usual",
    }
    return *footage.warnings, *(text for text, holds in own.items() if holds)


def _rounded(values: Mapping[str, Mapping[int, float]]) -> dict[str, dict[str, float]]:
    return {name: {str(t): round(v, 3) for t, v in own.items()} for name, own in values.items()}
