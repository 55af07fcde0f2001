"""Tracking of a head: footage and a head model to a capture."""

import hashlib
import shutil
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from os.path import realpath
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.mesh_geometry import silhouette
from ..capture.model import evenly_spread
from ..capture.open import BUNDLED_MODEL
from ..errors import StgaError
from ..files import read_json, replacing, write_json
from ..flame.forward import parameters_at
from ..flame.model import BUNDLED_HEAD
from ..schema import to_json
from ..worker.helpers import Helpers
from . import fit as head_fit
from . import folder
from .correspondence import calibrate
from .dense import fit_dense
from .dense_head import REGIONS
from .face_networks import FaceNetworks
from .fit import HeadFit, KnownPerson, Pictures, RecordedTake, TimestepLandmarks, posed_mesh
from .focal_length import scale_warnings, solved_focal
from .footage.model import Footage, FootageCamera
from .head_model import HeadModel, read_head_model
from .landmarks import (
    CameraLandmarks,
    Report,
    check_count,
    detect_landmarks,
    landmark_file,
    read_landmarks,
    read_places,
    write_camera,
    write_places,
)
from .mattes import with_mattes
from .pictures import Show, picture_of_first_frame, picture_of_fit, write_contact_sheet
from .posed_points import PosedPoints, split
from .surface import fit_surface
from .torso import follow_torso
from .write_capture import write_capture

OUTLIER_FACTOR = 4.0
MIN_OUTLIER_SHARE = 0.03
"""A camera is at fault whose landmarks miss the fitted head by this many times those of the others,
and by this share of the face's size."""
MAX_USUAL_SHARE = 0.04
"""Median over the cameras, beyond which they do not see one head: up to 0.016 on sound footage; the
demo's gives 0.06 where no camera is in step with another, and 0.2 mirrored."""
MIN_FACE_SHARE = 1 / 3  # Of the timesteps, at which a face has to be detected
FACE_REMEDY = "where the face is too small in the frame, crop the video to head and shoulders"
MIN_FACE_PIXELS = 1.0  # Extent of the landmarks in an image, below which they are but a point
BIAS_ROUNDS = 3
BIAS_TIMESTEPS = 12
"""Rounds in which the networks' bias is measured, each on heads fitted without that of the round
before, and timesteps at which the avatar is drawn for that."""
LONG_TAKE = 50  # From which the fit is worth a helping process: threads slow its small matrices

Errors = dict[str, dict[int, tuple[float, float]]]
"""Camera -> timestep -> landmarks' median distance from the head's: pixels, face sizes."""


@dataclass(frozen=True)
class TrackingReport:
    """What a person is told of a tracking; tracking.json has more.

    median_px        median distance in pixels of all landmarks from those of the fitted head
    scale            meters per unit of the cameras' world
    warnings         one sentence each
    torso            how the torso moves; None where that cannot be told
    focal_px, focal  focal length of a single camera without a calibration, else None; and
                     `Footage.focal`
    """

    median_px: float
    scale: float
    warnings: tuple[str, ...]
    torso: folder.TorsoMotion | None
    focal_px: float | None
    focal: str


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
    person: KnownPerson | None = None,
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
    person: known from another take, with `head_file`'s shapes: then only scale, expressions and
    poses are sought, without the networks' bias, and `end_tracking` is the caller's. The only
    camera has the focal length of the person's, where neither its file nor the head's turns tell.
    Raises StgaError.
    """
    if folder.is_written(out):
        raise StgaError(f"{out}: already holds a capture; give another --out")
    if Path(realpath(out)) == footage.root:
        raise StgaError(f"{out}: is the folder of the footage; give another --out")
    head = read_head_model(head_file) if person is None else person.fit.head
    footage, source = _stored(footage, out), _source(footage, head_file, landmarks, head)
    with Helpers(folder=out / folder.KEPT_FOLDER) as helpers:
        if landmarks is None:
            take, detected = _detected(head, head_file, footage, source, out, helpers, report, show)
        else:
            detected = read_landmarks(footage, landmarks)
            _check_faces(footage, detected)
            places = read_places(landmarks / folder.PLACES_FILE, len(head.model.faces))
            take = RecordedTake(*places, {})
            for timestep, camera in footage.views():
                if camera.kept:
                    camera.image(timestep)  # in order, before helping processes ask for some
            _begin(out, source)
        check_count(detected, take.places)
        neutral = take.places.on(head.model.v_template, head.model.faces)
        if np.ptp(neutral[take.reliable], axis=0).max() < head_fit.MIN_FACE_M:
            raise StgaError(
                f"{(landmarks or out / folder.LANDMARKS_FOLDER) / folder.PLACES_FILE}: face: its "
                "landmarks lie in one point of the head model; expected a face"
            )
        found = {  # confidence 0 for those that are not reliable; without a face, there are none
            name: replace(own, confidence=own.confidence * take.reliable)
            if own.confidence.any()
            else own
            for name, own in detected.items()
        }
        take = _recorded(footage, found, take, neutral)
        if not take.landmarks:
            few = "shows too few landmarks of a face in each of its frames"
            raise StgaError(f"{footage.root}: {few}")
        if footage.focal == "usual":  # of one camera
            report("Focal length", 0, 1)
            (camera,) = footage.cameras
            pixels = solved_focal(head, take)
            told_by = "solved"
            if pixels is None and person is not None and person.camera is not None:
                sides = [max(own.width, own.height) for own in (camera.camera, person.camera)]
                pixels = person.camera.fl_x * sides[0] / sides[1]
                told_by = "avatar"
            if pixels is not None:
                moved = replace(camera, camera=replace(camera.camera, fl_x=pixels, fl_y=pixels))
                footage = replace(footage, cameras=(moved,), focal=told_by)
            take = _recorded(footage, found, take, neutral)
        keep = footage.keeps(world)
        take = replace(take, metric=keep and head_fit.is_metric(head, take))
        report("Fit", 0, head_fit.ROUNDS)
        if person is not None and landmarks is None:
            take = _without_bias(take, person, helpers, report)

        def count(rounds: int) -> None:
            report("Fit", rounds, head_fit.ROUNDS)

        fit: HeadFit = (
            helpers.map(head_fit.fit_head, [(head, take)], count)[0]
            if len(take.landmarks) < LONG_TAKE
            else helpers.run(head_fit.fit_head, (head, take), count)
        )
        errors = reprojection_errors(fit, take, footage)
        _check_cameras(errors)
        show(partial(picture_of_fit, fit, footage), {"error_px": _median_px(errors)})
        images, masks = (
            partial(_pictures, footage, of) for of in (FootageCamera.image, FootageCamera.mask)
        )
        take = replace(take, images=images, masks=masks)
        fit, misfits = by_images(head, fit, take, helpers, report, person is not None)
        if person is not None:
            shape = person.fit.shape
            offset = person.fit.static_offset
            fit = replace(fit, shape=shape, static_offset=offset)
        fit = head_fit.in_cameras_world(fit) if keep else fit
        errors = reprojection_errors(fit, take, footage)
        shares = [share for own in misfits.values() for share in own.values()]
        quality = {"error_px": _median_px(errors)}
        quality |= {"unexplained": float(np.mean(shares))} if shares else {}
        show(partial(picture_of_fit, fit, footage), quality)
        parameters = interpolated(fit.parameters, footage.timesteps)
        warnings = _warnings(footage, found, fit, keep and not take.metric)
        warnings += scale_warnings(fit, take)
        if mattes:
            plates = [camera.plate for camera in footage.cameras if camera.plate is not None]
            source = {**source, "plates": [list(map(str, plates)), _state(plates)]}
            head_pixels = partial(_head_pixels, fit, parameters)
            footage, unseen = with_mattes(footage, head_pixels, out, source, helpers, report)
            warnings += unseen
        torso = follow_torso(fit, parameters, footage, helpers, report, person is None)
    pixels_of = {name: {t: px for t, (px, _) in own.items()} for name, own in errors.items()}
    focal = None if footage.focal == "calibration" else footage.cameras[0].camera.fl_x
    write_json(
        out / folder.REPORT_FILE,
        {
            "median_reprojection_px": round(_median_px(errors), 3),
            "meters_per_unit": fit.to_capture.scale,
            "interpolated": [t for t in footage.timesteps if t not in fit.parameters],
            "in_order": fit.ordered,
            "warnings": list(warnings),
            "reprojection_px": folder.rounded(pixels_of),
            "image_misfit": folder.rounded(misfits),
            "focal_length_px": None if focal is None else round(focal, 1),
            "focal_length_from": footage.focal,
            folder.TORSO_KEY: None if torso.motion is None else to_json(torso.motion),
        },
    )
    report("Contact sheet", 0, 1)
    write_contact_sheet(
        out / folder.SHEET_FILE,
        footage,
        {camera.name: fit.to_capture.camera(camera.camera) for camera in footage.cameras},
        torso.mesh,
        fit.head.model.faces,
        pixels_of,
        misfits,
    )
    if landmarks is not None:  # what a correction of the capture starts from
        kept = out / folder.LANDMARKS_FOLDER
        for name, own in detected.items():
            write_camera(landmark_file(kept, name), own)
        write_places(kept / folder.PLACES_FILE, take.places, take.reliable)
    if torso.points is not None:
        folder.write_torso_points(out, torso.points)
    if head_file is None:
        with replacing(out / BUNDLED_MODEL) as copy:
            shutil.copyfile(BUNDLED_HEAD, copy)
    write_capture(out, footage, torso, meshes, report)
    if person is None:
        end_tracking(out)
    scale = fit.to_capture.scale
    return TrackingReport(_median_px(errors), scale, warnings, torso.motion, focal, footage.focal)


def end_tracking(out: Path) -> None:
    """Remove what an interrupted tracking goes on from: the capture is whole."""
    shutil.rmtree(out / folder.KEPT_FOLDER, ignore_errors=True)


def _detected(
    head: HeadModel,
    head_file: Path | None,
    footage: Footage,
    source: dict[str, Any],
    out: Path,
    helpers: Helpers,
    report: Report,
    show: Show,
) -> tuple[RecordedTake, dict[str, CameraLandmarks]]:
    """A take without landmarks yet, and where the networks find them, kept in `out`."""
    is_begun = folder.is_begun(out)
    detector = FaceNetworks()
    report("Head model", 0, 1)
    places, reliable = calibrate(head.model, detector, str(head_file or BUNDLED_HEAD))
    _begin(out, source)
    kept = out / folder.LANDMARKS_FOLDER
    write_places(kept / folder.PLACES_FILE, places, reliable)
    take = RecordedTake(places, reliable, {})
    show(partial(picture_of_first_frame, head, footage, detector, take), {})
    try:
        detected = detect_landmarks(footage, detector, kept, helpers, report)
        _check_faces(footage, detected)
        _check_share(footage, detected)
    except StgaError:
        if not is_begun:  # what it holds is of no use for other footage
            helpers.end()  # which may be writing frames
            folder.clear(out)
        raise
    return take, detected


def _head_pixels(
    fit: HeadFit, parameters: Mapping[int, np.ndarray], timestep: int, camera: FootageCamera
) -> np.ndarray:
    """The pixels of the tracked head in a camera's frame; see `mattes.HeadPixels`."""
    mesh = posed_mesh(fit, parameters[timestep])
    faces = fit.head.model.faces
    return silhouette(mesh, faces, fit.to_capture.camera(camera.camera))


