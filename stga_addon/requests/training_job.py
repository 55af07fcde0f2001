"""Training jobs: written into a run's folder by Blender, carried out by a worker.

RUN/job/job.json       the capture, the device and the settings
RUN/job/selection.npz  timestep -> triangles to train, where they were painted
RUN/job/region.npz     weight of each triangle, where a painted region is refined
RUN/job/preview.npz    the avatar of a few seconds ago
besides the files of the worker's status folder
"""

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..avatar.file import Avatar, write_avatar
from ..capture.model import Capture
from ..capture.open import open_capture
from ..capture.region import write_region
from ..errors import StgaError, shorten
from ..files import read_json, write_json, write_npz
from ..render.device import choose_device, is_device
from ..training.run.folder import SELECTION, Run, read_run
from ..training.run.open_run import device_of, open_run
from ..training.run.request import Extension, Request, request_from_json, request_to_json
from ..training.settings import TrainingSettings, from_json, to_json
from ..worker.launch import prepare_status_folder
from ..worker.status import StatusWriter, remove_status_folder, status_writer

if TYPE_CHECKING:
    from ..training.run.continuation import Prepared
    from ..training.run.progress import Progress, Report

FORMAT, VERSION = "stga-job", 3
JOB, PREVIEW, REGION = "job.json", "preview.npz", "region.npz"
PREVIEW_S = 4.0
"""Seconds between two previews."""


@dataclass(frozen=True)
class TrainingJob:
    """What to train.

    settings  None to resume the run in the folder, or to continue another one
    device    as `render.device.is_device` allows; "auto" resumes a run on the device that it was trained on
    continues what is asked of a run that continues another one, which the folder is to hold
    """

    capture: Path
    flame: Path | None
    principal_point: str
    settings: TrainingSettings | None
    device: str = "auto"
    continues: Request | None = None

    @property
    def resumes(self) -> bool:
        return self.settings is None and self.continues is None


def job_folder(run: Path) -> Path:
    """The job's folder: inside that of the run, so that they move together."""
    return run / "job"


def write_job(
    run: Path,
    job: TrainingJob,
    selection: Mapping[int, np.ndarray] | None = None,
    region: np.ndarray | None = None,
) -> None:
    """Prepare a run's folder for the job's worker.

    selection: timestep -> (F,) bool, to be trained instead of what the rule selects.
    region: (F,) weight of each triangle in a painted region, for the file that the job refines.
    Raises StgaError while a worker is in the folder, where it holds a run already (to resume: none), or on a full disk.
    Whether a run to resume was trained on this capture, which takes reading it, the worker finds out.
    """
    folder = job_folder(run)
    if job.resumes:
        read_run(run)
    elif (run / "run.json").exists():
        raise StgaError(f"{run}: already holds a run; resume it, or choose another folder")
    prepare_status_folder(folder)
    for stale in (SELECTION, PREVIEW, REGION):
        (folder / stale).unlink(missing_ok=True)
    if selection is not None:
        write_npz(folder / SELECTION, {f"{t:05d}": faces for t, faces in selection.items()}, compressed=True)
    if region is not None:
        write_region(folder / REGION, region)
    write_json(
        folder / JOB,
        {
            "format": FORMAT,
            "version": VERSION,
            "capture": str(job.capture),
            "flame": None if job.flame is None else str(job.flame),
            "principal_point": job.principal_point,
            "device": job.device,
            "settings": None if job.settings is None else to_json(job.settings),
            "continues": request_to_json(job.continues),
        },
    )


