"""Who performs: files of performances, and recordings of faces that one is made of."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from ..capture.transforms import VIDEO_SUFFIXES
from ..errors import StgaError
from ..files import is_file, is_folder, matching
from ..progress import Report, ignore
from .performance import Performance, recorded_at
from .performance_files import (
    csv_performance,
    json_performance,
    lines_performance,
    text_performance,
)

TAKE_EXTRAS = ("_neutral", "_raw", "_cal")
"""Endings of files that Live Link Face writes beside a take's own."""


@dataclass(frozen=True)
class Performer:
    """How a performance is read.

    kind      of file, in messages
    read      (path, report); raises StgaError, and Cancelled where the report asks to stop
    at_once   whether all that takes a motion reads it; else it takes long, and `stga drive` makes a
              motion of it first
    """

    kind: str
    read: Callable[[Path, Report], Performance]
    at_once: bool


def _at_once(kind: str, read: Callable[[Path], Performance]) -> Performer:
    return Performer(kind, lambda path, report: read(path), True)


def _watched(path: Path, report: Report) -> Performance:
    from .face_video import watched_performance

    return watched_performance(path, report)


PERFORMERS: Mapping[str, Performer] = {
    ".csv": _at_once("a table", csv_performance),
    ".tsv": _at_once("a table", csv_performance),
    ".json": _at_once("named weights", json_performance),
    ".jsonl": _at_once("lines of named weights", lines_performance),
    ".ndjson": _at_once("lines of named weights", lines_performance),
    ".txt": _at_once("lines of iFacialMocap or Face Cap", text_performance),
    **dict.fromkeys(VIDEO_SUFFIXES, Performer("a video", _watched, False)),
}
"""Suffix of a file -> its readers."""
READ_SUFFIXES = tuple(suffix for suffix, performer in PERFORMERS.items() if performer.at_once)
RECORDED_SUFFIXES = tuple(suffix for suffix in PERFORMERS if suffix not in READ_SUFFIXES)


def performer_of(path: Path) -> Performer | None:
    """The performer for a file's suffix; None for a file that is no performance. The folder of a
    Live Link Face take is read as its table."""
    if is_folder(path):
        is_capture = is_folder(path / "flame_param") or matching(path, "transforms*.json")
        return None if is_capture or not _tables(path) else PERFORMERS[".csv"]
    return PERFORMERS.get(path.suffix.lower())


def is_performance(path: Path) -> bool:
    """Whether `read_performance` reads it at once."""
    performer = performer_of(path)
    return performer is not None and performer.at_once


def read_performance(
    path: Path, report: Report = ignore, recorded_fps: float | None = None
) -> Performance:
    """Read a performance by its suffix and content.

    CSV of Live Link Face (or the take's folder) and of Audio2Face; JSON of Audio2Face and
    LAM-Audio2Expression, of MediaPipe's blend shapes, or of any named weights per frame;
    iFacialMocap's packets as lines of text; a video of a face. Columns are found by name.

    recorded_fps: the rate of a file without times. Raises StgaError naming the file, the row, and
    the shapes that are missing, and for the rate of a file with times.
    """
    if is_folder(path):
        files = _tables(path)
        candidates = [
            path for path in files if not path.stem.lower().endswith(TAKE_EXTRAS)
        ] or files
        if len(candidates) != 1:
            names = ", ".join(path.name for path in candidates[:4]) or "none"
            raise StgaError(f"{path}: a take's folder holds one CSV file, found {names}")
        path = candidates[0]
    performer = performer_of(path)
    if performer is None:
        raise StgaError(
            f"{path}: is no performance; expected {', '.join(READ_SUFFIXES)} or the folder of "
            "a take"
        )
    performance = performer.read(path, report)
    if recorded_fps is not None and performance.guessed_fps is None:
        problem = f"{path}: has times, so that no rate is taken"
        raise StgaError(f"{problem} (--recorded-fps, in Blender Recorded At)")
    return performance if recorded_fps is None else recorded_at(performance, recorded_fps)


def _tables(folder: Path) -> list[Path]:
    return [path for path in matching(folder, "*.[cC][sS][vV]") if is_file(path)]
