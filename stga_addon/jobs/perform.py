"""Carrying out requests, in this process or as the worker of a folder."""

from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import walk_packages
from time import monotonic

from ..errors import StgaError
from ..files import write_npz
from ..options import refuse_useless
from ..progress import Cancelled, Progress, Report, Say, ignore
from ..schema import validate
from ..tracking.folder import is_written
from ..training.run.folder import has_run
from ..worker.status import StatusWriter, status_writer
from .folder import PICTURE, PREVIEW, has_request, read_request, write_result
from .results import Result, Written
from .table import JOBS, Request
from .track import MakeAvatar, Track
from .train import Extend, Refine, Resume, Train, resumed

LOADED_AHEAD = ("avatar", "capture", "flame", "raster.cpu", "training", "report")
"""Rooms that a worker which trains loads before it begins."""
TORCH_MODULES = ("raster.cpu.autograd",)  # Modules in them that import torch, which takes seconds
PREVIEW_INTERVAL_S = 4.0  # Seconds between two previews of a training


def perform(request: Request, report: Report = ignore, say: Say = print) -> Result:
    """Carry out a request; returns what it found.

    say: told in lines what was decided and found.
    Raises what the work raises: StgaError for mistakes and damaged files; Cancelled where the
    report stopped work that has nothing to keep; KeyboardInterrupt after Ctrl-C.
    """
    refuse_useless(request)
    validate(request)
    module, _, function = JOBS[type(request)].work.rpartition(".")
    if module.startswith("..") and find_spec("..development", __package__) is None:
        raise StgaError(f"{type(request).__name__}: can be carried out in a checkout only")
    result: Result = getattr(import_module(module, __package__), function)(request, report, say)
    return result


def perform_in_folder(
    folder: Path, say: Say = print, also: Report = ignore, resume: bool = False
) -> Result | None:
    """Carry out the request in a folder, with its status, previews and result there; None where it
    was cancelled.

    also: reported to as well. resume: what the request's output folder holds is what this request
    began (`remaining`). Raises as `perform` does; the message is in the final status, too.
    """
    # before anything is written into a folder that may be of something else
    if not has_request(folder):
        raise StgaError(f"{folder}: holds no request")
    with status_writer(folder) as writer:
        writer.update(0.0, "Starting")
        try:
            request = read_request(folder)
            if isinstance(request, Train | Resume | Refine | Extend | MakeAvatar):
                from ..raster.cpu.precompile import begin_compiling

                begin_compiling()
                load_ahead()
            # ended before it wrote its result
            if resume and isinstance(request, Track) and is_written(request.out):
                result: Result = Written(request.out)
            else:
                left = remaining(request) if resume else request
                result = perform(left, _StatusReport(writer, also), say)
        except Cancelled:
            return None
        write_result(folder, result)
        return result


def load_ahead() -> None:
    """Load what a training needs later: an add-on's update may exchange the files meanwhile."""
    for room in LOADED_AHEAD:
        package = import_module(f"..{room}", __package__)
        for module in walk_packages(getattr(package, "__path__", ()), f"{package.__name__}."):
            if not module.name.endswith(TORCH_MODULES):
                # a package that not every Python has, and that nothing here needs
                with suppress(ImportError):
                    import_module(module.name)


def remaining(request: Request) -> Request:
    """What is left of an interrupted request: trainings are resumed, others write anew."""
    return (
        resumed(request)
        if isinstance(request, Train | Refine | Extend) and has_run(request.run)
        else request
    )


class _StatusReport:
    """Writes the status, and a preview every few seconds, into the folder of a request."""

    def __init__(self, writer: StatusWriter, also: Report) -> None:
        self._writer, self._also = writer, also
        self._previewed_s = monotonic()

    def __call__(self, progress: Progress) -> bool:
        stop = self._writer.update(
            progress.share, progress.stage, progress.detail, progress.figures
        )
        if progress.preview is not None and monotonic() - self._previewed_s > PREVIEW_INTERVAL_S:
            progress.preview(self._writer.folder / PREVIEW)
            self._previewed_s = monotonic()
        picture = progress.picture() if progress.picture is not None else None
        if picture is not None:
            with suppress(StgaError):  # a full disk, which the work reports itself
                write_npz(self._writer.folder / PICTURE, {"rgb": picture})
        return self._also(progress) or stop
