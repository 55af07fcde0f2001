"""A training job: written into the run's folder by whoever wants it, carried out by a worker of its own.

RUN/job/job.json       the capture and the settings
RUN/job/selection.npz  timestep -> triangles to train, where they were painted
RUN/job/preview.npz    the avatar as it was a few seconds ago
beside what every task has (`task`)
"""

import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..avatar.file import Avatar, write_avatar
from ..capture.open import open_capture
from ..errors import StgaError
from ..files import read_json, write_json, write_npz
from ..training.settings import TrainingSettings, from_json, to_json
from ..worker.launch import prepare_status_folder
from ..worker.status import StatusWriter, remove_status_folder, status_writer

if TYPE_CHECKING:
    from ..training.run.progress import Progress, Report

FORMAT, VERSION = "stga-job", 1
JOB, SELECTION, PREVIEW = "job.json", "selection.npz", "preview.npz"
PREVIEW_S = 4.0
"""Seconds between two previews."""


@dataclass(frozen=True)
class TrainingJob:
    """What to train: the capture with what it takes to open it, and the settings; None continues the run there is."""

    capture: Path
    flame: Path | None
    principal_point: str
    settings: TrainingSettings | None


def job_folder(run: Path) -> Path:
    """The job's folder, inside that of the run: they move together."""
    return run / "job"


def write_job(run: Path, job: TrainingJob, selection: Mapping[int, np.ndarray] | None = None) -> None:
    """Make a run's folder ready for the job's worker.

    selection: timestep -> (F,) bool, to be trained instead of what the rule selects.
    Raises StgaError while a worker is there, where there is a run already (none, to continue), or on a full disk.
    """
    folder = job_folder(run)
    has_run = (run / "run.json").exists()
    if has_run and job.settings is not None:
        raise StgaError(f"{run}: already holds a run; resume it, or choose another folder")
    if not has_run and job.settings is None:
        raise StgaError(f"{run}: holds no run that could be resumed (run.json is missing)")
    prepare_status_folder(folder)
    for stale in (SELECTION, PREVIEW):
        (folder / stale).unlink(missing_ok=True)
    if selection is not None:
        write_npz(folder / SELECTION, {f"{t:05d}": faces for t, faces in selection.items()}, compressed=True)
    write_json(
        folder / JOB,
        {
            "format": FORMAT,
            "version": VERSION,
            "capture": str(job.capture),
            "flame": None if job.flame is None else str(job.flame),
            "principal_point": job.principal_point,
            "settings": None if job.settings is None else to_json(job.settings),
        },
    )


def read_job(run: Path) -> TrainingJob:
    """Raises StgaError where the run's folder holds no job, or a damaged one."""
    path = job_folder(run) / JOB
    values = read_json(path)
    if not isinstance(values, dict) or (values.get("format"), values.get("version")) != (FORMAT, VERSION):
        raise StgaError(f"{path}: is not a job that this version reads (format '{FORMAT}', version {VERSION})")
    try:
        flame, settings = values["flame"], values["settings"]
        return TrainingJob(
            Path(values["capture"]),
            None if flame is None else Path(flame),
            str(values["principal_point"]),
            None if settings is None else from_json(settings),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise StgaError(f"{path}: a field is missing or malformed ({error})") from error


def remove_job(run: Path) -> None:
    """Remove the files of the run's job and its status; a folder that holds no job stays as it is.

    Raises StgaError while its worker is running.
    """
    try:
        read_job(run)
    except StgaError:
        return
    remove_status_folder(job_folder(run), (JOB, SELECTION, PREVIEW))


def worker_arguments(run: Path) -> list[str]:
    """What a worker's interpreter runs, after `-m`."""
    return ["stga_addon", "job", str(run.resolve())]


def run_training_job(run: Path, also: "Report | None" = None) -> Path:
    """Carry out the run's job, telling in its folder how far it is; returns the path of the avatar.

    also: called as well after every iteration.
    Raises what training raises; the sentence is in the folder, too.
    """
    folder = job_folder(run)
    if not (folder / JOB).is_file():  # before anything is written into a folder that is none of ours
        raise StgaError(f"{run}: holds no job (job/{JOB} is missing)")
    with status_writer(folder) as writer:
        writer.update(0.0, "Starting")
        from ..effects.plan import with_effect_plan
        from ..training.optimize.device import choose_device
        from ..training.run.folder import Run, read_run, read_selection
        from ..training.run.loop import train

        job = read_job(run)
        capture = open_capture(job.capture, job.flame, job.principal_point)
        selection = None
        if (folder / SELECTION).exists():
            selection = read_selection(folder, len(capture.faces))
        device, why = choose_device("auto")
        writer.update(0.0, why)
        if job.settings is None:
            wanted = read_run(run)
        else:
            writer.update(0.0, "Analyzing the capture")
            wanted = with_effect_plan(Run(capture.root, job.flame, job.principal_point, job.settings), capture, device)
        report = _Report(writer, also)
        return train(capture, run, wanted, selection, job.settings is None, report, device)


class _Report:
    """What training calls after every iteration: passes it on, and leaves a preview now and then."""

    def __init__(self, writer: StatusWriter, also: "Report | None") -> None:
        self.writer, self.also = writer, also
        self.previewed = time.monotonic()

    def __call__(self, progress: "Progress") -> bool:
        stop = self.writer.update(progress.share, progress.message, progress.forecast_text, progress.figures)
        if progress.avatar is not None and time.monotonic() - self.previewed > PREVIEW_S:
            self._preview(progress.avatar())
            self.previewed = time.monotonic()
        return bool(self.also and self.also(progress)) or stop

    def _preview(self, avatar: Avatar) -> None:
        with suppress(StgaError):  # training goes on without; where the disk is full, it will say so itself
            write_avatar(self.writer.folder / PREVIEW, avatar)
