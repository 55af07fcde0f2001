"""Arguments that several commands share, and the types of their values."""

import argparse
import errno
import math
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..capture.transforms import PRINCIPAL_POINTS
from ..render.device import is_device
from ..requests.open_head import OpenHead

MAX_NAME_BYTES = 255
"""Longest name of a file or folder on the file systems of Linux, macOS and Windows."""


def add_capture(command: argparse.ArgumentParser, head: OpenHead | None) -> None:
    """CAPTURE, --flame and --principal-point; CAPTURE may be left out where a head is open."""
    optional: dict[str, Any] = {} if head is None else {"nargs": "?"}
    command.add_argument("capture", type=usable_path, metavar="CAPTURE", help="folder of the capture", **optional)
    command.add_argument("--flame", type=usable_path, metavar="FILE", help="FLAME model file (.pkl or .npz)")
    add_principal_point(command)


def add_principal_point(
    command: argparse.ArgumentParser, help: str = "what cy means in the capture (default vhap)"
) -> None:
    command.add_argument("--principal-point", choices=tuple(PRINCIPAL_POINTS), help=help)


def add_avatar(command: argparse.ArgumentParser, name: str, metavar: str, head: OpenHead | None) -> None:
    """An avatar's file or run folder, which may be left out where the open file shows an avatar."""
    optional: dict[str, Any] = {} if head is None or head.avatar is None else {"nargs": "?", "default": head.avatar}
    command.add_argument(name, type=usable_path, metavar=metavar, **optional)


def add_effects(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--effect",
        action="append",
        default=[],
        metavar="NAME=on|off",
        help="switch an effect on or off instead of deciding from the capture (docs/effects.md); may be repeated",
    )


def add_device(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--device",
        type=device_name,
        default="auto",
        metavar="{auto,cpu,gpu,gpu:NAME}",
        help="gpu: the first graphics adapter; gpu:NAME: the one whose name has this part; auto (default): a GPU if it "
        "is right and faster than the CPU in a trial of a second, else the CPU",
    )


def device_name(text: str) -> str:
    """Raises argparse.ArgumentTypeError for what is no device."""
    if not is_device(text):
        raise argparse.ArgumentTypeError(f"'{text}' is not auto, cpu, gpu or gpu:NAME")
    return text


def usable_path(text: str) -> Path:
    """Raises argparse.ArgumentTypeError for a name that no file can have: empty, too long or with a NUL."""
    try:
        os.lstat(text)
        too_long = False
    except OSError as error:
        too_long = error.errno == errno.ENAMETOOLONG
    except ValueError as error:  # a NUL, or a character that file names cannot encode
        raise argparse.ArgumentTypeError(f"'{text}' is not a usable path ({error})") from error
    # The system looks at names in turn and stops at the first that is missing.
    if too_long or any(len(os.fsencode(part)) > MAX_NAME_BYTES for part in Path(text).parts):
        raise argparse.ArgumentTypeError(f"'{text}' is not a usable path (too long)")
    if not text:
        raise argparse.ArgumentTypeError("the path is empty")
    return Path(text)


def whole_number(minimum: int) -> Callable[[str], int]:
    """Type of a whole number from `minimum` up."""

    def parse(text: str) -> int:
        if not re.fullmatch(r"\d{1,18}", text, re.ASCII) or int(text) < minimum:
            raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from {minimum} up")
        return int(text)

    return parse


def real_number(text: str) -> float:
    """A finite number from 0 up. Raises argparse.ArgumentTypeError for anything else."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number from 0 up")
    return value


def frame_rate(text: str) -> float:
    """A number above 0. Raises argparse.ArgumentTypeError for anything else."""
    value = real_number(text)
    if not value:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number above 0")
    return value


def frame_span(text: str) -> tuple[int, int]:
    """ "10:20" or "10-20", both included. Raises argparse.ArgumentTypeError for anything else."""
    match = re.fullmatch(r"(\d{1,18})[:-](\d{1,18})", text, re.ASCII)
    first, last = (int(part) for part in match.groups()) if match else (1, 0)
    if first > last:
        raise argparse.ArgumentTypeError(f"'{text}' is not a range of frames such as 10:20 or 10-20")
    return first, last


def degrees(text: str) -> float:
    """An angle up to a full turn. Raises argparse.ArgumentTypeError for anything else."""
    value = real_number(text)
    if not 0 < value <= 360:
        raise argparse.ArgumentTypeError(f"'{text}' is not an angle above 0 and up to 360 degrees")
    return value


def duration(text: str) -> float:
    """Seconds in "90", "90s", "10m", "1h30m", more than 0. Raises argparse.ArgumentTypeError for anything else."""
    match = re.fullmatch(r"(?:(\d+(?:\.\d+)?)h)?(?:(\d+(?:\.\d+)?)m)?(?:(\d+(?:\.\d+)?)s?)?", text.strip(), re.ASCII)
    if not match or not any(match.groups()):
        raise argparse.ArgumentTypeError(f"'{text}' is not a time such as 90s, 10m or 1h30m")
    hours, minutes, seconds = (float(part or 0) for part in match.groups())
    total = 3600 * hours + 60 * minutes + seconds
    if not 0 < total < math.inf:
        raise argparse.ArgumentTypeError(f"'{text}' is not a positive time")
    return total


def color(text: str) -> tuple[float, float, float]:
    """ "white", "black" or three numbers in 0…1. Raises argparse.ArgumentTypeError for anything else."""
    named = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
    if text in named:
        return named[text]
    try:
        red, green, blue = (float(part) for part in text.split(","))
    except ValueError:
        red = -1.0
    if not all(0 <= value <= 1 for value in ([red] if red < 0 else [red, green, blue])):
        raise argparse.ArgumentTypeError(f"'{text}' is not white, black or R,G,B with numbers in 0…1")
    return red, green, blue
