"""Entry point of the command line: `python -m stga_addon …` and `blender --background … --command stga …`."""

import argparse
import gc
import os
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import NoReturn

from .. import __version__
from ..errors import StgaError, one_line
from ..requests.open_head import FOLDER, OpenHead, read_head
from .streams import safe_streams

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Before NumPy is imported: BLAS divides even matrices of nine rows among threads, and takes longer for it.
COMMANDS = (
    ".avatar",
    ".track",
    ".train",
    ".refine",
    ".extend",
    ".relight",
    ".perform",
    ".batch",
    ".render",
    ".eval",
    ".select",
    ".export",
    ".drive",
    ".info",
    ".presets",
    "..development.benchmark.command",
    "..development.demo.command",
)
"""A module per command: NAME, HELP, add_arguments(parser, head) and run(options)."""


class _Parser(argparse.ArgumentParser):
    """Its messages quote the command line, which may be long or hold control characters."""

    def error(self, message: str) -> NoReturn:
        super().error(one_line(message))


def main(arguments: list[str] | None = None, head: OpenHead | None = None) -> int:
    """Run one command; returns the exit code: 0, 2 after a mistake that one sentence on stderr explains, 130 after
    Ctrl-C.

    `head`: that of the file that Blender has open; by default the one in the folder that STGA_HEAD names.
    """
    with safe_streams() as stdout:
        code = _run(arguments, head)
        sys.stdout.flush()
        if stdout is not None and stdout.error is not None and not isinstance(stdout.error, BrokenPipeError):
            return _fail(f"standard output cannot be written ({stdout.error.strerror})")
        return code


def _run(arguments: list[str] | None, head: OpenHead | None) -> int:
    command = ""
    try:
        folder = os.environ.get(FOLDER)
        if head is None and folder:
            head = read_head(Path(folder))
        options = _with_head(make_parser(head).parse_args(arguments), head)
        command = options.command
        options.run(options)
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
        _forget(error)
        _fail("interrupted")
        return 130
    return 0


def _forget(error: BaseException) -> None:
    """Drop what an interruption left unfinished, without what destructors of objects that were half made say."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    error.__traceback__ = error.__context__ = None
    gc.collect()  # frames that refer to themselves
    sys.unraisablehook = hook


def _fail(message: str) -> int:
    print(f"stga: {one_line(message)}", file=sys.stderr)
    return 2


def make_parser(head: OpenHead | None = None) -> argparse.ArgumentParser:
    """The parser of all commands; what the head of the open file provides may be left out."""
    top = _Parser(prog="stga", description="Selective-training Gaussian head avatars.")
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
