"""The head's rotation in a performance: columns by their names, radians or degrees."""

import math
import re
from collections.abc import Set

import numpy as np

from ..errors import StgaError
from .clocks import Columns, numbers

AXES = {"yaw": 0, "pitch": 1, "roll": 2, "y": 0, "x": 1, "z": 2, "w": 3}
"""Last letters of an angle's name -> its place in (yaw, pitch, roll), or the quaternion's real
part."""
_ROTATION = "(?:rotation|rot|quaternion|quat|eulerangles?|euler|angles?|orientation|pose)"
"""Pattern of the words for a rotation in the names of columns."""
_UNIT = "(?P<unit>deg(?:ree)?s?|rad(?:ian)?s?)?"
"""Pattern of an angle's unit at the end of a name, which may be missing."""
_NAME = re.compile(
    f"(?:(?:head|{_ROTATION})*(yaw|pitch|roll)|head(?:{_ROTATION}+|r|q)([xyzw])){_UNIT}"
)
"""Pattern of the columns that are read: angles of the head, or its quaternion's parts."""
_LIKE_A_ROTATION = re.compile(
    "(?!.*(?:eye|gaze|camera|mouth|jaw|hand))"
    f"(?:head.?.?$|.*(?:{_ROTATION}|matrix|transform|yaw|pitch|roll)|r[xyz]$)"
)
"""Pattern of the columns that may rotate a head: those not read are named in a message."""

NECK_RAD = np.radians([100.0, 80.0, 80.0])
"""Yaw, pitch and roll that no neck reaches."""
STRAINED_RAD = np.radians([80.0, 60.0, 50.0])
"""Yaw, pitch and roll that few necks reach, in radians; tiny angles in degrees may seem to."""
MAX_OUTLIERS = 0.01
"""Fraction of rows beyond `NECK_RAD` that tracking errors explain."""
MAX_TURN_RAD_S = 12.0
"""Speed of yaw and pitch that no neck reaches, in radians a second."""
TURN_S = 0.1
"""Seconds over which this speed is measured."""
QUESTIONED_RAD = 0.5
"""Angle that, where nothing states the unit, is large in radians and small in degrees."""
IF_DEGREES = "if they are degrees, --gain head=0.01745, in Blender Head Gain, scales them"
"""End of a message about guessed radians."""
HALF_TURN_RAD = math.pi + 0.01
WHOLE_TURN_RAD = 2 * math.pi + 0.01
WHOLE_TURN_DEG = 360.0


def find_head(
    where: str, columns: Columns, times: np.ndarray
) -> tuple[np.ndarray | None, list[str]]:
    """(T, 3) yaw, pitch and roll in radians, None without any; and a sentence each for what was
    guessed, and for what is called a head's and is not used.

    columns  name -> texts or numbers (T,) of what is no shape. Angles about x, y and z are pitch,
             yaw and roll; with w they are a quaternion of a right-handed system with y up, z ahead
    times    (T,) seconds
    Raises StgaError, beginning with `where`, for texts that are no numbers, and for angles beyond a
    turn in degrees.
    """
    axes: dict[str, str] = {}
    unit_of: dict[str, str] = {}
    others = []
    for name, cells in columns.items():
        parts = name.lower().split(".")
        tails = [_plain("".join(parts[place:])) for place in range(len(parts))]
        tails = [tail for place, tail in enumerate(tails) if not place or tail.startswith("head")]
        found = next(filter(None, map(_NAME.fullmatch, tails)), None)
        if found is not None and not any(cell in (None, "") for cell in cells):
            axis = found[1] or found[2]
            axes.setdefault(axis, name)
            unit_of.setdefault(axis, (found["unit"] or "")[:3])
        elif any(map(_LIKE_A_ROTATION.match, tails)):
            others.append(name)
    named = [axis for axis in ("yaw", "pitch", "roll") if axis in axes]
    about = [axis for axis in "xyzw" if axis in axes]
    used = named or (about if {"x", "y", "z"} <= axes.keys() else [])
    others += [name for axis, name in axes.items() if axis not in used]
    notes = [f"{', '.join(others)}: not read, as yaw, pitch and roll of all rows"] if others else []
    if not used:
        return None, notes
    values = np.zeros((len(columns[axes[used[0]]]), 4))
    units = {unit_of[axis] for axis in used}
    units = units - {""} or units
    for axis in used:
        angles = numbers(where, axes[axis], columns[axes[axis]])
        values[:, AXES[axis]] = np.radians(angles) if units > {unit_of[axis]} == {"deg"} else angles
    if len(units) > 1:
        notes.append(f"{', '.join(axes[axis] for axis in used)}: are in different units")
        units = {"rad"}
    if named:
        return _in_radians(where, values[:, :3], times, (units, notes))
    origin = axes["x"].rpartition(".")[0] or axes["x"]
    if "w" not in axes:
        notes.append(f"{origin}: angles about x, y, z are read as pitch, yaw, roll")
        return _in_radians(where, values[:, :3], times, (units, notes))
    notes.append(f"{origin}: is read as a quaternion x, y, z, w, with y up")
    return angles_of_quaternions(values), notes