def read_job(run: Path) -> TrainingJob:
    """Raises StgaError where the run's folder holds no job, or a damaged one."""
    path = job_folder(run) / JOB
    values = read_json(path)
    if not isinstance(values, dict) or (values.get("format"), values.get("version")) != (FORMAT, VERSION):
        raise StgaError(f"{path}: is not a job that this version reads (format '{FORMAT}', version {VERSION})")
    try:
        flame, settings, device = values["flame"], values["settings"], values["device"]
        if not is_device(device):
            raise ValueError(f"device is {shorten(device)}")
        return TrainingJob(
            Path(values["capture"]),
            None if flame is None else Path(flame),
            str(values["principal_point"]),
            None if settings is None else from_json(settings),
            device,
            request_from_json(values["continues"]),
        )
    except StgaError as error:
        raise StgaError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise StgaError(f"{path}: a field is missing or malformed ({error!s:.200})") from error


def remove_job(run: Path) -> None:
    """Remove the files of the run's job and its status; a folder that holds no job stays as it is.

    Raises StgaError while its worker is running.
    """
    try:
        read_job(run)
    except StgaError:
        return
    remove_status_folder(job_folder(run), (JOB, SELECTION, PREVIEW, REGION))


def worker_arguments(folder: Path) -> list[str]:
    """Arguments of the worker's interpreter, after `-m`; folder: a run with a job, or a video job."""
    return ["stga_addon", "job", str(folder.resolve())]


def run_training_job(run: Path, also: "Report | None" = None) -> Path:
    """Carry out the run's job, with its status in the job's folder; return the path of the avatar.

    also: called as well after every iteration.
    Raises what training raises; the message is in the final status, too.
    """
    folder = job_folder(run)
    if not (folder / JOB).is_file():  # before anything is written into a folder that may be of something else
        raise StgaError(f"{run}: holds no job (job/{JOB} is missing)")
    with status_writer(folder) as writer:
        writer.update(0.0, "Starting")
        from ..training.run.loop import train

        job = read_job(run)
        prepared = _prepare(run, job, lambda stage: writer.update(0.0, stage))
        return train(
            prepared.capture, run, prepared.run, prepared.selection, job.resumes, _Report(writer, also),
            falls_back=job.device == "auto",
        )  # fmt: skip


def _prepare(folder: Path, job: TrainingJob, report: Callable[[str], object]) -> "Prepared":
    """The run to train (new, resumed or one that continues another), its capture and the selection."""
    from ..training.effects.plan import with_effect_plan, with_effects_of_takes
    from ..training.run.continuation import Prepared, prepare

    if job.resumes:
        moved = None if read_run(folder).takes else job.capture  # the head in the scene may be that of any take
        opened = open_run(folder, moved, job.flame, job.principal_point)
        device, reason = device_of(opened.run, job.device)
        report(reason)
        return Prepared(replace(opened.run, device=device), opened.capture, _painted(folder, opened.capture))
    if job.continues is not None:
        device, reason = device_of(read_run(job.continues.parent), job.device)
        report(reason)
        report("Comparing the avatar with the images" if isinstance(job.continues, Extension) else "Opening the run")
        prepared = prepare(job.continues, device, job.flame)
        if isinstance(job.continues, Extension):
            prepared = replace(prepared, run=with_effects_of_takes(prepared.run, prepared.capture))
        return prepared
    assert job.settings is not None
    capture = open_capture(job.capture, job.flame, job.principal_point)
    device, reason = choose_device(job.device)
    report(reason)
    report("Analyzing the capture")
    run = Run(capture.root, job.flame, job.principal_point, job.settings, device=device)
    return Prepared(with_effect_plan(run, capture, device), capture, _painted(folder, capture))


def _painted(folder: Path, capture: Capture) -> dict[int, np.ndarray] | None:
    """The selection that the job trains instead of what the rule selects."""
    from ..training.run.checkpoint import read_selection

    given = job_folder(folder)
    return read_selection(given, len(capture.faces)) if (given / SELECTION).exists() else None


class _Report:
    """The report of a training job: status, and a preview every few seconds."""

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
        with suppress(StgaError):  # training continues without a preview, and reports a full disk itself
            write_avatar(self.writer.folder / PREVIEW, avatar)
