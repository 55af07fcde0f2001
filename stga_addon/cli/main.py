"""Entry point of the command line: `python -m stga_addon …` and `blender --background … --command stga …`."""

import argparse
import sys
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

from .. import __version__
from ..errors import StgaError
from ..jobs.delegate import OpenHead

COMMANDS = (
    ".train",
    ".job",
    ".render",
    ".eval",
    ".select",
    ".export",
    ".info",
    ".presets",
    "..development.benchmark.command",
    "..development.demo.command",
)
"""A module per command: NAME, HELP, add_arguments(parser, head) and run(options)."""


def main(arguments: list[str] | None = None, head: OpenHead | None = None) -> int:
    """Run one command; returns the exit code: 0, 2 after a mistake that one sentence on stderr explains, 130 after
    Ctrl-C."""
    options = _with_head(make_parser(head).parse_args(arguments), head)
    try:
        options.run(options)
    except StgaError as error:
        print(f"stga: {error}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        if (error.name or "").startswith(__package__.rpartition(".")[0]):
            raise
        missing = f"'{options.command}' needs the package '{error.name}', which {sys.executable} lacks"
        print(f"stga: {missing}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stga: interrupted", file=sys.stderr)
        return 130
    return 0


def make_parser(head: OpenHead | None = None) -> argparse.ArgumentParser:
    """The parser of all commands; what the head of the open file provides may be left out."""
    top = argparse.ArgumentParser(prog="stga", description="Selective-training Gaussian head avatars.")
    top.add_argument("--version", action="version", version=__version__)
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for module in command_modules():
        command = commands.add_parser(module.NAME, help=module.HELP, description=module.__doc__)
        module.add_arguments(command, head)
        command.set_defaults(run=module.run)
    return top


def command_modules() -> list[ModuleType]:
    """The commands of this installation; the extension's zip leaves those of `development` out."""
    development = find_spec("..development", __package__) is not None
    return [import_module(name, __package__) for name in COMMANDS if development or not name.startswith("..")]


def _with_head(options: argparse.Namespace, head: OpenHead | None) -> argparse.Namespace:
    """`options.head`: the open file's head where no capture is named; its capture and model are then used."""
    options.head = head if head is not None and getattr(options, "capture", "none such") is None else None
    if options.head is not None:
        options.capture = options.head.capture
        options.flame = options.flame or options.head.flame
        if "principal_point" in options:
            options.principal_point = options.principal_point or options.head.principal_point
    return options
