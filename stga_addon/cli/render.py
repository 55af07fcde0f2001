"""Render an avatar: one PNG per camera entry, a video of its motion, or a turntable."""

from argparse import ArgumentParser, Namespace

from ..capture.camera import TURNTABLE_S
from ..errors import StgaError
from ..export.playback import DEFAULT_FPS
from ..export.ply import is_ply
from ..requests.open_head import OpenHead
from ..requests.values import Render
from .arguments import (
    add_avatar,
    add_device,
    add_principal_point,
    color,
    degrees,
    frame_span,
    real_number,
    usable_path,
    whole_number,
)
from .carry_out import carry_out
from .motion import MOTION_HELP, add_motion_options, check_motion_options, motion_options

NAME, HELP = "render", "render an avatar as pictures, video or turntable"
COVERED = 0.0
"""Degrees of a turntable that covers what the cameras saw."""
SAME_FIELDS = (
    "cameras", "turntable", "camera", "fps", "frames", "capture", "flame", "motion", "background", "principal_point",
    "device", "light", "world",
)  # fmt: skip
"""Options that are fields of the request."""


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_avatar(parser, "source", "RUN|AVATAR|PLY", head)
    output = parser.add_mutually_exclusive_group(required=True)
    output.add_argument("--out", type=usable_path, metavar="DIR", help="folder for PNGs")
    output.add_argument("--video", type=usable_path, metavar="FILE.mp4", help="every timestep from one camera, as MP4")
    parser.add_argument(
        "--cameras",
        type=usable_path,
        metavar="TRANSFORMS.json",
        help="one PNG per entry; for a video, where its camera is from (default: the capture)",
    )
    parser.add_argument(
        "--turntable", type=degrees, nargs="?", const=COVERED, metavar="DEGREES",
        help="move one camera around the head: 360 for a full turn, less to both sides (default: what cameras saw)",
    )  # fmt: skip
    parser.add_argument(
        "--camera", type=whole_number(0), metavar="INDEX", help="camera of the video (default: the central one)"
    )
    parser.add_argument(
        "--fps", type=real_number, help=f"frames per second of the video (default: the capture's, else {DEFAULT_FPS:g})"
    )
    parser.add_argument(
        "--seconds", type=real_number, metavar="S",
        help=f"least duration of a turntable (default {TURNTABLE_S:g}); shorter motion is repeated to and fro",
    )  # fmt: skip
    parser.add_argument(
        "--frames", type=frame_span, metavar="FIRST:LAST", help="timesteps to render (default: all), not of a turntable"
    )
    parser.add_argument("--capture", type=usable_path, help="whose meshes drive the avatar (default: the run's)")
    parser.add_argument("--flame", type=usable_path, help="FLAME model file of that capture, or of the motion")
    parser.add_argument(
        "--motion",
        type=usable_path,
        metavar="FILE",
        help=f"{MOTION_HELP}; at every timestep of it from each camera",
    )
    add_motion_options(parser)
    parser.add_argument(
        "--light", type=usable_path, metavar="FILE", help="environment (.hdr) or lights (.toml) that light the avatar"
    )
    parser.add_argument(
        "--light-turn", type=real_number, metavar="DEGREES", help="turn that light around the head during the video"
    )
    parser.add_argument(
        "--world", action="store_true", help="put the run's world behind the avatar (train with --effect world=on)"
    )
    add_device(parser)
    parser.add_argument("--background", type=color, default="white", help="white (default), black or R,G,B in 0…1")
    add_principal_point(parser, "what cy means in the file of --cameras (default: as in training; of a PLY vhap)")


def run(options: Namespace) -> None:
    head, played = options.head, None
    output, is_video = options.out or options.video, options.video is not None
    if options.camera is not None and not is_video and options.turntable is None:
        raise StgaError("--camera: has no effect without --video or --turntable")
    if options.principal_point is not None and options.cameras is None:
        raise StgaError("--principal-point: has no effect without --cameras")
    if options.motion is None:
        check_motion_options(options)
    if head is not None and options.motion is None and not is_ply(options.source):
        played = head.played()
    seconds = TURNTABLE_S if options.seconds is None else options.seconds
    same = {name: getattr(options, name) for name in SAME_FIELDS}
    request = Render(
        options.source, output, is_video, seconds=seconds, played=played, motion_options=motion_options(options),
        light_turn=options.light_turn or 0.0, **same,
    )  # fmt: skip
    carry_out(request)
