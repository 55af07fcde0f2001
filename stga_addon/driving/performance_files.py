"""Files of performances: Live Link Face, Audio2Face, MediaPipe, iFacialMocap, weights in JSON."""

import math
import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import StgaError, shorten
from ..files import read_json, read_table, read_text
from .clocks import DEFAULT_FPS, evened, seconds_of, seconds_of_numbers, time_column
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
MAX_ROWS = 1 << 20
MIN_FPS = 1.0
MAX_FPS = 1000.0
HEAD_COLUMNS = ("headyaw", "headpitch", "headroll")
COUNT_COLUMN = "blendshapecount"
HALF_TURN = math.pi + 0.01
WHOLE_TURN = 2 * math.pi + 0.01
WHOLE_TURN_DEG = 360.0
"""Of a head's angles: above the second, they are degrees."""
MAX_PERCENT = 110.0  # Of weights, of which some are a little above the whole
FRAME_KEYS = ("frames", "weightMat", "weights")
RATE_KEYS = ("exportFps", "fps", "FPS", "frameRate", "frame_rate", "framerate", "FrameRate")
NAME_KEYS = ("facsNames", "names", "blendShapeNames", "blendshapes")
WEIGHT_KEYS = ("weights", "blendshapes", "blendShapes", "face_blendshapes")
NAMED = ("categoryName", "category_name", "name")
SCORED = ("score", "value", "weight")


def csv_performance(path: Path) -> Performance:
    """Of a table with a row a frame. Raises StgaError."""
    rows = [row for _, row in read_table(path, MAX_TEXT_BYTES)]
    if not rows:
        raise StgaError(f"{path}: is empty, expected a row of column names")
    header = [cell.strip() for cell in rows[0]]
    columns = columns_of(str(path), header)
    plain = {_plain(name): index for index, name in reversed([*enumerate(header)])}
    count = plain.get(COUNT_COLUMN)  # 0 in rows without a face, or they end after it
    body = [
        [*row, *[""] * (len(header) - len(row))]
        for row in rows[1:]
        if count is None or (len(row) > count + 1 and row[count].strip() not in ("", "0"))
    ]
    if not body:
        raise StgaError(f"{path}: has no row with a face")

    def values(index: int) -> np.ndarray:
        """(T,) of a column."""
        found = np.empty(len(body))
        for number, row in enumerate(body):
            try:
                found[number] = float(row[index])
            except ValueError:
                raise StgaError(
                    f"{path}: row {number + 1}: {shorten(header[index])} is "
                    f"{shorten(row[index])}, expected a number"
                ) from None
        return found

    weights = np.zeros((len(body), COUNT))
    for column, index in columns.items():
        weights[:, column] = values(index)
    head = np.zeros(3)
    if all(name in plain for name in HEAD_COLUMNS):
        head = np.stack([values(plain[name]) for name in HEAD_COLUMNS], axis=1)
    times = None
    guess = None
    if clock := time_column(header):
        place, unit = clock
        codes = [row[place] for row in body]
        if any(":" in code for code in codes):
            times = seconds_of(str(path), codes)
        else:
            times, guess = seconds_of_numbers(f"column {header[place]}", values(place), unit)
    return _performance(path, times, weights, head, guess=guess)


def _plain(name: str) -> str:
    """A column's name without prefix, separators and capitals."""
    return re.sub(r"[_\- ]", "", name.rsplit(".", 1)[-1]).lower()


def packet_performance(path: Path) -> Performance:
    """Of lines that are iFacialMocap's packets. Raises StgaError."""
    lines = read_text(path, MAX_TEXT_BYTES).splitlines()
    packets = [parse_packet(line.encode()) for line in lines]
    known = [packet for packet in packets if packet is not None]
    if not known:
        raise StgaError(
            f"{path}: has no line of iFacialMocap, such as "
            "jawOpen-12|mouthSmile_L-5|=head#0,0,0,0,0,0|"
        )
    columns_of(str(path), known[0].names)
    weights = np.stack([packet.weights for packet in known if packet.weights is not None])
    heads = [packet.head for packet in known if packet.head is not None]
    head = np.array(heads) if len(heads) == len(known) else np.zeros(3)
    return _performance(path, None, weights, head)


