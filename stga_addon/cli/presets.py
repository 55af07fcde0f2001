"""Show what each preset is for, and how long it would train on this machine."""

from argparse import ArgumentParser, Namespace

from ..requests.open_head import OpenHead
from .arguments import add_capture, add_device
from .inputs import open_named_capture

NAME, HELP = "presets", "show the presets, and how long each would train on this machine"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_capture(parser, head)
    add_device(parser)


def run(options: Namespace) -> None:
    from ..format import format_duration
    from ..render.device import choose_device
    from ..report.preset_timing import time_presets

    capture = open_named_capture(options)
    device, why = choose_device(options.device)
    print(why)
    for timing in time_presets(capture, device=device):
        time = f"about {format_duration(timing.seconds):<10}"
        print(f"{timing.preset:<9} {timing.iterations:6d} iterations  {time}  {timing.purpose}")
