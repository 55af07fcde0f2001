"""Show what a capture holds, and which effects training on it would use."""

import json
from argparse import ArgumentParser, Namespace
from typing import Any

from ..errors import StgaError
from ..requests.open_head import OpenHead
from ..training.effects.decisions import effect_plan_to_json, parse_choices
from ..training.settings import make_settings
from .arguments import add_capture, add_device, add_effects
from .inputs import open_named_capture
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
    from ..render.device import choose_device
    from ..training.effects.plan import describe_effects, plan_effects

    if options.presets and not options.json:
        raise StgaError("--presets: has no effect without --json; `stga presets` prints them")
    capture = open_named_capture(options)
    plan: tuple[Any, ...] = ()
    if capture.views.get("train"):
        device, _ = choose_device(options.device)
        _, plan = plan_effects(capture, make_settings(iterations=1, effects=parse_choices(options.effect)), device)
    if options.json:
        found: dict[str, Any] = {"plan": effect_plan_to_json(plan)}
        if options.presets and plan:
            from ..report.preset_timing import time_presets

            found["presets"] = [preset.as_json() for preset in time_presets(capture, device=device)]
        print(json.dumps(found))
        return
    print_table(summarize_capture(capture))
    if plan:
        print()
        print_table(describe_effects(plan))
