"""Forecast of how long each job of a batch takes."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from statistics import median

from ..errors import StgaError
from ..requests.values import Extend, Refine, Train
from ..training.settings import PRESETS
from .folder import read_record
from .job import Job


def forecast_seconds(jobs: Sequence[Job], done: Sequence[Job]) -> dict[str, float]:
    """Name -> seconds that a job is expected to take, of the jobs of which that is known.

    done: jobs that are finished; those of the same kind of request correct the forecast, and stand in where there is
    none. What a training of so many iterations takes is measured on this machine (`pace`), once for all.
    """
    paces: list[float] = []
    stated = {job.name: _stated(job, paces) for job in (*jobs, *done)}
    taken: dict[type, list[tuple[float, float | None]]] = {}
    for job in done:
        record = read_record(job)
        if record is not None and record.seconds:
            taken.setdefault(type(job.request), []).append((record.seconds, stated[job.name]))
    found = {job.name: _corrected(stated[job.name], taken.get(type(job.request), ())) for job in jobs}
    return {name: seconds for name, seconds in found.items() if seconds is not None}


def _corrected(stated: float | None, taken: Sequence[tuple[float, float | None]]) -> float | None:
    if stated is None:
        return median(seconds for seconds, _ in taken) if taken else None
    factors = [seconds / expected for seconds, expected in taken if expected]
    return stated * median(factors) if factors else stated


def _stated(job: Job, paces: list[float]) -> float | None:
    """Seconds by the plan: what it says, the budget of a training, or the time that its iterations take.

    paces: seconds of an iteration, once it is measured.
    """
    request = job.request
    if job.minutes is not None:
        return 60 * job.minutes
    if isinstance(request, Refine | Extend):
        return request.seconds
    if not isinstance(request, Train):
        return None
    if request.settings.seconds is not None:
        return request.settings.seconds
    measured = None if paces else pace(job, request)
    if measured is not None:
        paces.append(measured)
    # A capture of very many views takes more than its preset's own number.
    iterations = request.settings.iterations or PRESETS[str(request.settings.preset)].iterations
    return paces[0] * iterations if paces else None


def pace(job: Job, request: Train) -> float | None:
    """Seconds per iteration of a training on this machine, measured; None where its capture is not there yet, cannot
    be trained on, or training is not installed here."""
    if find_spec("torch") is None or find_spec("numba") is None or not request.capture.is_dir():
        return None
    from ..capture.open import open_capture
    from ..render.device import choose_device
    from ..training.effects.plan import plan_effects
    from ..training.preset_timing import seconds_per_iteration

    try:
        with _threads(job.resources.threads):
            device, _ = choose_device(request.device)
            capture = open_capture(request.capture, request.flame, request.principal_point)
            if not capture.views.get("train"):
                return None
            settings, _ = plan_effects(capture, request.settings, device)
            return seconds_per_iteration(capture, settings, device=device)
    except StgaError:  # the job itself will say so
        return None


@contextmanager
def _threads(count: int) -> Iterator[None]:
    from ..raster.cpu.threads import set_threads, threads

    before = threads()
    set_threads(count or before)
    try:
        yield
    finally:
        set_threads(before)