def _plain(name: str) -> str:
    return re.sub(r"[^a-z]", "", name.lower().replace("°", "deg"))


def angles_of_quaternions(values: np.ndarray) -> np.ndarray:
    """(T, 3) yaw, pitch, roll of (T, 4) y, x, z, w."""
    length = np.linalg.norm(values, axis=1, keepdims=True)
    y, x, z, w = (values / np.maximum(length, 1e-12)).T
    yaw = np.arctan2(2 * (w * y + x * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * x - y * z), -1, 1))
    return np.stack([yaw, pitch, np.arctan2(2 * (w * z + x * y), 1 - 2 * (x * x + z * z))], axis=1)


def _in_radians(
    where: str, head: np.ndarray, times: np.ndarray, said: tuple[Set[str], list[str]]
) -> tuple[np.ndarray, list[str]]:
    """The angles (T, 3) in radians, and the notes with a sentence where their unit is guessed, or
    where no neck turns so far. Raises StgaError, beginning with `where`, for angles beyond a turn
    in degrees.

    said: which of "deg" and "rad" the columns' names hold, "" of names without; and the notes
    """
    units, notes = said
    turn = float(np.abs(head).max())
    if not turn <= WHOLE_TURN_DEG:
        problem = "head rotation is beyond a turn, or not finite; expected radians"
        raise StgaError(f"{where}: {problem}")
    if units == {"deg"}:
        return np.radians(head), notes
    is_named = units == {"rad"}
    reached = np.abs(np.remainder(head + math.pi, 2 * math.pi) - math.pi)
    # a camera on its side or upside down turns the roll alone
    is_beyond = (reached > NECK_RAD)[:, :2].any(axis=1).mean() > MAX_OUTLIERS
    is_fast = _fraction_too_fast(head[:, :2], times) > MAX_OUTLIERS
    if turn > WHOLE_TURN_RAD or ((is_beyond or is_fast) and not is_named):
        guess = f"the head's angles reach {turn:.4g}; they are read as degrees"
        if not is_beyond and turn <= WHOLE_TURN_RAD:
            guess += ", because no neck turns as fast in radians"
        return np.radians(head), [*notes, guess]
    taken = "the head's angles reach {:.4g}; they are read as radians"
    advice = "" if is_named else f"; {IF_DEGREES}"
    if turn > HALF_TURN_RAD:
        return head, [*notes, taken.format(turn)]
    strained = reached > STRAINED_RAD
    if strained.any(axis=1).mean() > MAX_OUTLIERS or (reached > NECK_RAD).any():
        far = float(np.abs(head[strained]).max())
        necks = "no neck turns" if (reached > NECK_RAD).any() else "few necks turn"
        notes = [*notes, f"{taken.format(far)}, though {necks} so far{advice}"]
    elif not is_named and (reached > QUESTIONED_RAD).any(axis=1).mean() > MAX_OUTLIERS:
        notes = [*notes, f"{taken.format(turn)}, {math.degrees(turn):.0f}°{advice}"]
    return head, notes


def _fraction_too_fast(angles: np.ndarray, times: np.ndarray) -> float:
    """Fraction of the rows in which angles (T, n) turn faster than `MAX_TURN_RAD_S`."""
    order = np.argsort(times)
    at = times[order]
    turned = [np.interp(at + TURN_S, at, each) - each for each in angles[order].T]
    return float((np.abs(turned) > MAX_TURN_RAD_S * TURN_S).any(axis=0).mean())
