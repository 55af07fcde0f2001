"""The command line: `python -m stga_addon …` and `blender --background … --command stga …`.

Its standard streams never raise: closed, full, broken pipes, ASCII-only encodings.
"""

import _thread
import argparse
import gc
import io
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from .. import __version__
from ..errors import StgaError, one_line, shorten, telling_refusals
from ..jobs.avatar_source import FOLDER, OpenHead, read_head
from ..worker.machine import address_space_gb
from .commands import COMMANDS

MIN_ADDRESS_SPACE_GB = 4.0
"""Below, a small training was seen to abort at 0.8; threads and libraries reserve what they never
use."""
MIN_LIBRARIES_GB = 1.2
"""Below, libraries that train and draw were seen to crash or to wait for ever, at 0.45 to 1.0."""
NUMPY_COMMANDS = ("drive",)
"""Commands that were seen to work within less."""
LIBRARY_FAILURES = (
    MemoryError,
    ImportError,
    OSError,
    RuntimeError,
    SystemError,
    AttributeError,
    NameError,
)
"""Exceptions that libraries raise when they get no memory, while they load or later; a library of
which a part was not loaded raises the last two."""
DROPPED_INTERRUPT_S = 0.05  # Time after which a dropped interrupt is raised again


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
        _check_address_space(command)
        with telling_refusals(), _passing_on_interrupts():
            COMMANDS[command].carry_out(options, head)
    except StgaError as error:
        return _fail(str(error))
    except ModuleNotFoundError as error:
        if (error.name or "").startswith(__package__.rpartition(".")[0]):
            raise
        return _fail(f"'{command}' needs the package '{error.name}', which {sys.executable} lacks")
    except RecursionError:
        return _fail(f"'{command}': its input is nested too deeply")
    except LIBRARY_FAILURES as error:
        return _fail(_memory_refusal(command, error))
    except KeyboardInterrupt as error:
        # without what destructors of objects that were half made say
        hook = sys.unraisablehook
        sys.unraisablehook = lambda _: None
        error.__traceback__ = error.__context__ = None
        gc.collect()  # frames that refer to themselves
        sys.unraisablehook = hook
        _fail("interrupted")
        return 130
    return 0


def _memory_refusal(command: str, error: Exception) -> str:
    """A sentence for one of LIBRARY_FAILURES. Raises the error where it is of another cause."""
    if isinstance(error, MemoryError):
        return f"'{command}' needs more memory than there is"
    given = address_space_gb()
    if given >= MIN_ADDRESS_SPACE_GB:
        raise error
    expected = f"expected {MIN_ADDRESS_SPACE_GB:g} GB or no limit"
    cause = shorten(" ".join(str(error).split()) or type(error).__name__)
    limit = f"the {given:.1f} GB of addresses that this process may have (ulimit -v)"
    return f"'{command}' failed within {limit}; {expected}: {cause}"


def _check_address_space(command: str) -> None:
    """Warn of a tight limit: LLVM and other C++ code ends a process that gets no memory, and says
    std::bad_alloc. Raises StgaError for one in which it may not even end."""
    given = address_space_gb()
    if given >= MIN_ADDRESS_SPACE_GB:
        return
    limit = f"this process may have {given:.1f} GB of addresses (ulimit -v)"
    expected = f"expected {MIN_ADDRESS_SPACE_GB:g} GB or no limit"
    if given < MIN_LIBRARIES_GB and command not in NUMPY_COMMANDS:
        raise StgaError(f"'{command}' is not started, because {limit}; {expected}")
    print(f"stga: warning: {limit}; {expected}: a library may abort it", file=sys.stderr)


@contextmanager
def _passing_on_interrupts() -> Iterator[None]:
    """Interrupt again where C code drops a KeyboardInterrupt of what it calls, as LLVM does while
    it loads kernels."""
    hook = sys.unraisablehook

    def interrupt_soon() -> None:
        time.sleep(DROPPED_INTERRUPT_S)
        _thread.interrupt_main()

    def interrupt_again(details: Any) -> None:
        if details.exc_type is not KeyboardInterrupt:
            hook(details)
            return
        # later, in another thread: what is raised in here is dropped as well
        _thread.start_new_thread(interrupt_soon, ())

    sys.unraisablehook = interrupt_again
    try:
        yield
    finally:
        sys.unraisablehook = hook


def _fail(message: str) -> int:
    print(f"stga: {one_line(message)}", file=sys.stderr)
    return 2


def make_parser(head: OpenHead | None = None) -> argparse.ArgumentParser:
    """The parser of all commands; what the head of the open file provides may be left out."""
    top = _Parser(prog="stga", description="Selective-training Gaussian head avatars.")
    top.add_argument("--version", action="version", version=__version__)
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, command in COMMANDS.items():
        about = " ".join(command.about.split()).replace("%", "%%")
        first = about.partition(". ")[0].rstrip(".")
        command.add_arguments(
            commands.add_parser(name, help=first[0].lower() + first[1:], description=about), head
        )
    return top


# Standard streams


class Output(io.FileIO):
    """A descriptor whose first write error is kept in `error` and what follows dropped, so that a
    training whose terminal or pipe goes away still finishes."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        try:
            if self.error is None:
                return super().write(data)
        except OSError as error:
            self.error = error
        return len(data)


@contextmanager
def safe_streams() -> Iterator[Output | None]:
    """Let stdout and stderr of the process be written without errors; yields the one behind stdout.

    Characters that the encoding lacks are written as escapes. Streams that were replaced already
    (by tests, by Blender's console) are left alone, and None is yielded. What the process was
    started with comes back at the end.
    """
    for descriptor in range(3):  # closed ones: no file of ours gets them, written by C code
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gives the lowest free one
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = _safe(sys.stdout, sys.__stdout__), _safe(sys.stderr, sys.__stderr__)
    replaced = sys.stdout is not before[0]
    try:
        yield sys.stdout.buffer.raw if replaced else None
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        sys.stdout, sys.stderr = before


def _safe(stream: Any, original: Any) -> Any:
    if stream is None:  # Python found the descriptor closed
        return io.TextIOWrapper(io.BufferedWriter(Output(os.devnull, "w")), encoding="utf-8")
    if stream is not original or not isinstance(stream, io.TextIOWrapper):
        return stream
    stream.flush()
    return io.TextIOWrapper(
        io.BufferedWriter(Output(stream.fileno(), "w", closefd=False)),
        encoding=stream.encoding,
        errors="backslashreplace",
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )
