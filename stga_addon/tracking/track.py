"""Tracking of a head: footage and a head model to a capture, stage by stage."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

from ..capture.open import BUNDLED_MODEL
from ..files import replacing, write_json
from ..flame.model import BUNDLED_HEAD
from ..schema import to_json
from ..worker.helpers import Helpers
from . import folder
from .fitted_head import TrackedHead, fit_expressions, fit_landmarks, fit_skin, with_torso
from .footage.model import Footage
from .known_person import KnownPerson, without_measured_bias
from .landmarks import landmark_file, write_camera, write_places
from .opened import DEFAULT_OPTIONS, OpenedFootage, TrackingOptions, open_take
from .pictures import PosedHead, write_contact_sheet
from .recorded import RecordedFootage, in_world, record, with_focal
from .reprojection import median_px
from .stages import ReportStage, Show, Stage, Workers, unreported, unseen
from .write_capture import write_capture


@dataclass(frozen=True)
class TrackingReport:
    """What a tracking reports to a person; tracking.json has more.

    median_px        median distance in pixels of all landmarks from those of the fitted head
    scale            meters per unit of the cameras' world
    warnings         one sentence each
    torso            how the torso moves; None where that is not known
    focal_length     of a single camera without calibration, else None
    """

    median_px: float
    scale: float
    warnings: tuple[str, ...]
    torso: folder.TorsoMotion | None
    focal_length: folder.FocalLength | None


def track(
    footage: Footage,
    head_file: Path | None,
    out: Path,
    options: TrackingOptions = DEFAULT_OPTIONS,
    report: ReportStage = unreported,
    show: Show = unseen,
) -> TrackingReport:
    """Track the head that the footage shows, and write a capture into the folder `out`.

    head_file: a head model; None: the bundled one, which is copied into the capture.
    What was detected is kept in OUT/landmarks, mattes in OUT/fg_masks, frames of videos in
    OUT/images, and in OUT/unfinished what helping processes found: called again after an
    interruption, that is not worked on again.
    show: given pictures and figures of how the head fits, the first one within seconds.
    Raises StgaError.
    """
    opened = open_take(footage, head_file, out, options)
    person = options.person
    with Helpers(folder=out / folder.KEPT_FOLDER) as helpers:
        workers = Workers(helpers, report, show)
        head = _stranger(opened, workers) if person is None else _known(opened, person, workers)
    written = _write(head, workers)
    if person is None or person.draw is None:
        end_tracking(out)
    return written


def _stranger(opened: OpenedFootage, workers: Workers) -> TrackedHead:
    """The stages of a person who is seen for the first time."""
    recorded = record(opened, workers)
    recorded = in_world(with_focal(recorded, workers, None))
    fitted = fit_landmarks(recorded, workers)
    fitted = fit_skin(fitted, workers)
    return with_torso(fitted, workers, bends=True)


def _known(opened: OpenedFootage, person: KnownPerson, workers: Workers) -> TrackedHead:
    """The stages of a person who is known. The only camera has the focal length of the person's,
    where its file does not have it and the landmarks allow it."""
    recorded = record(opened, workers)
    recorded = in_world(with_focal(recorded, workers, person.camera))
    if opened.options.landmarks is None and person.draw is not None:
        recorded = replace(recorded, take=without_measured_bias(recorded.take, person, workers))
    fitted = fit_landmarks(recorded, workers)
    fitted = fit_expressions(fitted, person.fit, workers)
    return with_torso(fitted, workers, bends=False)


def end_tracking(out: Path) -> None:
    """Remove what an interrupted tracking goes on from: the capture is whole."""
    shutil.rmtree(out / folder.KEPT_FOLDER, ignore_errors=True)


def _write(head: TrackedHead, workers: Workers) -> TrackingReport:
    """The last stage: report, contact sheet, and the capture."""
    recorded = head.fitted.recorded
    opened = recorded.opened
    out = opened.out
    fit = head.fitted.fit
    torso = head.torso
    focal = _focal_length(head)
    focal_values = dict.fromkeys(folder.FOCAL_KEYS) if focal is None else to_json(focal)
    median = median_px(head.errors)
    pixels = {
        name: {t: px for t, (px, _) in by_timestep.items()}
        for name, by_timestep in head.errors.items()
    }
    values = {
        "median_reprojection_px": round(median, 3),
        "meters_per_unit": fit.to_capture.scale,
        "interpolated": [t for t in head.footage.timesteps if t not in fit.parameters],
        "in_order": fit.ordered,
        "warnings": list(head.warnings),
        "reprojection_px": folder.rounded(pixels),
        "image_misfit": folder.rounded(head.fitted.misfits),
        **{key: focal_values[name] for name, key in folder.FOCAL_KEYS.items()},
        folder.TORSO_KEY: None if torso.motion is None else to_json(torso.motion),
    }
    write_json(out / folder.REPORT_FILE, values)
    workers.report(Stage.CONTACT_SHEET, 0, 1)
    cameras = {camera.name: fit.to_capture.camera(camera.camera) for camera in head.footage.cameras}
    posed = PosedHead(cameras, torso.mesh, fit.head.model.faces)
    sheet = out / folder.SHEET_FILE
    write_contact_sheet(sheet, head.footage, posed, pixels, head.fitted.misfits)
    if opened.options.landmarks is not None:
        _keep_landmarks(out, recorded)
    if torso.points is not None:
        folder.write_torso_points(out, torso.points)
    if opened.head_file is None:
        with replacing(out / BUNDLED_MODEL) as copy:
            shutil.copyfile(BUNDLED_HEAD, copy)
    write_capture(out, head.footage, torso, opened.options.meshes, workers.report)
    return TrackingReport(median, fit.to_capture.scale, head.warnings, torso.motion, focal)


def _focal_length(head: TrackedHead) -> folder.FocalLength | None:
    if head.footage.focal == "calibration":
        return None
    pixels = round(head.footage.cameras[0].camera.fl_x, 1)
    estimate = head.fitted.recorded.focal
    interval = None if estimate is None else (round(estimate.low, 1), round(estimate.high, 1))
    return folder.FocalLength(pixels, head.footage.focal, interval)


def _keep_landmarks(out: Path, recorded: RecordedFootage) -> None:
    """What a correction of the capture starts from, where it was read from another folder."""
    kept = out / folder.LANDMARKS_FOLDER
    for name, landmarks in recorded.detected.items():
        write_camera(landmark_file(kept, name), landmarks)
    write_places(kept / folder.PLACES_FILE, recorded.take.places, recorded.take.reliable)
