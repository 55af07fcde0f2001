"""Track a head through footage of one or more cameras, and write a capture."""

import os
import re
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from pathlib import Path

from ..requests.open_head import OpenHead
from ..requests.values import MATTES, SYNC, WORLDS, Track
from .arguments import real_number, usable_path, whole_number
from .carry_out import carry_out

NAME, HELP = "track", "track a head through footage, and write a capture"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_footage(parser)
    parser.add_argument("--out", type=usable_path, required=True, metavar="CAPTURE", help="folder of the capture")


def add_footage(parser: ArgumentParser) -> None:
    """FOOTAGE, --model, and how both are read."""
    parser.add_argument("footage", type=usable_path, metavar="FOOTAGE", help="folder of images or videos, or a video")
    parser.add_argument(
        "--model",
        type=usable_path,
        metavar="HEAD",
        help="FLAME (.pkl, .npz), linear model (.npz) or morph targets (.glb) in place of the bundled head",
    )
    parser.add_argument("--cameras", type=usable_path, metavar="FILE", help="calibration that is not in FOOTAGE")
    parser.add_argument("--landmarks", type=usable_path, metavar="FOLDER", help="landmark files of another detector")
    parser.add_argument("--focal", type=real_number, metavar="PIXELS", help="focal length of a single camera")
    parser.add_argument("--start", type=whole_number(0), default=0, help="first timestep")
    parser.add_argument("--stop", type=whole_number(1), help="timestep to stop before")
    parser.add_argument("--step", type=whole_number(1), default=1, help="use every nth timestep")
    parser.add_argument(
        "--offset",
        type=_offset,
        action="append",
        default=[],
        metavar="CAMERA=FRAMES",
        help="frames by which a camera's recording is later; may be repeated",
    )
    parser.add_argument(
        "--sync",
        choices=SYNC,
        default="none",
        help="find offsets that are not given by the videos' sound, or by what moves; auto: sound where all have it",
    )
    parser.add_argument(
        "--world",
        choices=WORLDS,
        default="auto",
        help="the capture's: in meters with the head near the origin, or the cameras' own (default: the cameras' where "
        "they were exported from a Blender scene)",
    )
    parser.add_argument(
        "--mattes",
        type=_mattes,
        default="auto",
        metavar="auto|none|FOLDER",
        help="masks of the person: made where the footage has none (default), only the footage's, or a folder's",
    )
    parser.add_argument("--meshes", action="store_true", help="write an OBJ per timestep as well")


def run(options: Namespace) -> None:
    carry_out(tracking_request(options, options.out))


def tracking_request(options: Namespace, out: Path) -> Track:
    """What `add_footage`'s options ask for, into the folder `out`."""
    return Track(
        options.footage, options.model, out, options.cameras, options.landmarks, options.focal,
        options.start, options.stop, options.step, dict(options.offset) or None, options.meshes,
        options.world, options.sync, options.mattes,
    )  # fmt: skip


def _mattes(text: str) -> str:
    return text if text in MATTES else os.path.abspath(usable_path(text))


def _offset(text: str) -> tuple[str, int]:
    name, separator, frames = text.rpartition("=")
    if not separator or not re.fullmatch(r"-?\d{1,9}", frames):
        raise ArgumentTypeError(f"expected a camera and a number of frames, as in left=-3, not {text!r}")
    return name, int(frames)
