"""What is shown of a batch: the live table, the table of a plan, and the report, an HTML file."""

import base64
import html
import io
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from ...capture.model import evenly_spread
from ...errors import StgaError, one_line
from ...files import replacing
from ...format import format_duration
from ...training.evaluate.forecast import FITTED_HEADS, curve_of, kept_line
from ...training.run.folder import has_run, read_run
from ...training.run.metrics_log import read_metrics
from ...worker.status import log_lines
from .run import Batch, Entry, JobState

if TYPE_CHECKING:
    from PIL import Image

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
    entries = [entry for entry in batch.entries.values() if entry.state == JobState.RUNNING]
    entries += batch.failures
    shown = entries[:MAX_LIVE_ROWS]
    width = max((len(entry.job.name) for entry in shown), default=0)
    lines = [summary_line(batch), *(_row(entry, width) for entry in shown)]
    more = len(entries) - len(shown)
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
        needs = entry.job.resources
        plural = "" if needs.threads == 1 else "s"
        machine = f"{needs.threads} thread{plural}, {needs.memory_gb:g} GB" + ", GPU" * needs.gpu
        time = format_duration(entry.forecast_s) if entry.forecast_s else "?"
        more = f" and {len(job.after) - 1} more" if len(job.after) > 1 else ""
        after = f"after {job.after[0]}{more}" if job.after else ""
        state = "finished before" if entry.state.is_done else time
        rows.append((job.name, type(job.request).__name__, machine, state, after))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    unfinished = [entry for entry in batch.entries.values() if not entry.state.is_over]
    known = [entry.forecast_s for entry in unfinished if entry.forecast_s]
    unknown = len(unfinished) - len(known)
    text = f"{len(rows)} jobs, {len(unfinished)} to do"
    if known:
        threads = [min(max(entry.job.resources.threads, 1), cores) for entry in unfinished]
        each = zip(unfinished, threads, strict=True)
        shared = max(sum(entry.forecast_s * n for entry, n in each) / max(1, cores), *known)
        text += f"; {format_duration(sum(known))} of work, about {format_duration(shared)} on this "
        text += "machine"
    if unknown:
        text += f"; of {unknown} jobs the time is not known before one of their kind is finished"
    return [*lines, text]


REPORT = "report.html"
MAX_CURVES = 24
MAX_PICTURES = 24
MAX_FAILURES = 50
MAX_ROWS = 2000
"""Limits of the report; of more curves and pictures, evenly spread ones by PSNR are shown."""
PICTURE_HEIGHT_PX = 240
JPEG_QUALITY = 85
LOG_LINES = 12
STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; padding: 0 1rem;
       color: #1c1c1c; background: #fff; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
