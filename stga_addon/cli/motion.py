"""Options of commands that take a motion."""

import argparse
from argparse import ArgumentParser, Namespace

from ..driving.open_motion import MAX_FACTOR, MAX_SMOOTHING_S, NEUTRALS, MotionOptions, parsed_gain
from ..driving.performance import EXCHANGEABLE
from ..errors import StgaError
from .arguments import real_number

OPTIONS = ("strength", "neutral", "smooth", "mirror", "exchange", "gain", "stay_trained")
MOTION_HELP = (
    "another person's motion: FLAME parameters (.npz, or a capture), or a performance in ARKit's shapes (CSV of Live "
    "Link Face or Audio2Face, its take folder, JSON, iFacialMocap's text)"
)


def add_motion_options(parser: ArgumentParser) -> None:
    """What `MotionOptions` holds."""
    group = parser.add_argument_group("motion")
    group.add_argument("--strength", type=factor, help="of the motion; 1 (default): as recorded")
    group.add_argument(
        "--neutral",
        choices=NEUTRALS,
        help="take the motion relative to the performer's quiet face or first frame (calibrated: it is already), and "
        "put it on the head's own",
    )
    group.add_argument("--smooth", type=smoothing, metavar="SECONDS", help="smooth a performance in time")
    group.add_argument("--mirror", action="store_true", help="exchange left and right of a performance")
    group.add_argument(
        "--exchange",
        choices=EXCHANGEABLE,
        action="append",
        default=[],
        help="exchange left and right of one pair alone, which some senders exchange; may be repeated",
    )
    group.add_argument(
        "--gain",
        type=gain,
        action="append",
        default=[],
        metavar="NAME=FACTOR",
        help="scale a part of a performance (face, jaw, eyes, head) or one shape, such as jawOpen; may be repeated",
    )
    group.add_argument(
        "--stay-trained",
        type=share,
        nargs="?",
        const=1.0,
        metavar="SHARE",
        help="lead the motion softly back to the range that the run was trained on, and print how far it was outside; "
        "0: print only, 1 (default): fully",
    )


def gain(text: str) -> tuple[str, float]:
    """Raises argparse.ArgumentTypeError for what is no NAME=FACTOR."""
    try:
        return parsed_gain(text)
    except StgaError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def factor(text: str) -> float:
    """A number from 0 to MAX_FACTOR. Raises argparse.ArgumentTypeError for anything else."""
    return _at_most(text, MAX_FACTOR)


def smoothing(text: str) -> float:
    """Seconds from 0 to MAX_SMOOTHING_S. Raises argparse.ArgumentTypeError for anything else."""
    return _at_most(text, MAX_SMOOTHING_S)


def share(text: str) -> float:
    """A number from 0 to 1. Raises argparse.ArgumentTypeError for anything else."""
    return _at_most(text, 1.0)


def _at_most(text: str, limit: float) -> float:
    value = real_number(text)
    if value > limit:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number from 0 to {limit:g}")
    return value


def motion_options(options: Namespace) -> MotionOptions:
    """The options of `add_motion_options` as a value."""
    return MotionOptions(
        strength=1.0 if options.strength is None else options.strength,
        neutral=options.neutral or "none",
        smoothing=options.smooth or 0.0,
        mirror=options.mirror,
        exchange=tuple(options.exchange),
        gains=dict(options.gain),
        stay_trained=options.stay_trained,
    )


def check_motion_options(options: Namespace) -> None:
    """Raise StgaError for an option of `add_motion_options` without --motion, where it would have no effect."""
    for name in OPTIONS:
        value = getattr(options, name)
        if value is not None and value is not False and value != []:
            raise StgaError(f"--{name.replace('_', '-')}: has no effect without --motion")
