"""Files of performances: Live Link Face, Audio2Face, MediaPipe, iFacialMocap, weights in JSON."""

import math
import re
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import StgaError, shorten
from ..files import read_json, read_table, read_text
from .clocks import (
    DEFAULT_FPS,
    MAX_FPS,
    MIN_FPS,
    OTHER_RATE,
    Columns,
    Guess,
    at_even_times,
    find_times,
    numbers,
)
from .frame_forms import (
    MAX_ROWS,
    check_rows,
    face_cap_frames,
    is_face_cap,
    list_of,
    plain_frames,
    read_lines,
    rows_of_shapes,
)
from .head_rotations import find_head
from .performance import COLUMN, COUNT, MAX_WEIGHT, FacePacket, Performance, arkit_name, columns_of

REQUEST = b"iFacialMocap_sahuasouryya9218sauhuiayeta91555dy3719"
"""Makes the app send to the address that this comes from."""
MAX_PACKET_BYTES = 1 << 16
_VALUE = re.compile(r"([A-Za-z_]+)[-&](-?\d+(?:\.\d+)?)", re.ASCII)


def parse_packet(data: bytes) -> FacePacket | None:
    """The frame of `mouthSmile_R-0|…|=head#rx,ry,rz,x,y,z|rightEye#x,y,z|leftEye#x,y,z|` (version
    2: `&` before values) by the protocol's author, or None for other bytes."""
    if len(data) > MAX_PACKET_BYTES:
        return None
    try:
        text = data.decode("ascii")
    except UnicodeDecodeError:
        return None
    weights = np.zeros(COUNT)
    names = []
    head = None
    for field in text.strip().split("|"):
        value = _VALUE.fullmatch(field)
        if value is not None:
            name = arkit_name(value[1])
            if name is not None:
                weights[COLUMN[name]] = float(value[2]) / 100
                names.append(name)
        elif field.lstrip("=").startswith("head#"):
            with suppress(ValueError):  # degrees
                angles = [float(part) for part in field.partition("#")[2].split(",")[:3]]
                pitch, yaw, roll = map(math.radians, angles)
                if all(map(math.isfinite, angles)):
                    head = (yaw, pitch, roll)
    if not names or not (np.abs(weights) <= MAX_WEIGHT).all():
        return None
    return FacePacket(tuple(names), weights, head)


MAX_TEXT_BYTES = 256 << 20
"""Largest file of a performance that is read."""
COUNT_COLUMN = "blendshapecount"
"""Plain name of the column that counts a row's shapes: 0 in rows without a face."""

MAX_OTHERS = 256
"""Columns of JSON frames, besides shapes, that are examined."""
MAX_PARTS = 6
"""Keys of nested dictionaries that the name of a value in a JSON frame has."""
MAX_LISTED = 16
"""Dictionaries of a list in a JSON frame that are examined."""
MAX_PERCENT = 110.0  # Largest weight in percent; some are a little above 100
FRAME_KEYS = ("frames", "weightMat", "weights", "blendShapeWeights", "data")
RATE_KEYS = ("exportFps", "fps", "FPS", "frameRate", "frame_rate", "framerate", "FrameRate")
NAME_KEYS = ("facsNames", "names", "blendShapeNames", "blendshapes", "blendShapes")
WEIGHT_KEYS = ("weights", "blendshapes", "blendShapes", "face_blendshapes", "values")
NAMED = ("categoryName", "category_name", "name")
SCORED = ("score", "value", "weight")


def csv_performance(path: Path) -> Performance:
    """Performance from a table with a row per frame. Raises StgaError."""
    rows = [row for _, row in read_table(path, MAX_TEXT_BYTES)]
    if not rows:
        raise StgaError(f"{path}: is empty, expected a row of column names")
    header = [cell.strip() for cell in rows[0]]
    frames = rows_of_shapes(header, rows[1:])
    if frames is not None:
        return frames_performance(path, frames)
    columns, guesses = columns_of(str(path), header)
    plain = {_plain(name): index for index, name in reversed([*enumerate(header)])}
    count = plain.get(COUNT_COLUMN)  # 0 in rows without a face, or they end after it
    body = [
        [*row, *[""] * (len(header) - len(row))]
        for row in rows[1:]
        if count is None or (len(row) > count + 1 and row[count].strip() not in ("", "0"))
    ]
    if not body:
        raise StgaError(f"{path}: has no row with a face")
    cells = [*zip(*body, strict=False)]
    weights = np.zeros((len(body), COUNT))
    for column, index in columns.items():
        weights[:, column] = numbers(str(path), header[index], cells[index])
    others: dict[str, Sequence[object]] = {}
    for index, name in enumerate(header):
        if index not in columns.values() and index != count:
            others.setdefault(name, cells[index])
    return _performance(path, weights, others, guesses)