table { border-collapse: collapse; width: 100%; } th, td { text-align: left; vertical-align: top;
       padding: .25rem .6rem .25rem 0; border-bottom: 1px solid #ddd; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; }
.failed { color: #a3200d; } .quiet { color: #666; }
pre { background: #f4f4f4; padding: .6rem; overflow-x: auto; font-size: 13px; }
figure { display: inline-block; margin: 0 1rem 1rem 0; } figcaption { font-size: 13px; }
svg { max-width: 100%; height: auto; }
"""


@dataclass(frozen=True)
class Run:
    """A finished training. metrics: the evaluations of its metrics.jsonl; figures: that of the
    avatar it keeps, empty without held-out views."""

    entry: Entry
    metrics: list[dict[str, Any]]
    figures: dict[str, Any]


def write_report(batch: Batch) -> Path:
    """Write report.html into the batch's folder; returns its path. Raises StgaError."""
    runs: list[Run] = []
    for entry in batch.entries.values():
        folder = entry.job.folder
        if entry.state.is_done and has_run(folder):
            with suppress(StgaError):
                metrics = read_metrics(folder)
                figures = dict[str, Any]()
                lines = [line for line in metrics if "psnr" in line]
                with suppress(StgaError):
                    settings = read_run(folder).settings
                    figures |= kept_line(lines, settings) if lines else {}
                    last = [{}, *metrics][-1]
                    figures |= {k: v for k, v in last.items() if k.endswith(FITTED_HEADS)}
                runs.append(Run(entry, metrics, figures))
    runs.sort(key=lambda run: run.figures.get("psnr", -np.inf))
    parts = [_summary(batch), _failures(batch), _chart(runs), _pictures(runs), _table(batch, runs)]
    title = html.escape(batch.plan.out.name)
    head = '<!doctype html><html lang="en"><meta charset="utf-8">'
    head += f"<title>{title}</title><style>{STYLE}</style>"
    path = batch.plan.out / REPORT
    with replacing(path) as partial:
        partial.write_text(
            f"{head}<h1>Batch {title}</h1>{''.join(parts)}</html>\n", encoding="utf-8"
        )
    return path


def _summary(batch: Batch) -> str:
    entries = batch.entries.values()
    counts = Counter(entry.state for entry in entries)
    text = ", ".join(f"{counts[state]} {state}" for state in JobState if counts[state])
    seconds = sum(entry.seconds for entry in entries)
    off = [abs(miss) for entry in entries if (miss := _forecast_error(entry)) is not None]
    worked = f"{format_duration(seconds)} of work."
    if off:
        worked += f" Forecasts were off by {np.median(off):.0%} (median of {len(off)})."
    return f"<p>{html.escape(batch.plan.source)}: {len(entries)} jobs: {text}. {worked}</p>"


def _forecast_error(entry: Entry) -> float | None:
    """How much longer a finished job took than expected, as a share; None: not expected."""
    if not (entry.state.is_done and entry.forecast_s and entry.seconds):
        return None
    return entry.seconds / entry.forecast_s - 1


def _failures(batch: Batch) -> str:
    failed = batch.failures
    parts = []
    for entry in failed[:MAX_FAILURES]:
        name = html.escape(entry.job.name)
        error = html.escape(entry.error or entry.state)
        parts.append(f'<p><b>{name}</b>: <span class="failed">{error}</span></p>')
        log = log_lines(entry.job.request_folder, LOG_LINES)
        if log and entry.state == JobState.FAILED:
            parts.append(f"<pre>{html.escape(chr(10).join(log))}</pre>")
    if len(failed) > MAX_FAILURES:
        parts.append(f"<p>… and {len(failed) - MAX_FAILURES} more</p>")
    return f"<h2>Failures</h2>{''.join(parts)}" if failed else ""


def _chart(runs: Sequence[Run]) -> str:
    """PSNR over training time as SVG."""
    shown = [run for run in evenly_spread(runs, MAX_CURVES) if curve_of(run.metrics)]
    if not shown or find_spec("matplotlib") is None:
        return ""
    from ...report import finish_axes, psnr_axes

    figure, axes = psnr_axes("PSNR on held-out views")
    for run in reversed(shown):
        axes.plot(*np.array(curve_of(run.metrics)).T, marker=".", label=run.entry.job.name)
    finish_axes(axes)
    drawn = io.StringIO()
    figure.savefig(drawn, format="svg", metadata={"Date": None})
    of = f" of {len(runs)}" if len(shown) < len(runs) else ""
    svg = drawn.getvalue()
    return f"<h2>Curves ({len(shown)}{of} runs)</h2>{svg[svg.index('<svg') :]}"


def _pictures(runs: Sequence[Run]) -> str:
    """A held-out image of each run beside its avatar, where its capture has one here."""
    shown = []
    for run in evenly_spread(runs, MAX_PICTURES):
        with suppress(StgaError, ModuleNotFoundError):
            picture = _held_out_pair(run.entry.job.folder)
            if picture is None:
                continue
            height = min(2 * PICTURE_HEIGHT_PX, picture.height)
            picture = picture.resize((round(picture.width * height / picture.height), height))
            out = io.BytesIO()
            picture.save(out, "JPEG", quality=JPEG_QUALITY)
            source = f"data:image/jpeg;base64,{base64.b64encode(out.getvalue()).decode()}"
            name = html.escape(run.entry.job.name)
            psnr = f", {run.figures['psnr']:.2f} dB" if "psnr" in run.figures else ""
            shown.append(
                f'<figure><img alt="{name}" height="{PICTURE_HEIGHT_PX}" '
                f'src="{source}"><figcaption>{name}{psnr}</figcaption></figure>'
            )
    title = "<h2>Held-out views: image and avatar, from the lowest PSNR</h2>"
    return title + "".join(shown) if shown else ""


def _held_out_pair(run: Path) -> "Image.Image | None":
    """A run's first evaluation view, image and avatar; None without one. Raises StgaError where the
    run or its capture cannot be opened."""
    from PIL import Image

    from ...avatar.file import read_avatar
    from ...capture.images import read_image
    from ...render.render import render_avatar, to_uint8
    from ...training.evaluate.metrics import choose_evaluation_views
    from ...training.run.folder import AVATAR, open_refined

    capture = open_refined(run)
    views = choose_evaluation_views(capture)
    if not views:
        return None
    avatar = read_avatar(run / AVATAR)
    view = views[0]
    red, green, blue = (round(255 * level) for level in avatar.background)
    mesh = capture.mesh(view.timestep)
    rendered = to_uint8(render_avatar(avatar, mesh, view.camera, avatar.background))
    return Image.fromarray(np.hstack([read_image(view, (red, green, blue)), rendered]))


def _table(batch: Batch, runs: Iterable[Run]) -> str:
    figures = {run.entry.job.name: run.figures for run in runs}
    heads = ("job", "request", "state", "machine")
    fitted = f"psnr{FITTED_HEADS}"
    numbers: tuple[str, ...] = ("time", "forecast", "off by", "PSNR", "SSIM", "splats")
    if any(fitted in known for known in figures.values()):
        numbers = (*numbers, "PSNR, heads fitted")
    rows = [_cells("th", heads, numbers)]
    entries = list(batch.entries.values())
    for entry in entries[:MAX_ROWS]:
        off = _forecast_error(entry)
        known = figures.get(entry.job.name, {})
        name = entry.job.name
        kind = type(entry.job.request).__name__
        found = [
            format_duration(entry.seconds) if entry.seconds else "",
            format_duration(entry.forecast_s) if entry.forecast_s else "",
            "" if off is None else f"{off:+.0%}",
            f"{known['psnr']:.2f}" if "psnr" in known else "",
            f"{known['ssim']:.4f}" if "ssim" in known else "",
            f"{known['splats']:,}" if "splats" in known else "",
            f"{known[fitted]:.2f}" if fitted in known else "",
        ][: len(numbers)]
        rows.append(_cells("td", (name, kind, str(entry.state), entry.machine), found))
        if entry.state in (JobState.FAILED, JobState.BLOCKED):
            rows[-1] = rows[-1].replace("<tr>", '<tr class="failed">')
    more = f"<p>… and {len(entries) - MAX_ROWS} more</p>" if len(entries) > MAX_ROWS else ""
    return f"<h2>Jobs</h2><table>{''.join(rows)}</table>{more}"


def _cells(tag: str, texts: Iterable[str], numbers: Iterable[str]) -> str:
    cells = [f"<{tag}>{html.escape(text)}</{tag}>" for text in texts]
    cells += [f'<{tag} class="n">{number}</{tag}>' for number in numbers]
    return f"<tr>{''.join(cells)}</tr>"
