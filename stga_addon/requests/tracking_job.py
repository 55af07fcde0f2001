"""Tracking jobs: written into a capture's folder by Blender, carried out by a worker.

CAPTURE/job/tracking.json  what to track; or that a tracked capture is to be solved again
CAPTURE/job/keys.npz       the heads posed by hand, for the latter
besides the files of the worker's status folder
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from ..errors import StgaError
from ..files import read_json, read_npz, write_json, write_npz
from ..tracking.folder import is_written
from ..worker.launch import prepare_status_folder
from ..worker.status import StatusWriter, remove_status_folder, status_writer
from .training_job import job_folder

FORMAT, VERSION = "stga-tracking", 1
JOB, KEYS = "tracking.json", "keys.npz"
STAGES = {
    "Head model": (0.0, 0.05),
    "Landmarks": (0.05, 0.6),
    "Fit": (0.6, 0.75),
    "Surface": (0.75, 0.9),
    "Contact sheet": (0.9, 0.92),
    "Images": (0.92, 0.97),
    "Heads": (0.97, 1.0),
}
"""Stage of `tracking.track` -> the share of the progress that it begins and ends with."""


@dataclass(frozen=True)
class TrackingJob:
    """What to track.

    footage  None: solve the tracked capture again around the keys
    model    head model file
    cameras, landmarks, detector, focal, start, stop, step  as of `stga track`
    """

    footage: Path | None
    model: Path
    cameras: Path | None = None
    landmarks: Path | None = None
    detector: Path | None = None
    focal: float | None = None
    start: int = 0
    stop: int | None = None
    step: int = 1


PATHS = ("footage", "model", "cameras", "landmarks", "detector")


def write_tracking_job(capture: Path, job: TrackingJob, keys: Mapping[int, np.ndarray] | None = None) -> None:
    """Prepare a capture's folder for the job's worker; keys: timestep -> parameters, where it is solved again.

    Raises StgaError while a worker is in the folder, where it holds a capture already (to solve again: none), or on a
    full disk.
    """
    if job.footage is None and not is_written(capture):
        raise StgaError(f"{capture}: holds no tracked capture to solve again")
    if job.footage is not None and is_written(capture):
        raise StgaError(f"{capture}: already holds a capture; choose another folder")
    folder = job_folder(capture)
    prepare_status_folder(folder)
    (folder / KEYS).unlink(missing_ok=True)
    if keys is not None:
        write_npz(folder / KEYS, {str(timestep): values for timestep, values in keys.items()})
    values = {name: str(value) if name in PATHS and value else value for name, value in asdict(job).items()}
    write_json(folder / JOB, {"format": FORMAT, "version": VERSION, **values})


def read_tracking_job(capture: Path) -> TrackingJob:
    """Raises StgaError where the folder holds no tracking job, or a damaged one."""
    path = job_folder(capture) / JOB
    values = read_json(path)
    if not isinstance(values, dict) or (values.pop("format", None), values.pop("version", None)) != (FORMAT, VERSION):
        raise StgaError(f"{path}: is not a tracking job that this version reads (format '{FORMAT}', version {VERSION})")
    try:
        footage, cameras, landmarks, detector = (
            None if values[name] is None else Path(values[name])
            for name in ("footage", "cameras", "landmarks", "detector")
        )
        focal, stop = values["focal"], values["stop"]
        return TrackingJob(
            footage,
            Path(values["model"]),
            cameras,
            landmarks,
            detector,
            focal=None if focal is None else float(focal),
            start=int(values["start"]),
            stop=None if stop is None else int(stop),
            step=int(values["step"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise StgaError(f"{path}: a field is missing or malformed ({error!s:.200})") from error


def is_tracking_job(capture: Path) -> bool:
    return (job_folder(capture) / JOB).is_file()


def remove_tracking_job(capture: Path) -> None:
    """Remove the job and its status; what was tracked stays. Raises StgaError while its worker is running."""
    remove_status_folder(job_folder(capture), (JOB, KEYS))


class _Cancelled(Exception):
    pass


def run_tracking_job(capture: Path) -> None:
    """Carry out the job, with its status in the job's folder. Raises what tracking raises.

    Cancelled, it leaves the landmarks of whole cameras, with which the next job continues.
    """
    with status_writer(job_folder(capture)) as writer:
        writer.update(0.0, "Starting")
        with suppress(_Cancelled):
            _run(capture, read_tracking_job(capture), writer)


def _run(capture: Path, job: TrackingJob, writer: StatusWriter) -> None:
    from ..tracking.footage.open import open_footage
    from ..tracking.footage.sequences import FrameRange
    from ..tracking.track import track

    def report(stage: str, done: int, total: int) -> None:
        begin, end = STAGES.get(stage, (0.0, 0.9))
        share = begin + (end - begin) * done / max(total, 1)
        if writer.update(share, stage, f"{done} of {total}" if total > 1 else ""):
            raise _Cancelled

    if job.footage is None:
        from ..tracking.correct import correct_capture

        keys = {int(name): values for name, values in read_npz(job_folder(capture) / KEYS).items()}
        correct_capture(capture, job.model, keys, report=report)
        return
    report("Opening the footage", 0, 1)
    frames = FrameRange(job.start, job.stop, job.step)
    footage = open_footage(job.footage, job.cameras, frames, job.focal)
    result = track(footage, job.model, capture, job.landmarks, job.detector, report=report)
    writer.update(1.0, "Tracked", f"Reprojection error {result.median_px:.1f} px (median)")
