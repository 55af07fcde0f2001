"""Show what a capture holds, and which effects training on it would use."""

import json
from argparse import ArgumentParser, Namespace

from ..errors import StgaError
from ..requests.open_head import OpenHead
from ..requests.results import Analyzed
from ..requests.values import Analyze
from ..schema import to_json
from ..training.effects.decisions import parse_choices
from .arguments import add_capture, add_device, add_effects
from .carry_out import carry_out
from .inputs import open_named_capture, principal_point_of
from .table import print_table

NAME, HELP = "info", "show what a capture holds, and which effects training on it would use"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_capture(parser, head)
    add_effects(parser)
    add_device(parser)
    parser.add_argument("--json", action="store_true", help="print the effects alone, as JSON")
    parser.add_argument("--presets", action="store_true", help="with --json: also the presets and their times")


def run(options: Namespace) -> None:
    from ..capture.summary import summarize_capture
    from ..training.effects.plan import describe_effects

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
    print_table(summarize_capture(capture))
    if found.plan:
        print()
        print_table(describe_effects(found.plan))