def json_performance(path: Path) -> Performance:
    """Of frames of weights. Raises StgaError."""
    document = read_json(path)
    outer = document if isinstance(document, dict) else {}
    frames = next((outer[key] for key in FRAME_KEYS if isinstance(outer.get(key), list)), document)
    if not isinstance(frames, list) or not frames:
        raise StgaError(f"{path}: has no list of frames; expected one of {', '.join(FRAME_KEYS)}")
    names = next((outer[key] for key in NAME_KEYS if isinstance(outer.get(key), list)), None)
    rows = [_json_weights(path, number, frame, names) for number, frame in enumerate(frames)]
    listed = list(rows[0])
    columns = columns_of(str(path), listed)
    weights = np.zeros((len(rows), COUNT))
    for column, index in columns.items():
        name = listed[index]
        for number, row in enumerate(rows):
            if name not in row:
                raise StgaError(f"{path}: frame {number + 1}: lacks {shorten(name)}")
            weights[number, column] = row[name]
    inner = outer.get("metadata")
    about = {**(inner if isinstance(inner, dict) else {}), **outer}
    key = next((key for key in RATE_KEYS if key in about), "")
    fps = _number(f"{path}: {key}", about[key]) if key else None
    times, guess = _json_times(path, frames, fps)
    turns = {_plain(name): name for name in rows[0]}
    head = np.zeros(3)
    if all(turns.get(name) in row for row in rows for name in HEAD_COLUMNS):
        head = np.array([[row[turns[name]] for name in HEAD_COLUMNS] for row in rows])
    return _performance(path, times, weights, head, fps, guess)


def _json_times(
    path: Path, frames: list[Any], fps: float | None
) -> tuple[np.ndarray | None, str | None]:
    """Times of the frames that all say theirs, by the names and units of columns of a table."""
    if not all(isinstance(frame, dict) for frame in frames):
        return None, None
    keys = list(frames[0])
    clock = time_column(map(str, keys))
    if clock is None:
        return None, None
    key = keys[clock[0]]
    unit = clock[1]
    told = [frame.get(key) for frame in frames]
    if all(isinstance(value, str) and ":" in value for value in told):
        return seconds_of(str(path), [str(value) for value in told]), None
    if not all(_is_number(value) for value in told):
        return None, None
    return seconds_of_numbers(str(key), np.array(told, np.float64), unit, fps)


def _json_weights(path: Path, number: int, frame: Any, names: list[Any] | None) -> dict[str, float]:
    """Name -> weight of one frame in any of the forms that are read."""
    where = f"{path}: frame {number + 1}"
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
    return {
        str(name): _number(f"{where}: {shorten(str(name))}", value)
        for name, value in found.items()
        if arkit_name(str(name)) or _is_number(value)
    }


def _first(entry: dict[str, Any], keys: tuple[str, ...], default: Any) -> Any:
    """The value of the first of the keys that is there."""
    return next((entry[key] for key in keys if key in entry), default)


def _number(what: str, value: Any) -> float:
    if not _is_number(value):
        raise StgaError(f"{what} is {shorten(value)}, expected a number")
    return float(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300


def _performance(
    path: Path,
    times: np.ndarray | None,
    weights: np.ndarray,
    head: np.ndarray,
    fps: float | None = None,
    guess: str | None = None,
) -> Performance:
    """The checked performance in the order of its times; of rows with the same time the first.
    guess: what was guessed of the times."""
    guesses = [] if guess is None else [guess]
    if len(weights) > MAX_ROWS:
        raise StgaError(f"{path}: has {len(weights)} rows, expected at most {MAX_ROWS}")
    if MAX_WEIGHT < np.abs(weights).max() <= MAX_PERCENT:
        guesses.append(f"weights reach {np.abs(weights).max():.4g}; they are read as percent")
        weights = weights / 100
    if not (np.abs(weights) <= MAX_WEIGHT).all():
        problem = f"holds weights beyond {MAX_WEIGHT:g}, or not finite; expected 0 to 1"
        raise StgaError(f"{path}: {problem}")
    turn = float(np.abs(head).max())
    if not turn <= WHOLE_TURN_DEG:
        problem = "head rotation is beyond a turn, or not finite; expected radians"
        raise StgaError(f"{path}: {problem}")
    if turn > HALF_TURN:
        unit = "degrees" if turn > WHOLE_TURN else "radians"
        guesses.append(f"the head's angles reach {turn:.4g}; they are read as {unit}")
        head = np.radians(head) if turn > WHOLE_TURN else head
    if times is None:
        if fps is None:
            guesses.append(f"says no times; its rows are taken as {DEFAULT_FPS:g} a second")
        rate = DEFAULT_FPS if fps is None else fps
        rate = rate if MIN_FPS <= rate <= MAX_FPS else np.nan
        times = np.arange(len(weights)) / rate
    if not np.isfinite(times).all():
        expected = f"expected {MIN_FPS:g} to {MAX_FPS:g} a second"
        raise StgaError(f"{path}: its times or its rate are not usable; {expected}")
    times, first = np.unique(times - times.min(), return_index=True)
    times, rate = evened(times)
    rate = fps or rate
    if not MIN_FPS <= rate <= MAX_FPS or times[-1] * rate > MAX_ROWS:
        expected = f"expected {MIN_FPS:g} to {MAX_FPS:g}"
        raise StgaError(f"{path}: has {rate:.3g} rows a second over {times[-1]:.0f} s, {expected}")
    head = np.broadcast_to(head, (len(weights), 3))[first]
    warnings = tuple(f"{path}: {text}" for text in guesses)
    return Performance(times, weights[first], head, rate, warnings)
