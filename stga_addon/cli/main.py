"""The command line: `python -m stga_addon …` and `blender --background … --command stga …`."""

import argparse
import gc
import os
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn

from .. import __version__
from ..errors import StgaError, one_line
from ..jobs.avatar_source import FOLDER, OpenHead, read_head
from .commands import COMMANDS, Command
from .streams import safe_streams

DEVELOPMENT = {"benchmark": "..development.benchmark.command", "demo": "..development.demo.command"}
"""Commands of `development`, which the extension's zip leaves out: each COMMAND of a module."""


class _Parser(argparse.ArgumentParser):
    """Its messages quote the command line, which may be long or hold control characters."""

    def error(self, message: str) -> NoReturn:
        super().error(one_line(message))


def main(arguments: list[str] | None = None, head: OpenHead | None = None) -> int:
    """Run one command; returns the exit code: 0, 2 after a mistake that one sentence on stderr
    explains, 130 after Ctrl-C.

    `head`: that of the file that Blender has open; by default the one in the folder that STGA_HEAD
    names.
    """
    with safe_streams() as stdout:
        code = _run(arguments, head)
        sys.stdout.flush()
        error = None if stdout is None else stdout.error
        if error is None or isinstance(error, BrokenPipeError):
            return code
        return _fail(f"standard output cannot be written ({error.strerror})")


def _run(arguments: list[str] | None, head: OpenHead | None) -> int:
    command = ""
    try:
        folder = os.environ.get(FOLDER)
        if head is None and folder:
            head = read_head(Path(folder))
        options = make_parser(head).parse_args(arguments)
        command = options.command
        all_commands()[command].carry_out(options, head)
    except StgaError as error:
        return _fail(str(error))
    except ModuleNotFoundError as error:
        if (error.name or "").startswith(__package__.rpartition(".")[0]):
            raise
        return _fail(f"'{command}' needs the package '{error.name}', which {sys.executable} lacks")
    except MemoryError:
        return _fail(f"'{command}' needs more memory than there is")
    except RecursionError:
        return _fail(f"'{command}': its input is nested too deeply")
    except KeyboardInterrupt as error:
        # without what destructors of objects that were half made say
        hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
        error.__traceback__ = error.__context__ = None
        gc.collect()  # frames that refer to themselves
        sys.unraisablehook = hook
        _fail("interrupted")
        return 130
    return 0


def _fail(message: str) -> int:
    print(f"stga: {one_line(message)}", file=sys.stderr)
    return 2


def make_parser(head: OpenHead | None = None) -> argparse.ArgumentParser:
    """The parser of all commands; what the head of the open file provides may be left out."""
    top = _Parser(prog="stga", description="Selective-training Gaussian head avatars.")
    top.add_argument("--version", action="version", version=__version__)
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, command in all_commands().items():
        about = " ".join(command.about.split()).replace("%", "%%")
        first = about.partition(". ")[0].rstrip(".")
        command.add_arguments(
            commands.add_parser(name, help=first[0].lower() + first[1:], description=about), head
        )
    return top


def all_commands() -> dict[str, Command]:
    """The commands of this installation."""
    found = DEVELOPMENT if find_spec("..development", __package__) is not None else {}
    own = {name: import_module(module, __package__).COMMAND for name, module in found.items()}
    return {**COMMANDS, **own}
