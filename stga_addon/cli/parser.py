"""The command line: one parser for `python -m stga_addon …` and `blender --background … --command stga …`."""

import argparse
import re
import sys
from pathlib import Path
from typing import Any

from .. import __version__
from ..errors import StgaError
from ..jobs.delegate import OpenHead
from ..training.settings import DEVICES, PRESETS, SCHEDULES, STRATEGIES


def main(arguments: list[str] | None = None, head: OpenHead | None = None) -> int:
    """Run one command; returns the exit code: 0, or 2 for a mistake that one sentence on stderr explains."""
    options = _with_head(parser(head).parse_args(arguments), head)
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


def _with_head(options: argparse.Namespace, head: OpenHead | None) -> argparse.Namespace:
    """`options.head`: the open file's head where no capture is named, whose capture and model then stand in."""
    options.head = head if head is not None and getattr(options, "capture", "none such") is None else None
    if options.head is not None:
        options.capture = options.head.capture
        options.flame = options.flame or options.head.flame
        if "principal_point" in options:
            options.principal_point = options.principal_point or options.head.principal_point
    return options


def parser(head: OpenHead | None = None) -> argparse.ArgumentParser:
    """All commands and their options; what the open file's head can stand in for need not be given."""
    top = argparse.ArgumentParser(prog="stga", description="Selective-training Gaussian head avatars.")
    top.add_argument("--version", action="version", version=__version__)
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    train = commands.add_parser("train", help="train an avatar from a capture")
    _add_capture(train, head)
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
    train.add_argument("--preset", choices=tuple(PRESETS), help="how good, and so how long; `stga plan` says how long")
    train.add_argument("--target-psnr", type=float, metavar="DB", help="stop when the held-out views reach it")
    train.add_argument(
        "--stop-when-flat", action="store_true", default=None, help="stop when more time no longer helps"
    )
    train.add_argument("--threshold", type=float, help="selection threshold in metres")
    _add_effects(train)
    train.add_argument("--resume", action="store_true", help="continue the run in the folder")
    _add_device(train)
    train.add_argument("--seed", type=int, help="fixes every random choice (default 0)")

    job = commands.add_parser("job", help="train what Blender's panel wrote down in a run's folder")
    job.add_argument("run", type=Path, metavar="RUN")

    render = commands.add_parser("render", help="draw an avatar, one PNG per camera entry")
    render.add_argument("source", type=Path, metavar="RUN|AVATAR|PLY", **_avatar_of(head))
    render.add_argument("--cameras", type=Path, required=True, metavar="TRANSFORMS.json")
    render.add_argument("--capture", type=Path, help="whose meshes drive the avatar (default: the run's)")
    render.add_argument("--flame", type=Path, help="FLAME model file of that capture, or of the motion")
    render.add_argument(
        "--motion",
        type=Path,
        metavar="FILE",
        help="another person's FLAME motion (.npz, or a capture), at every timestep of it from each camera",
    )
    render.add_argument("--out", type=Path, required=True, metavar="DIR")
    render.add_argument("--background", type=colour, default="white", help="white, black or R,G,B in 0…1")
    _add_principal_point(render)

    evaluate = commands.add_parser("eval", help="PSNR, SSIM and LPIPS on held-out views")
    evaluate.add_argument("run", type=Path, metavar="RUN")
    evaluate.add_argument("--split", choices=("train", "val", "test"), default="val")

    select = commands.add_parser("select", help="show which triangles each frame would train")
    _add_capture(select, head)
    select.add_argument("--threshold", type=float, help="metres")
    select.add_argument("--zero-pose", choices=("head", "all"), default="head")
    select.add_argument("--out", type=Path, metavar="NPZ", help="also write timestep -> triangles")

    export = commands.add_parser("export", help="write an avatar in another format")
    export.add_argument("avatar", type=Path, metavar="RUN|AVATAR", **_avatar_of(head))
    export.add_argument("--format", choices=("gaussian-avatars", "ply", "ply-sequence"), required=True)
    export.add_argument("--capture", type=Path, help="whose frames to bake (default: the run's)")
    export.add_argument("--flame", type=Path, help="FLAME model file of that capture")
    export.add_argument("--timestep", type=int, help="frame of a single PLY (default: the neutral mesh)")
    export.add_argument("--out", type=Path, required=True)

    info = commands.add_parser("info", help="what a capture holds, and which effects it calls for")
    _add_capture(info, head)
    _add_effects(info)
    _add_device(info)
    info.add_argument("--json", action="store_true", help="the effects alone, for programs")
    info.add_argument("--presets", action="store_true", help="with --json: also the presets and their time, as `plan`")

    plan = commands.add_parser("plan", help="the presets, and how long each would train on this machine")
    _add_capture(plan, head)
    _add_device(plan)

    benchmark = commands.add_parser("benchmark", help="what accuracy costs in time on the CPU: strategies and presets")
    _add_capture(benchmark, head)
    benchmark.add_argument("--budget", type=duration, default=180.0, metavar="TIME", help="of each run (default 3m)")
    benchmark.add_argument("--seeds", type=int, default=3, help="runs of each variant (default 3)")
    benchmark.add_argument("--knobs", action="store_true", help="compare single settings instead")
    benchmark.add_argument("--only", nargs="+", metavar="VARIANT", help="some of the variants")
    benchmark.add_argument(
        "--out", type=Path, default=Path("out/benchmark"), metavar="DIR", help="keeps the runs, to be continued"
    )

    demo = commands.add_parser("demo", help="make a synthetic capture and take it through the whole chain")
    demo.add_argument("--out", type=Path, default=Path("out/demo"))
    demo.add_argument("--budget", type=duration, default=40.0, metavar="TIME")
    return top


def _avatar_of(head: OpenHead | None) -> dict[str, Any]:
    return {} if head is None or head.avatar is None else {"nargs": "?", "default": head.avatar}


def _add_capture(command: argparse.ArgumentParser, head: OpenHead | None) -> None:
    optional: dict[str, Any] = {} if head is None else {"nargs": "?"}
    command.add_argument("capture", type=Path, metavar="CAPTURE", help="folder of the capture", **optional)
    command.add_argument("--flame", type=Path, metavar="FILE", help="FLAME model file (.pkl or .npz)")
    _add_principal_point(command)


def _add_effects(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--effect",
        action="append",
        default=[],
        metavar="NAME=on|off",
        help="decide an effect instead of the capture (docs/effects.md); may be repeated",
    )


def _add_device(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--device",
        choices=DEVICES,
        default="auto",
        help="cuda: an NVIDIA GPU; auto: that where it works, else the CPU; warp-cpu: the GPU's code on the CPU",
    )


def _add_principal_point(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--principal-point", choices=("vhap", "opencv", "center"), help="what cy means in the capture (default vhap)"
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
