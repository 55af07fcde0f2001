"""Tables of a batch in the terminal: while it runs, after its end, and of a plan."""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from ...errors import StgaError, one_line
from ...format import format_duration
from ...training.evaluate.forecast import kept_line
from ...training.run.folder import has_run, read_run
from ...training.run.metrics_log import read_metrics
from .run import Batch, Entry, JobState

MAX_LIVE_ROWS = 20  # Jobs that the live table shows: the running ones, then those that failed
BAR_WIDTH = 20
CLEAR_LINE = "\x1b[2K"
UP = "\x1b[{}A"


class LiveTable:
    """Shows a batch: on a terminal a table that is drawn over, else a line for each event."""

    def __init__(self, stream: TextIO, width: int = 100) -> None:
        self._stream = stream
        self._width = width
        self._is_terminal = stream.isatty()
        self._drawn = 0

    def __call__(self, batch: Batch) -> None:
        if not self._is_terminal:
            return
        self._erase()
        lines = table_lines(batch)
        self._stream.write("".join(line[: self._width - 1] + "\n" for line in lines))
        self._stream.flush()
        self._drawn = len(lines)

    def log(self, line: str) -> None:
        """Print a line above the table."""
        self._erase()
        self._stream.write(one_line(line) + "\n")
        self._stream.flush()

    def _erase(self) -> None:
        if self._drawn:
            self._stream.write((UP.format(1) + CLEAR_LINE) * self._drawn + "\r")
        self._drawn = 0


def table_lines(batch: Batch) -> list[str]:
    """A line on the whole batch, and one for each job that runs or has failed."""
    entries = [entry for entry in batch.entries.values() if entry.state == JobState.RUNNING]
    entries += batch.failures
    listed = entries[:MAX_LIVE_ROWS]
    width = max((len(entry.job.name) for entry in listed), default=0)
    lines = [summary_line(batch), *(_row(entry, width) for entry in listed)]
    more = len(entries) - len(listed)
    return [*lines, f"… and {more} more"] if more else lines


def summary_line(batch: Batch) -> str:
    """ "3 of 8 jobs finished, 2 running, 1 failed; about 4 min left", if as many run at once as
    now."""
    entries = batch.entries.values()
    counts = Counter(entry.state for entry in entries)
    done = counts[JobState.FINISHED] + counts[JobState.KEPT]
    parts = [f"{done} of {len(entries)} jobs finished"]
    for state in (JobState.RUNNING, JobState.FAILED, JobState.BLOCKED, JobState.CANCELLED):
        parts += [f"{counts[state]} {state}"] if counts[state] else []
    line = ", ".join(parts)
    left = [entry for entry in entries if not entry.state.is_over]
    known = [entry.left_s for entry in left if entry.left_s is not None]
    if not any(known):
        return line
    running = max(1, sum(entry.status.seconds > 0 for entry in left))  # others wait in a queue
    seconds = max(sum(known) * len(left) / len(known) / running, *known)
    return f"{line}; about {format_duration(seconds)} left"


def _row(entry: Entry, width: int) -> str:
    name = f"  {entry.job.name:<{width}}"
    if entry.state != JobState.RUNNING:
        return f"{name}  {entry.state}: {entry.error}"
    full = round(BAR_WIDTH * entry.status.progress)
    psnr = entry.status.figures.get("psnr")
    left = entry.left_s
    parts = [
        f"{entry.machine:<12}",
        f"[{'#' * full}{'.' * (BAR_WIDTH - full)}] {entry.status.progress:4.0%}",
        "         " if psnr is None else f"{psnr:5.2f} dB",
        "" if left is None else f"{format_duration(left)} left",
        entry.status.message,
    ]
    return "  ".join([name, *parts])


def plan_lines(batch: Batch, cores: int) -> list[str]:
    """What --dry-run prints: each job, its state, its forecast, and the sum."""
    rows = []
    for entry in batch.entries.values():
        job = entry.job
        needs = job.resources
        plural = "" if needs.threads == 1 else "s"
        machine = f"{needs.threads} thread{plural}, {needs.memory_gb:g} GB" + ", GPU" * needs.gpu
        time = "?" if job.forecast_s is None else format_duration(job.forecast_s)
        more = f" and {len(job.after) - 1} more" if len(job.after) > 1 else ""
        after = f"after {job.after[0]}{more}" if job.after else ""
        state = str(JobState.KEPT) if entry.state.is_done else time
        rows.append((job.name, type(job.request).__name__, machine, state, after))
    unfinished = [entry for entry in batch.entries.values() if not entry.state.is_over]
    forecasts = [(entry, entry.job.forecast_s) for entry in unfinished]
    known = [(entry, seconds) for entry, seconds in forecasts if seconds is not None]
    unknown = len(unfinished) - len(known)
    text = f"{len(rows)} jobs, {len(unfinished)} to do"
    if known:
        each = [seconds for _, seconds in known]
        threads = [min(max(entry.job.resources.threads, 1), cores) for entry, _ in known]
        used = sum(seconds * count for seconds, count in zip(each, threads, strict=True))
        shared = format_duration(max(used / max(1, cores), *each))
        text += f"; {format_duration(sum(each))} of work, about {shared} on this machine"
    if unknown:
        text += f"; of {unknown} jobs the time is not known"
    return [*_aligned(rows), text]


def ended_lines(batch: Batch) -> list[str]:
    """Each job after the batch: its state, machine and time, and of a run the PSNR and the splats
    of the avatar that it keeps; then the error of each that failed."""
    rows = [("job", "request", "state", "machine", "time", "PSNR", "splats")]
    for entry in batch.entries.values():
        kept = _kept_figures(entry.job.folder) if entry.state.is_done else {}
        rows.append(
            (
                entry.job.name,
                type(entry.job.request).__name__,
                str(entry.state),
                entry.machine,
                format_duration(entry.seconds) if entry.seconds else "",
                f"{kept['psnr']:.2f} dB" if "psnr" in kept else "",
                f"{kept['splats']:,}" if "splats" in kept else "",
            )
        )
    errors = [f"{entry.job.name}: {entry.error or entry.state}" for entry in batch.failures]
    return [*_aligned(rows), *errors, summary_line(batch)]


def _kept_figures(folder: Path) -> Mapping[str, Any]:
    """The line of metrics of the avatar that a run keeps; empty without held-out views."""
    if not has_run(folder):
        return {}
    with suppress(StgaError):
        lines = [line for line in read_metrics(folder) if "psnr" in line]
        return kept_line(lines, read_run(folder).settings) if lines else {}
    return {}


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
