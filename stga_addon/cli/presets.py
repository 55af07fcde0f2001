"""Show what each preset is for, and how long it would train on this machine."""

from argparse import ArgumentParser, Namespace

from ..requests.open_head import OpenHead
from ..requests.values import TimePresets
from .arguments import add_capture, add_device
from .carry_out import carry_out
from .inputs import principal_point_of

NAME, HELP = "presets", "show the presets, and how long each would train on this machine"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_capture(parser, head)
    add_device(parser)


def run(options: Namespace) -> None:
    point = principal_point_of(options)
    carry_out(TimePresets(options.capture, options.flame, point, options.device), with_bar=False)
