"""The command line: one parser for `python -m stga_addon …` and `blender --background … --command stga …`."""

import argparse
import re
import sys
from pathlib import Path

from . import __version__
from .errors import StgaError
from .training.settings import SCHEDULES, STRATEGIES


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit code: 0, or 2 for a mistake that one sentence on stderr explains."""
    options = parser().parse_args(arguments)
    from . import commands

    try:
        getattr(commands, options.command)(options)
    except StgaError as error:
        print(f"stga: {error}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        if (error.name or "").startswith(__package__):
            raise
        python = sys.executable
        print(f"stga: '{options.command}' needs the package '{error.name}', which {python} lacks", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stga: interrupted", file=sys.stderr)
        return 130
    return 0


def parser() -> argparse.ArgumentParser:
    """All commands and their options."""
    top = argparse.ArgumentParser(prog="stga", description="Selective-training Gaussian head avatars.")
    top.add_argument("--version", action="version", version=__version__)
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    train = commands.add_parser("train", help="train an avatar from a capture")
    _add_capture(train)
    train.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder of the run")
    budget = train.add_mutually_exclusive_group()
    budget.add_argument("--budget", type=duration, metavar="TIME", help="training time such as 90s, 10m (default 2m)")
    budget.add_argument("--iterations", type=int, help="number of iterations instead")
    train.add_argument(
        "--strategy",
        choices=STRATEGIES,
        help="default: global, which measured best (docs/results.md); selective with --schedule paper",
    )
    train.add_argument("--schedule", choices=SCHEDULES, help="paper: by its letter")
    train.add_argument("--threshold", type=float, help="selection threshold in metres")
    train.add_argument("--resume", action="store_true", help="continue the run in the folder")
    train.add_argument("--device", choices=("auto", "cpu"), default="auto", help="auto takes the CPU in this version")
    train.add_argument("--seed", type=int, help="fixes every random choice (default 0)")

    render = commands.add_parser("render", help="draw an avatar, one PNG per camera entry")
    render.add_argument("source", type=Path, metavar="RUN|AVATAR|PLY")
    render.add_argument("--cameras", type=Path, required=True, metavar="TRANSFORMS.json")
    render.add_argument("--capture", type=Path, help="whose meshes drive the avatar (default: the run's)")
    render.add_argument("--flame", type=Path, help="FLAME model file of that capture")
    render.add_argument("--out", type=Path, required=True, metavar="DIR")
    render.add_argument("--background", type=colour, default="white", help="white, black or R,G,B in 0…1")
    _add_principal_point(render)

    evaluate = commands.add_parser("eval", help="PSNR, SSIM and LPIPS on held-out views")
    evaluate.add_argument("run", type=Path, metavar="RUN")
    evaluate.add_argument("--split", choices=("train", "val", "test"), default="val")

    select = commands.add_parser("select", help="show which triangles each frame would train")
    _add_capture(select)
    select.add_argument("--threshold", type=float, help="metres")
    select.add_argument("--zero-pose", choices=("head", "all"), default="head")
    select.add_argument("--out", type=Path, metavar="NPZ", help="also write timestep -> triangles")

    export = commands.add_parser("export", help="write an avatar in another format")
    export.add_argument("avatar", type=Path, metavar="RUN|AVATAR")
    export.add_argument("--format", choices=("gaussian-avatars", "ply", "ply-sequence"), required=True)
    export.add_argument("--capture", type=Path, help="whose frames to bake (default: the run's)")
    export.add_argument("--flame", type=Path, help="FLAME model file of that capture")
    export.add_argument("--timestep", type=int, help="frame of a single PLY (default: the neutral mesh)")
    export.add_argument("--out", type=Path, required=True)

    info = commands.add_parser("info", help="what a capture holds")
    _add_capture(info)

    demo = commands.add_parser("demo", help="make a synthetic capture and take it through the whole chain")
    demo.add_argument("--out", type=Path, default=Path("out/demo"))
    demo.add_argument("--budget", type=duration, default=40.0, metavar="TIME")
    return top


def _add_capture(command: argparse.ArgumentParser) -> None:
    command.add_argument("capture", type=Path, metavar="CAPTURE", help="folder of the capture")
    command.add_argument("--flame", type=Path, metavar="FILE", help="FLAME model file (.pkl or .npz)")
    _add_principal_point(command)


def _add_principal_point(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--principal-point", choices=("vhap", "opencv", "centre"), help="what cy means in the capture (default vhap)"
    )


def duration(text: str) -> float:
    """Seconds in "90", "90s", "10m", "1h30m". Raises argparse.ArgumentTypeError for anything else."""
    match = re.fullmatch(r"(?:(\d+(?:\.\d+)?)h)?(?:(\d+(?:\.\d+)?)m)?(?:(\d+(?:\.\d+)?)s?)?", text.strip())
    if not match or not any(match.groups()):
        raise argparse.ArgumentTypeError(f"'{text}' is not a time such as 90s, 10m or 1h30m")
    hours, minutes, seconds = (float(part or 0) for part in match.groups())
    return 3600 * hours + 60 * minutes + seconds


def colour(text: str) -> tuple[float, float, float]:
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
