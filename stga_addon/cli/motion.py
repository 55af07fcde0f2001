"""Options of commands that take a motion, and its opening for an avatar."""

import argparse
from argparse import ArgumentParser, Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..avatar.file import Avatar
from ..capture.flame_capture import sequence_capture
from ..capture.model import Capture
from ..driving.names import ARKIT_SHAPES, PARTS
from ..driving.open_motion import Motion, MotionOptions, open_motion
from ..driving.transfer import NEUTRALS, TrainedRange, trained_range
from ..errors import StgaError
from ..training.run.folder import read_run
from .arguments import real_number

OPTIONS = ("strength", "neutral", "smooth", "mirror", "gain", "stay_trained")
MAX_FACTOR, MAX_SMOOTHING_S = 100.0, 10.0
MOTION_HELP = (
    "another person's motion: FLAME parameters (.npz, or a capture), or a performance in ARKit's shapes (CSV of Live "
    "Link Face or Audio2Face, its take folder, JSON, iFacialMocap's text)"
)


def add_motion_options(parser: ArgumentParser) -> None:
    """What `MotionOptions` holds."""
    group = parser.add_argument_group("motion")
    group.add_argument("--strength", type=factor, help="of the motion; 1 (default): as recorded")
    group.add_argument(
        "--neutral", choices=NEUTRALS, help="take the motion relative to the performer's quiet face or first frame"
    )
    group.add_argument("--smooth", type=smoothing, metavar="SECONDS", help="smooth a performance in time")
    group.add_argument("--mirror", action="store_true", help="exchange left and right of a performance")
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
    name, _, value = text.partition("=")
    if name not in (*PARTS, "head", *ARKIT_SHAPES):
        raise argparse.ArgumentTypeError(f"'{text}' names none of {', '.join((*PARTS, 'head'))} and ARKit's shapes")
    return name, factor(value)


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
        gains=dict(options.gain),
        stay_trained=options.stay_trained or 0.0,
    )


def check_motion_options(options: Namespace) -> None:
    """Raise StgaError for an option of `add_motion_options` without --motion, where it would have no effect."""
    for name in OPTIONS:
        value = getattr(options, name)
        if value is not None and value is not False and value != []:
            raise StgaError(f"--{name.replace('_', '-')}: has no effect without --motion")


def open_avatar_motion(options: Namespace, source: Path, avatar: Avatar) -> Motion:
    """--motion on the avatar of a run folder or file; with --stay-trained, prints how far it is outside that range."""
    run = read_run(source) if source.is_dir() else None
    flame = options.flame or (run.flame if run is not None else None)
    asked = options.stay_trained is not None
    trained = _trained(source, options.flame) if asked and run is not None else None
    if asked and trained is None:
        raise StgaError(f"--stay-trained: {source} is no run with a FLAME capture, whose motion would be the range")
    motion = open_motion(
        options.motion, flame, avatar.neutral, avatar.faces, motion_options(options), trained, options.fps
    )
    for line in findings(motion):
        print(line)
    return motion


def _trained(folder: Path, flame: Path | None) -> TrainedRange | None:
    """What the run's capture holds; None where it was not tracked with FLAME."""
    from ..training.run.open_run import open_run

    own = open_run(folder, flame=flame).capture.flame
    return None if own is None else trained_range([own.frame(timestep) for timestep in own.timesteps])


def findings(motion: Motion) -> list[str]:
    """What to say about a motion: rows that were lost, and how far it goes beyond what was trained."""
    lines = [f"{motion.lost} rows are missing and were interpolated"] if motion.lost else []
    for part, beyond in motion.outside.items():
        if beyond.any():
            share_outside = 100 * float(np.mean(beyond > 0))
            lines.append(
                f"{part}: {share_outside:.0f} % of the frames are outside the trained range, by up to "
                f"{beyond.max():.1f} of its half width (frame {int(beyond.argmax())})"
            )
    return lines


def motion_capture(options: Namespace, motion: Motion, own: Capture | None) -> Capture:
    """The motion as a capture, seen by the cameras of the run's own one."""
    views = {} if own is None else own.views
    return replace(sequence_capture(options.motion, motion.sequence, options.flame, views), fps=motion.fps)
