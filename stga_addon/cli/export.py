"""Export an avatar for other viewers and tools: one frame, a range of frames, or splats with their FLAME motion."""

from argparse import ArgumentParser, Namespace

from ..errors import StgaError
from ..export.formats import FORMATS
from ..export.playback import DEFAULT_FPS
from ..requests.open_head import OpenHead
from ..requests.values import Export
from .arguments import add_avatar, frame_rate, frame_span, usable_path, whole_number
from .carry_out import carry_out
from .motion import MOTION_HELP, add_motion_options, check_motion_options, motion_options

NAME, HELP = "export", "write an avatar in another format"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_avatar(parser, "avatar", "RUN|AVATAR", head)
    parser.add_argument("--format", choices=tuple(FORMATS), required=True)
    parser.add_argument("--capture", type=usable_path, help="whose frames to bake (default: the run's)")
    parser.add_argument("--flame", type=usable_path, help="FLAME model file of that capture")
    parser.add_argument("--motion", type=usable_path, metavar="FILE", help=MOTION_HELP)
    add_motion_options(parser)
    parser.add_argument(
        "--timestep", type=whole_number(0), help="of a format that holds one frame (default: the neutral mesh)"
    )
    parser.add_argument(
        "--frames", type=frame_span, metavar="FIRST:LAST", help="of a format that holds several (default: all)"
    )
    rate = f"the capture's, else {DEFAULT_FPS:g}" if head is None else f"{head.fps:g}"
    parser.add_argument("--fps", type=frame_rate, help=f"frames per second of usd and web (default: {rate})")
    parser.add_argument(
        "--motion-only",
        action="store_true",
        help="web: leave out the blend shapes and skeleton of the FLAME file; the meshes of the take stay in the page",
    )
    parser.add_argument(
        "--albedo", action="store_true", help="leave out the capture's light: colors are the albedo (docs/light.md)"
    )
    parser.add_argument("--out", type=usable_path, required=True)


def run(options: Namespace) -> None:
    _check_options(options)
    head, fps, played = options.head, options.fps, None
    if head is not None:
        fps = fps or head.fps
        is_posed = FORMATS[options.format].source != "frame" or options.timestep is not None
        played = head.played() if is_posed and options.motion is None else None
    request = Export(
        options.avatar, options.out, options.format, options.capture, options.flame, played, options.timestep,
        options.frames, fps, options.motion_only, options.motion, motion_options(options),
        options.albedo,
    )  # fmt: skip
    carry_out(request)


def _check_options(options: Namespace) -> None:
    """Refuse options that the format would ignore, so that its file would be another than was asked for."""
    belongs_to = {
        "timestep": [name for name, format in FORMATS.items() if format.source == "frame"],
        "frames": [name for name, format in FORMATS.items() if format.source == "range"],
        "motion_only": ["web"],
    }
    for option, formats in belongs_to.items():
        if getattr(options, option) not in (None, False) and options.format not in formats:
            flag = f"--{option.replace('_', '-')}"
            raise StgaError(f"{flag} cannot be combined with --format {options.format}, only with {', '.join(formats)}")
    if options.motion is None:
        check_motion_options(options)
    elif FORMATS[options.format].source == "frame" and options.timestep is None:
        raise StgaError(f"--motion: has no effect with --format {options.format} without --timestep")