def _without_bias(
    take: RecordedTake, person: KnownPerson, helpers: Helpers, report: Report
) -> RecordedTake:
    """The take, each camera's landmarks corrected by the networks' bias: how far, in the median,
    they are off in pictures of the avatar, drawn with fitted heads as the camera sees them.

    From an unusual direction they are off by the same in pictures of the person, whatever the
    light.
    """
    networks = FaceNetworks()
    corrected = take
    some = evenly_spread(sorted(take.landmarks), BIAS_TIMESTEPS)
    for _ in range(BIAS_ROUNDS):
        part = replace(corrected, landmarks={t: corrected.landmarks[t] for t in some})
        work = head_fit.fit_head, (person.fit.head, part)
        fit: HeadFit = helpers.run(*work, lambda steps: report("Fit", 0, head_fit.ROUNDS))
        points = PosedPoints(fit.head.model, take.places)
        shares: dict[str, list[np.ndarray]] = {}
        for timestep, values in fit.parameters.items():
            own = take.landmarks[timestep]
            mesh = posed_mesh(fit, values)
            head = points.positions(*split(values))
            cameras = map(fit.to_capture.camera, own.cameras)
            for name, camera in zip(own.names, cameras, strict=True):
                faces = networks.detect(person.draw(mesh, camera))
                if len(faces) == 1:
                    away = faces[0] - camera.project(head)[0]
                    shares.setdefault(name, []).append(away / _face_size(faces[0]))
        bias = {name: np.median(found, axis=0) for name, found in shares.items()}
        moved = {}
        for timestep, own in take.landmarks.items():
            seen = zip(own.names, own.points, strict=True)
            at = [pixels - bias.get(name, 0.0) * _face_size(pixels) for name, pixels in seen]
            moved[timestep] = replace(own, points=np.stack(at))
        corrected = replace(take, landmarks=moved)
    return corrected


