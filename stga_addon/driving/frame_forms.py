"""Other forms in which programs write frames of named weights: keyed by time, a row a shape, lines
of JSON, Face Cap's text."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from ..errors import StgaError
from ..files import parse_json
from .clocks import MAX_FRAME_STEP
from .performance import arkit_name

FACE_CAP_COLUMNS = ("k", "time_ms", "px", "py", "pz", "rx", "ry", "rz", "lx", "ly", "rx2", "ry2")
"""Columns before the shapes in Face Cap's lines: the kind of line, its time, the head's position,
and angles in degrees: the head's about x, y and z, then those of the eyes."""
NAME_OF_SHAPE = ("blendShapeLocation", "blendShape", "blendshape", "shape", "categoryName", "name")
"""Keys of a shape's name in a row of one shape."""
VALUE_OF_SHAPE = ("value", "weight", "score", "coefficient")
"""Keys of its weight."""
TIME_OF_ROW = ("timestamp", "time", "timeCode", "timecode", "frame", "t")
"""Keys of its time."""
NAME_LISTS = ("Names", "names", "blendShapes")
"""Keys of a list of shapes."""
WEIGHT_LISTS = ("Weights", "weights", "Values", "values")
"""Keys of the list of their weights."""
MAX_ROWS = 1 << 20
"""Rows of a performance."""
MAX_DEPTH = 4
"""Levels of a frame in which lists of names and weights are looked for."""


def plain_frames(document: Any) -> Any:
    """The document with frames as a list of named weights with their times, where it has one of the
    forms of this module; else as it is."""
    if isinstance(document, dict) and len(document) > 1 and all(map(_is_number, document)):
        keys = sorted(document, key=float)
        steps = [float(after) - float(before) for before, after in pairwise(keys)]
        is_counted = all(float(key) % 1 == 0 for key in keys) and min(steps) <= MAX_FRAME_STEP
        frames = [_with_names(document[key]) for key in keys]
        if is_counted:  # which says no times
            return frames
        return [
            {"time": float(key), "blendShapes": frame}
            for key, frame in zip(keys, frames, strict=True)
        ]
    if isinstance(document, list) and document and all(map(_is_row, document)):
        return _by_time(document)
    return document


def read_lines(path: Path, text: str) -> list[Any]:
    """A frame of JSON a line; a last line that is cut off is left out. Raises StgaError."""
    lines = [line for line in text.splitlines() if line.strip()]
    check_rows(path, len(lines))
    frames = []
    for number, line in enumerate(lines, start=1):
        try:
            frames.append(parse_json(line.encode()))
        except (ValueError, RecursionError) as error:
            if number < len(lines) or not frames:
                raise StgaError(f"{path}: line {number}: is not valid JSON ({error})") from error
    return frames


def check_rows(path: Path, count: int) -> None:
    """Raise StgaError for more rows than a performance has."""
    if count > MAX_ROWS:
        raise StgaError(f"{path}: has {count} rows, expected at most {MAX_ROWS}")


def is_face_cap(text: str) -> bool:
    """Whether a text is Face Cap's recording."""
    return text.startswith("info,") and "\nbs," in text[:4096]


def face_cap_frames(path: Path, text: str) -> list[Any]:
    """Frames of Face Cap's text: times in ms, weights, the head's angles. Raises StgaError."""
    names: list[str] = []
    frames = []
    for number, line in enumerate(text.splitlines(), start=1):
        cells = [cell.strip() for cell in line.split(",")]
        if cells[0] == "bs":
            names = cells[1:]
        elif cells[0] == "k":
            before = len(FACE_CAP_COLUMNS)
            if len(cells) != before + len(names):
                expected = f"expected {before + len(names)}"
                raise StgaError(f"{path}: line {number}: has {len(cells)} columns, {expected}")
            try:
                values = [float(cell) for cell in cells[1:]]
            except ValueError as error:
                raise StgaError(f"{path}: line {number}: {error}") from error
            shapes = dict(zip(names, values[before - 1 :], strict=True))
            turn = dict(zip(("xDeg", "yDeg", "zDeg"), values[4:7], strict=True))
            frames.append({"time_ms": values[0], "headRotation": turn, "blendShapes": shapes})
    return frames


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def list_of(document: dict[str, Any], keys: Sequence[str]) -> list[Any] | None:
    """The first list that a document has by one of the keys; None without one."""
    return next((document[key] for key in keys if isinstance(document.get(key), list)), None)


def _with_names(frame: Any, depth: int = 0) -> Any:
    """The weights by their names, where lists of both lie somewhere in a frame."""
    if not isinstance(frame, dict) or depth > MAX_DEPTH:
        return frame
    names = list_of(frame, NAME_LISTS)
    weights = list_of(frame, WEIGHT_LISTS)
    if names is not None and weights is not None and len(names) == len(weights):
        return dict(zip(map(str, names), weights, strict=True))
    for value in frame.values():
        found = _with_names(value, depth + 1)
        if found is not value:
            return found
    return frame


def _is_row(entry: Any) -> bool:
    """Whether an entry is of one shape at one time."""
    if not isinstance(entry, dict):
        return False
    name = _first(entry, NAME_OF_SHAPE)
    value = _first(entry, VALUE_OF_SHAPE)
    time = _first(entry, TIME_OF_ROW)
    return isinstance(name, str) and all(
        isinstance(each, (str, float, int)) for each in (value, time)
    )


def _by_time(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """A frame for each time of the rows."""
    frames: dict[Any, dict[str, Any]] = {}
    for row in rows:
        key = next(key for key in TIME_OF_ROW if row.get(key) is not None)
        frame = frames.setdefault(row[key], {key: row[key], "blendShapes": {}})
        frame["blendShapes"][_first(row, NAME_OF_SHAPE)] = _first(row, VALUE_OF_SHAPE)
    return list(frames.values())


def rows_of_shapes(
    header: Sequence[str], rows: Sequence[Sequence[str]]
) -> list[dict[str, Any]] | None:
    """Frames of a table of a row a shape; None for other tables."""
    plain = [name.strip() for name in header]
    entries: list[dict[str, Any]] = [dict(zip(plain, row, strict=False)) for row in rows]
    if not entries or not all(map(_is_row, entries)):
        return None
    if arkit_name(str(_first(entries[0], NAME_OF_SHAPE))) is None:
        return None
    for entry in entries:
        key = next(key for key in VALUE_OF_SHAPE if key in entry)
        entry[key] = float(entry[key]) if _is_number(entry[key]) else entry[key]
    return _by_time(entries)


def _first(entry: dict[str, Any], keys: Sequence[str]) -> Any:
    return next((entry[key] for key in keys if entry.get(key) is not None), None)
