"""Show what a capture holds, and which effects training on it would use; or what an avatar holds."""

import json
from argparse import ArgumentParser, Namespace
from pathlib import Path

from ..avatar.file import read_avatar
from ..errors import StgaError
from ..format import format_table
from ..requests.open_head import OpenHead
from ..requests.results import Analyzed
from ..requests.values import Analyze
from ..schema import to_json
from ..training.effect_decisions import parse_choices
from ..training.run.folder import RUN
from .arguments import add_capture, add_device, add_effects
from .carry_out import carry_out
from .inputs import open_named_capture, principal_point_of

NAME, HELP = "info", "show what a capture, a run or an avatar file holds, and which effects training would use"

UNKNOWN_LIGHT = "light: unknown; `stga relight RUN` estimates it"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_capture(parser, head)
    add_effects(parser)
    add_device(parser)
    parser.add_argument("--json", action="store_true", help="print the effects alone, as JSON")
    parser.add_argument("--presets", action="store_true", help="with --json: also the presets and their times")


def run(options: Namespace) -> None:
    from ..capture.model import summarize_capture
    from ..training.effects.plan import describe_effects

    if (options.capture / RUN).exists() or options.capture.suffix == ".npz":
        _describe_avatar(options.capture)
        return
    if options.presets and not options.json:
        raise StgaError("--presets: has no effect without --json; `stga presets` prints them")
    capture = None if options.json else open_named_capture(options)
    point, effects = principal_point_of(options), parse_choices(options.effect)
    request = Analyze(options.capture, options.flame, point, effects, options.device, options.presets)
    found = carry_out(request, with_bar=False)
    assert isinstance(found, Analyzed)
    if capture is None:
        print(json.dumps(to_json(found)))
        return
    print(*format_table(summarize_capture(capture)), sep="\n")
    if found.plan:
        print()
        print(*format_table(describe_effects(found.plan)), sep="\n")


def _describe_avatar(path: Path) -> None:
    """Print what a run's avatar, or an avatar file, holds."""
    from ..perform.inputs import avatar_path
    from ..perform.relighting import describe_light

    avatar = read_avatar(avatar_path(path))
    rows = [("splats", f"{len(avatar.splats)}, {len(avatar.faces)} triangles")]
    lines = (UNKNOWN_LIGHT,) if avatar.light is None else describe_light(avatar.light)
    print(
        *format_table([*rows, *((name, text.strip()) for name, _, text in (line.partition(":") for line in lines))]),
        sep="\n",
    )