def _plain(name: str) -> str:
    """A column's name without prefix, separators and capitals."""
    return re.sub(r"[_\- ]", "", name.rsplit(".", 1)[-1]).lower()


def packet_performance(path: Path) -> Performance:
    """Performance from lines that are iFacialMocap's packets. Raises StgaError."""
    lines = read_text(path, MAX_TEXT_BYTES).splitlines()
    check_rows(path, len(lines))
    packets = [parse_packet(line.encode()) for line in lines]
    known = [packet for packet in packets if packet is not None]
    if not known:
        raise StgaError(
            f"{path}: has no line of iFacialMocap, such as "
            "jawOpen-12|mouthSmile_L-5|=head#0,0,0,0,0,0|"
        )
    _, guesses = columns_of(str(path), known[0].names)
    weights = np.stack([packet.weights for packet in known if packet.weights is not None])
    heads = [packet.head for packet in known if packet.head is not None]
    head = np.array(heads) if len(heads) == len(known) else None
    return _performance(path, weights, {}, guesses, head=head)


def json_performance(path: Path) -> Performance:
    """Performance from a JSON file with frames of weights. Raises StgaError."""
    return frames_performance(path, read_json(path))


def lines_performance(path: Path) -> Performance:
    """Performance from lines that are JSON frames. Raises StgaError."""
    return frames_performance(path, read_lines(path, read_text(path, MAX_TEXT_BYTES)))


def text_performance(path: Path) -> Performance:
    """Performance from text: iFacialMocap's packets, Face Cap's recording, or a JSON frame per
    line. Raises StgaError."""
    text = read_text(path, MAX_TEXT_BYTES)
    if is_face_cap(text):
        return frames_performance(path, face_cap_frames(path, text))
    return lines_performance(path) if text.startswith("{") else packet_performance(path)


def frames_performance(path: Path, document: Any) -> Performance:
    """Performance from a JSON document with frames of weights. Raises StgaError."""
    document = plain_frames(document)
    outer = document if isinstance(document, dict) else {}
    frames = document if isinstance(document, list) else list_of(outer, FRAME_KEYS)
    if not frames:
        raise StgaError(f"{path}: has no list of frames; expected one of {', '.join(FRAME_KEYS)}")
    names = list_of(outer, NAME_KEYS)
    rows: list[dict[str, Any]] = []
    others: dict[str, list[object]] = {}
    for number, frame in enumerate(frames):
        where = f"{path}: frame {number + 1}"
        found = _json_weights(where, frame, names)
        shapes = {name: value for name, value in found.items() if arkit_name(name)}
        for name, value in shapes.items():
            _number(f"{where}: {shorten(name)}", value)
        if not shapes and isinstance(frame, dict):
            continue
        rest = _flat({name: value for name, value in found.items() if name not in shapes})
        if isinstance(frame, dict):
            rest |= _flat({key: value for key, value in frame.items() if value is not found})
        for name, value in rest.items():
            if name in others or len(others) < MAX_OTHERS:
                others.setdefault(name, [None] * len(frames))[len(rows)] = value
        rows.append(found)
    inner = outer.get("metadata")
    about = {**(inner if isinstance(inner, dict) else {}), **outer}
    key = next((key for key in RATE_KEYS if key in about), "")
    fps = _number(f"{path}: {key}", about[key]) if key else None
    beside = _columns_beside(outer, frames)
    if len(rows) == len(frames):
        others |= {name: values for name, values in beside.items() if name not in others}
    listed = list(dict.fromkeys(name for row in rows for name in row))
    columns, guesses = columns_of(str(path), listed)
    if len(rows) < len(frames):
        guesses.append(f"{len(frames) - len(rows)} frames without shapes are left out")
    weights = np.zeros((len(rows), COUNT))
    for column, index in columns.items():
        weights[:, column] = [row.get(listed[index], 0.0) for row in rows]
    kept = {name: values[: len(rows)] for name, values in others.items()}
    return _performance(path, weights, kept, guesses, fps)


def _json_weights(where: str, frame: Any, names: list[Any] | None) -> dict[str, Any]:
    """Name -> weight of one frame in any of the forms that are read; the dictionary that is in the
    frame itself, where it is."""
    found = _first(frame, WEIGHT_KEYS, frame) if isinstance(frame, dict) else frame
    if isinstance(found, list) and found and all(isinstance(entry, dict) for entry in found):
        found = {str(_first(entry, NAMED, None)): _first(entry, SCORED, 0) for entry in found}
    if isinstance(found, list):
        if names is None or len(names) != len(found):
            known = "none" if names is None else str(len(names))
            raise StgaError(f"{where}: has {len(found)} weights, but the file names {known}")
        found = {str(name): value for name, value in zip(names, found, strict=True)}
    if not isinstance(found, dict):
        raise StgaError(f"{where}: is {shorten(frame)}, expected named weights")
    return found