def _face_size(pixels: np.ndarray) -> float:
    return float(np.linalg.norm(np.ptp(pixels, axis=0)))


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


def interpolated(
    parameters: Mapping[int, np.ndarray], timesteps: tuple[int, ...]
) -> dict[int, np.ndarray]:
    """Parameters of all timesteps: between the known ones, constant before and after."""
    known = np.array(sorted(parameters))
    values = np.stack([parameters[timestep] for timestep in known.tolist()])
    found = parameters_at(np.array(timesteps), known, values)
    return dict(zip(timesteps, found, strict=True))


def reprojection_errors(fit: HeadFit, take: RecordedTake, footage: Footage) -> Errors:
    """How far the landmarks of all cameras lie from those of the fitted head."""
    points = PosedPoints(fit.head.model, take.places)
    errors: Errors = {camera.name: {} for camera in footage.cameras}
    for timestep, parameters in fit.parameters.items():
        head = points.positions(*split(parameters))
        own = take.landmarks[timestep]
        seen = zip(own.names, own.cameras, own.points, own.confidence, strict=True)
        for name, camera, pixels, confidence in seen:
            use = take.reliable & (confidence > 0)
            away = fit.to_capture.camera(camera).project(head[use])[0] - pixels[use]
            distance = float(np.median(np.linalg.norm(away, axis=1)))
            errors[name][timestep] = distance, distance / max(_face_size(pixels[use]), 1e-9)
    return errors


def _median_px(errors: Errors) -> float:
    return float(np.median([pixels for own in errors.values() for pixels, _ in own.values()]))


def is_of_footage(out: Path, footage: Footage) -> bool:
    """Whether the tracking in a folder, whole or interrupted, is of this footage."""
    path = out / folder.FOOTAGE_FILE
    stored = read_json(path) if path.exists() else None
    return isinstance(stored, dict) and stored.items() >= footage_state(footage).items()


def footage_state(footage: Footage) -> dict[str, Any]:
    """Of each camera the first frame, the state of all files, and the undistortion; as JSON."""
    cameras = {}
    for camera in footage.cameras:
        own: list[Any] = [camera.source(camera.timesteps[0]), _state(camera.frames.files)]
        if camera.undistortion is not None:
            pinhole = camera.camera
            intrinsics = pinhole.fl_x, pinhole.fl_y, pinhole.cx, pinhole.cy
            own += [repr(camera.undistortion.lens), *intrinsics]
        cameras[camera.name] = own
    timesteps = list(footage.timesteps)
    return {"footage": str(footage.root), "cameras": cameras, "timesteps": timesteps}


def _source(
    footage: Footage, head_file: Path | None, landmarks: Path | None, head: HeadModel
) -> dict[str, Any]:
    """What landmarks and mattes are of; landmarks: the folder that they were read from."""
    model = str(head_file.resolve()) if head_file else ""
    template = hashlib.sha256(head.model.v_template.tobytes()).hexdigest()[:16]
    return {
        **footage_state(footage),
        "head_model": [model, _state([head_file or BUNDLED_HEAD]), template],
        "landmarks": None if landmarks is None else realpath(landmarks),
    }


