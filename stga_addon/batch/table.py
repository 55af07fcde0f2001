"""The live table of a batch, and the table of what a plan asks for."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TextIO

from ..errors import one_line
from ..format import format_duration
from .job import Job
from .run import Batch, Entry, JobState

MAX_ROWS = 20
"""Jobs that the live table shows: the running ones, then those that failed."""
BAR_WIDTH = 20
CLEAR_LINE, UP = "\x1b[2K", "\x1b[{}A"


class LiveTable:
    """Shows a batch on a stream: on a terminal a table that is drawn over, else a line for each event."""

    def __init__(self, stream: TextIO, width: int = 100) -> None:
        self._stream, self._width = stream, width
        self._is_terminal, self._drawn = stream.isatty(), 0

    def __call__(self, batch: Batch) -> None:
        if not self._is_terminal:
            return
        self._erase()
        lines = table_lines(batch)
        self._stream.write("".join(line[: self._width - 1] + "\n" for line in lines))
        self._stream.flush()
        self._drawn = len(lines)

    def say(self, line: str) -> None:
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
    shown = [entry for entry in batch.entries.values() if entry.state == JobState.RUNNING]
    shown += [entry for entry in batch.entries.values() if entry.state in (JobState.FAILED, JobState.BLOCKED)]
    width = max((len(entry.job.name) for entry in shown[:MAX_ROWS]), default=0)
    lines = [summary_line(batch), *(_row(entry, width) for entry in shown[:MAX_ROWS])]
    return lines if len(shown) <= MAX_ROWS else [*lines, f"… and {len(shown) - MAX_ROWS} more"]


def summary_line(batch: Batch) -> str:
    """ "3 of 8 jobs finished, 2 running, 1 failed; about 4 min left"."""
    counts = Counter(entry.state for entry in batch.entries.values())
    done = counts[JobState.FINISHED] + counts[JobState.KEPT]
    parts = [f"{done} of {len(batch.entries)} jobs finished"]
    for state in (JobState.RUNNING, JobState.FAILED, JobState.BLOCKED, JobState.CANCELLED):
        parts += [f"{counts[state]} {state}"] if counts[state] else []
    left = seconds_left(batch.entries.values())
    return ", ".join(parts) + (f"; about {format_duration(left)} left" if left else "")


def seconds_left(entries: Iterable[Entry]) -> float | None:
    """Seconds until the batch is done, if as many jobs run at once as now; None where that is unknown."""
    open_ones = [entry for entry in entries if not entry.state.is_over]
    each = [entry.left_s for entry in open_ones]
    known = [seconds for seconds in each if seconds is not None]
    if not known:
        return None
    running = max(1, sum(entry.status.seconds > 0 for entry in open_ones))  # others wait in an engine's queue
    total = sum(known) * len(each) / len(known)
    return max(total / running, *known)


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
    rows = [_plan_row(entry) for entry in batch.entries.values()]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    unfinished = [entry for entry in batch.entries.values() if not entry.state.is_over]
    known = [entry.forecast_s for entry in unfinished if entry.forecast_s]
    total = sum(known)
    unknown = len(unfinished) - len(known)
    text = f"{len(rows)} jobs, {len(unfinished)} to do"
    text += f"; {format_duration(total)} of work" if known else ""
    on_cores = sum(entry.forecast_s * min(max(entry.job.resources.threads, 1), cores) for entry in unfinished)
    shared = max(on_cores / max(1, cores), *known, 0.0)
    text += f", about {format_duration(shared)} on this machine" if known else ""
    text += f"; of {unknown} jobs the time is not known before one of their kind is finished" if unknown else ""
    return [*lines, text]


def _plan_row(entry: Entry) -> Sequence[str]:
    job = entry.job
    state = "finished before" if entry.state.is_done else ""
    forecast = format_duration(entry.forecast_s) if entry.forecast_s and not state else ""
    threads = job.resources.threads
    needs = (
        f"{threads} thread{'' if threads == 1 else 's'}, {job.resources.memory_gb:g} GB" + ", GPU" * job.resources.gpu
    )
    return job.name, type(job.request).__name__, needs, forecast or state or "?", _after(job)


def _after(job: Job) -> str:
    more = f" and {len(job.after) - 1} more" if len(job.after) > 1 else ""
    return f"after {job.after[0]}{more}" if job.after else ""
