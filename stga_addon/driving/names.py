"""Names of ARKit's 52 blend shapes, in every spelling that capture tools use."""

import re
from collections.abc import Iterable

from ..errors import StgaError, shorten

ARKIT_SHAPES = (
    "eyeBlinkLeft", "eyeLookDownLeft", "eyeLookInLeft", "eyeLookOutLeft", "eyeLookUpLeft", "eyeSquintLeft",
    "eyeWideLeft", "eyeBlinkRight", "eyeLookDownRight", "eyeLookInRight", "eyeLookOutRight", "eyeLookUpRight",
    "eyeSquintRight", "eyeWideRight", "jawForward", "jawRight", "jawLeft", "jawOpen", "mouthClose", "mouthFunnel",
    "mouthPucker", "mouthRight", "mouthLeft", "mouthSmileLeft", "mouthSmileRight", "mouthFrownLeft",
    "mouthFrownRight", "mouthDimpleLeft", "mouthDimpleRight", "mouthStretchLeft", "mouthStretchRight",
    "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper", "mouthPressLeft", "mouthPressRight",
    "mouthLowerDownLeft", "mouthLowerDownRight", "mouthUpperUpLeft", "mouthUpperUpRight", "browDownLeft",
    "browDownRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight", "cheekPuff", "cheekSquintLeft",
    "cheekSquintRight", "noseSneerLeft", "noseSneerRight", "tongueOut",
)  # fmt: skip
"""In the order of Live Link Face's CSV files."""
COUNT = len(ARKIT_SHAPES)
MAX_WEIGHT = 10.0
"""Beyond it, weights of shapes are in percent, or are no weights."""
COLUMN = {name: column for column, name in enumerate(ARKIT_SHAPES)}
OPTIONAL = ("tongueOut",)
"""Shapes that sources of 51 lack; they stay zero."""
PARTS = ("face", "jaw", "eyes")
MAX_NAMED = 8
"""Names that an error lists."""
_KEYS = {name.lower(): name for name in ARKIT_SHAPES}


def arkit_name(name: str) -> str | None:
    """ARKit's spelling of a shape's name, or None where it is none of the 52.

    Any capitals and separators, a prefix up to the last dot, and `_L` or `_R` for Left and Right are accepted:
    `blendShapes.JawOpen`, `mouth_smile_left`, `mouthSmile_L`.
    """
    plain = name.rsplit(".", 1)[-1].strip()
    side = re.fullmatch(r"(.*)[_\- ]([LR])", plain, re.IGNORECASE | re.DOTALL)
    if side:
        plain = side[1] + ("left" if side[2] in "lL" else "right")
    return _KEYS.get(re.sub(r"[_\- ]", "", plain).lower())


def part_of(name: str) -> str:
    """Which of `PARTS` an ARKit shape belongs to."""
    if name.startswith("jaw"):
        return "jaw"
    return "eyes" if name.startswith("eyeLook") else "face"


def mirrored_name(name: str) -> str:
    """The shape of the other side; shapes without a side are their own."""
    if name.endswith("Left"):
        return name.removesuffix("Left") + "Right"
    return name.removesuffix("Right") + "Left" if name.endswith("Right") else name


def columns_of(where: str, names: Iterable[str]) -> dict[int, int]:
    """Column of the 52 -> index in `names` (the first of each).

    Raises StgaError, which begins with `where`, naming the shapes that are missing; those of `OPTIONAL` may be.
    """
    listed = list(names)
    found: dict[int, int] = {}
    for index, name in enumerate(listed):
        spelled = arkit_name(name)
        if spelled is not None:
            found.setdefault(COLUMN[spelled], index)
    missing = [name for name in ARKIT_SHAPES if COLUMN[name] not in found and name not in OPTIONAL]
    if not missing:
        return found
    if len(missing) > COUNT // 2:
        raise StgaError(f"{where}: names {len(found)} of ARKit's {COUNT} blend shapes, expected all but tongueOut")
    more = f" and {len(missing) - MAX_NAMED} more" if len(missing) > MAX_NAMED else ""
    raise StgaError(f"{where}: lacks {', '.join(missing[:MAX_NAMED])}{more}{_unknown(listed)}")


def _unknown(names: list[str]) -> str:
    """What stands there instead of the missing names, if anything does: mistyped names, most likely."""
    prefixes = ("eye", "jaw", "mouth", "brow", "cheek", "nose", "tongue")
    rotations = re.compile(r"(left|right)?(eye|head)(yaw|pitch|roll)|(left|right)eye(yaw|pitch|roll)")
    strange = [
        name
        for name in names
        if arkit_name(name) is None
        and name.rsplit(".", 1)[-1].lower().startswith(prefixes)
        and not rotations.fullmatch(name.lower())
    ]
    return f"; it has {', '.join(shorten(name) for name in strange[:MAX_NAMED])}" if strange else ""