def _state(files: Iterable[Path]) -> str:
    """Changes with the size or the time of modification of one of the files."""
    states = [file.stat() for file in files]
    sizes = repr([(state.st_size, state.st_mtime_ns) for state in states])
    return hashlib.sha256(sizes.encode()).hexdigest()[:16]


def _begin(out: Path, source: dict[str, Any]) -> None:
    """Record what the landmarks in `out` are of. Raises StgaError for other footage's."""
    path = out / folder.FOOTAGE_FILE
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
            kept = {t: out / folder.image_name(t, number) for t in camera.timesteps}
            camera = replace(camera, kept=kept)
        cameras.append(camera)
    return replace(footage, cameras=tuple(cameras))


def _recorded(
    footage: Footage, found: Mapping[str, CameraLandmarks], take: RecordedTake, neutral: np.ndarray
) -> RecordedTake:
    """The timesteps that the head is fitted to. neutral (N, 3): landmarks on the neutral head."""
    seen: dict[int, list[tuple[FootageCamera, np.ndarray, np.ndarray]]]
    seen = {timestep: [] for timestep in footage.timesteps}
    for camera in footage.cameras:
        if camera.name in found:
            own = found[camera.name]
            rows = zip(own.timesteps.tolist(), own.points, own.confidence, strict=True)
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
    return replace(take, landmarks=landmarks)


def _pictures(
    footage: Footage,
    picture: Callable[[FootageCamera, int], np.ndarray | None],
    timestep: int,
    most: int | None = None,
) -> Pictures:
    """The cameras that recorded a timestep, at most so many of them, with their pictures."""
    cameras = [camera for camera in footage.cameras if timestep in camera.timesteps]
    cameras = cameras if most is None else evenly_spread(cameras, most)
    with ThreadPoolExecutor() as pool:  # decoding of a camera's images needs no lock of Python's
        pictures = list(pool.map(lambda camera: picture(camera, timestep), cameras))
    pairs = zip(cameras, pictures, strict=True)
    return [(camera.camera, own) for camera, own in pairs if own is not None]


def _check_faces(footage: Footage, found: Mapping[str, CameraLandmarks]) -> None:
    """Raise StgaError where no camera ever sees a face."""
    if not any(camera.confidence.any() for camera in found.values()):
        raise StgaError(
            f"{_first_frame(footage)}: shows no face, nor does any other of "
            f"{len(list(footage.views()))} frames; {FACE_REMEDY}"
        )


def _check_share(footage: Footage, found: Mapping[str, CameraLandmarks]) -> None:
    """Raise StgaError where faces are detected at so few timesteps that the take would be a
    guess."""
    seen = {
        timestep
        for camera in found.values()
        for timestep in camera.timesteps[camera.confidence.any(axis=1)].tolist()
    }
    total = len(footage.timesteps)
    if len(seen) < MIN_FACE_SHARE * total:
        raise StgaError(
            f"{_first_frame(footage)}: a face, and one alone, is found at {len(seen)} of {total} "
            f"timesteps, expected {MIN_FACE_SHARE:.0%} of them at least; {FACE_REMEDY}, or choose "
            "the frames that show it"
        )


def _first_frame(footage: Footage) -> str:
    timestep, camera = next(iter(footage.views()))
    return camera.source(timestep)


def _check_cameras(errors: Errors) -> None:
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
    single = len(footage.cameras) == 1
    scale = f"{fit.to_capture.scale:.4g}"
    own = {
        f"no face at {share}, interpolated: {listed}": bool(missing),
        f"no face in any frame of: {', '.join(blind)}": bool(blind),
        "one camera: size and distance of the head, and its depth, are those of the average "
        "head": single,
        "the images do not show the skin's surface sharply enough: the head is fitted to "
        "landmarks alone": not single and fit.static_offset is None,
        "the cameras' world is kept but for its scale: in meters, the head would be more than "
        f"{head_fit.MAX_HEAD_SCALE - 1:.0%} off people's; positions are multiplied by "
        f"{scale}": is_scaled,
        "the focal length is a guess, as the head turns too little to tell; "
        "give it if it is known": footage.focal in ("usual", "avatar"),
    }
    return *footage.warnings, *(text for text, holds in own.items() if holds)
