"""Carrying out requests: the only place that knows which work a request is, and that loads it."""

from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import walk_packages
from time import monotonic
from typing import Any

from ..errors import StgaError
from ..files import write_npz
from ..progress import Cancelled, Progress, Report, Say, ignore
from ..requests import values
from ..requests.folder import PICTURE, PREVIEW, has_request, read_request, write_result
from ..requests.results import Result, Written
from ..requests.values import Extend, MakeAvatar, Refine, Request, Resume, Track, Train
from ..schema import validate
from ..tracking.folder import is_written
from ..training.run.folder import has_run
from ..worker.status import StatusWriter, status_writer

LOADED_AHEAD = ("avatar", "capture", "flame", "raster.cpu", "training", "report")
"""Rooms that a worker which trains loads before it begins."""
TORCH_MODULES = ("raster.cpu.autograd",)
"""Modules in them that import torch, which takes seconds."""
PREVIEW_INTERVAL_S = 4.0
"""Seconds between two previews of a training."""
WORK: dict[type[Any], tuple[str, str]] = {
    values.Train: (".training", "perform_training"),
    values.Resume: (".training", "perform_training"),
    values.Refine: (".training", "perform_training"),
    values.Extend: (".training", "perform_training"),
    values.Select: (".selection", "select"),
    values.SelectForTake: (".training", "select_for_take"),
    values.Track: (".tracking", "perform_tracking"),
    values.MakeAvatar: (".avatar", "make_avatar"),
    values.SolveAgain: (".tracking", "solve_again"),
    values.Render: (".render", "render"),
    values.RenderBlend: (".blend", "render_blend"),
    values.ConvertMotion: (".conversion", "convert_motion"),
    values.RenderRecording: (".recording", "render_recording"),
    values.Export: (".export", "export"),
    values.Analyze: (".analysis", "analyze"),
    values.TimePresets: (".analysis", "time_each_preset"),
    values.Evaluate: (".evaluation", "evaluate_run"),
    values.Benchmark: ("..development.benchmark.slice", "train_slice"),
    values.Relight: (".relighting", "relight"),
}
"""Request -> the module that carries it out, loaded when it is needed, and its function. The extension's zip leaves
`development` out."""


def perform(request: Request, report: Report = ignore, say: Say = print) -> Result:
    """Carry out a request; returns what it found.

    say: told in lines what was decided and found.
    Raises what the work raises: StgaError for mistakes and damaged files; Cancelled where the report stopped work that
    has nothing to keep; KeyboardInterrupt after Ctrl-C.
    """
    validate(request)
    module, function = WORK[type(request)]
    if module.startswith("..") and find_spec("..development", __package__) is None:
        raise StgaError(f"{type(request).__name__}: can be carried out in a checkout only")
    work: Callable[[Request, Report, Say], Result] = getattr(import_module(module, __package__), function)
    return work(request, report, say)


def perform_in_folder(folder: Path, say: Say = print, also: Report = ignore, resume: bool = False) -> Result | None:
    """Carry out the request in a folder, with its status, previews and result there; None where it was cancelled.

    also: reported to as well. resume: what the request's output folder holds is what this request began (`resumed`).
    Raises as `perform` does; the message is in the final status, too.
    """
    if not has_request(folder):  # before anything is written into a folder that may be of something else
        raise StgaError(f"{folder}: holds no request")
    with status_writer(folder) as writer:
        writer.update(0.0, "Starting")
        try:
            request = read_request(folder)
            if isinstance(request, Train | Resume | Refine | Extend | MakeAvatar):
                from ..raster.cpu.precompile import begin_compiling

                begin_compiling()
                load_ahead()
            left = resumed(request) if resume else request
            result = perform(left, _StatusReport(writer, also), say) if left else _tracked(request)
        except Cancelled:
            return None
        write_result(folder, result)
        return result


def load_ahead() -> None:
    """Load what a training loads later, at its end too: an update of the add-on may exchange the files meanwhile."""
    for room in LOADED_AHEAD:
        package = import_module(f"..{room}", __package__)
        for module in walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith(TORCH_MODULES):
                with suppress(ImportError):  # a package that not every Python has, and that nothing here needs
                    import_module(module.name)


def resumed(request: Request) -> Request | None:
    """What is left of a request that was interrupted, or finished, by an earlier process; None: nothing.

    Requests other than trainings and tracking begin again: they write their files anew.
    """
    match request:
        case Train() if has_run(request.run):
            return Resume(
                request.run, request.capture, request.flame, request.principal_point, request.device, request.selection
            )
        case Refine() | Extend() if has_run(request.run):
            return Resume(request.run, flame=request.flame, device=request.device)
        case Track() if is_written(request.out):
            return None
    return request


def _tracked(request: Request) -> Written:
    """The result of a tracking whose process ended between the capture and its result."""
    assert isinstance(request, Track)
    return Written(request.out)


class _StatusReport:
    """Writes the status, and a preview every few seconds, into the folder of a request."""

    def __init__(self, writer: StatusWriter, also: Report) -> None:
        self._writer, self._also = writer, also
        self._previewed_s = monotonic()

    def __call__(self, progress: Progress) -> bool:
        stop = self._writer.update(progress.share, progress.stage, progress.detail, progress.figures)
        if progress.preview is not None and monotonic() - self._previewed_s > PREVIEW_INTERVAL_S:
            progress.preview(self._writer.folder / PREVIEW)
            self._previewed_s = monotonic()
        picture = progress.picture() if progress.picture is not None else None
        if picture is not None:
            with suppress(StgaError):  # a full disk, which the work reports itself
                write_npz(self._writer.folder / PICTURE, {"rgb": picture})
        return self._also(progress) or stop