def _flat(values: dict[str, Any]) -> dict[str, object]:
    """Dotted name, of the last `MAX_PARTS` keys -> text or number of nested dictionaries, shallow
    ones first; of lists of three or four numbers those with x, y, z, w, of the first dictionaries
    of a list those with their number, of other lists the word "list"."""
    found: dict[str, object] = {}
    waiting = deque[tuple[tuple[str, ...], Any]]([((), values)])
    while waiting:
        keys, value = waiting.popleft()
        if isinstance(value, list):
            if len(value) in (3, 4) and all(map(_is_number, value)):
                value = dict(zip("xyzw", value, strict=False))
            elif value and all(isinstance(entry, dict) for entry in value):
                value = dict(enumerate(value[:MAX_LISTED]))
            else:
                value = "list"
        if isinstance(value, dict):
            waiting += (((*keys, str(key))[-MAX_PARTS:], inner) for key, inner in value.items())
        else:
            found.setdefault(".".join(keys), value)
    return found


def _columns_beside(outer: dict[str, Any], frames: list[Any]) -> dict[str, list[object]]:
    """Columns of the lists that stand beside that of the frames and are as long, as times do."""
    lists = {
        name: value
        for name, value in outer.items()
        if isinstance(value, list) and value is not frames and len(value) == len(frames)
    }
    rows = [
        _flat({name: value[row] for name, value in lists.items()}) for row in range(len(frames))
    ]
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: [row.get(name) for row in rows] for name in list(names)[:MAX_OTHERS]}


def _first(entry: dict[str, Any], keys: tuple[str, ...], default: Any) -> Any:
    """The value of the first of the keys that is there."""
    return next((entry[key] for key in keys if key in entry), default)


def _constant_rate(columns: Columns) -> float | None:
    """Rows a second by a column that is called so and holds one plausible number; None without."""
    for name, cells in columns.items():
        with suppress(StgaError):
            if _plain(name) in map(_plain, RATE_KEYS) and len(set(cells)) == 1:
                rate = float(numbers("", name, cells[:1])[0])
                return rate if MIN_FPS <= rate <= MAX_FPS else None
    return None


def _number(what: str, value: Any) -> float:
    if not _is_number(value):
        raise StgaError(f"{what} is {shorten(value)}, expected a number")
    return float(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300


def _performance(
    path: Path,
    weights: np.ndarray,
    others: Columns,
    guesses: list[str],
    fps: float | None = None,
    head: np.ndarray | None = None,
) -> Performance:
    """The checked performance in the order of its times; of rows with the same time the first.

    others   columns (T,) of what is no shape, in which times and the head's rotation are looked for
    guesses  what was guessed of the shapes
    head     yaw, pitch and roll (T, 3) in radians; None: columns hold them, or nothing does
    """
    where = str(path)
    check_rows(path, len(weights))
    if MAX_WEIGHT < np.abs(weights).max() <= MAX_PERCENT:
        guesses.append(f"weights reach {np.abs(weights).max():.4g}; they are read as percent")
        weights = weights / 100
    if not (np.abs(weights) <= MAX_WEIGHT).all():
        problem = f"holds weights beyond {MAX_WEIGHT:g}, or not finite; expected 0 to 1"
        raise StgaError(f"{path}: {problem}")
    fps = _constant_rate(others) if fps is None else fps
    times, notes, guess = find_times(where, others, fps)
    if times is None:
        if fps is None:
            without = f" ({'; '.join(notes)})" if notes else ""
            taken = f"its rows are taken as {DEFAULT_FPS:g} a second"
            notes = []
            guess = Guess(f"says no times{without}; {taken}; {OTHER_RATE}", DEFAULT_FPS)
        rate = DEFAULT_FPS if fps is None else fps
        rate = rate if MIN_FPS <= rate <= MAX_FPS else np.nan
        times = np.arange(len(weights)) / rate
    if not np.isfinite(times).all():
        expected = f"expected {MIN_FPS:g} to {MAX_FPS:g} a second"
        raise StgaError(f"{path}: its times or its rate are not usable; {expected}")
    if head is None:
        head, turns = find_head(where, others, times)
        guesses += turns
    guesses += [*notes, *([guess.text] if guess else [])]
    times, first = np.unique(times - times.min(), return_index=True)
    times, rate = at_even_times(times)
    rate = fps or rate
    if not MIN_FPS <= rate <= MAX_FPS or times[-1] * rate > MAX_ROWS:
        expected = f"expected {MIN_FPS:g} to {MAX_FPS:g}"
        raise StgaError(f"{path}: has {rate:.3g} rows a second over {times[-1]:.0f} s, {expected}")
    head = np.zeros((len(first), 3)) if head is None else head[first]
    warnings = tuple(f"{path}: {text}" for text in guesses)
    return Performance(times, weights[first], head, rate, warnings, guess.fps if guess else None)
