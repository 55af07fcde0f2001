"""The exception whose message is shown to the user."""

import os
import re
import reprlib
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

MAX_MESSAGE_CHARACTERS = 1000
MAX_VALUE_CHARACTERS = 80

_repr = reprlib.Repr()
_repr.maxlevel = 2
_repr.maxstring = MAX_VALUE_CHARACTERS
_repr.maxother = MAX_VALUE_CHARACTERS
_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")


class StgaError(Exception):
    """A failure with a cause outside the code. Its sentence names file, field and what was
    expected; the command line prints it and exits with 2, Blender reports it."""

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


class DeviceError(StgaError):
    """A GPU that failed in use, lost or out of memory; `cause`: the sentence without --device and
    advice."""

    def __init__(self, cause: str, advice: str) -> None:
        super().__init__(f"--device gpu: {cause}; {advice}")
        self.cause = one_line(cause)


@contextmanager
def telling_refusals() -> Iterator[None]:
    """Turn what the system refuses in the block, to whomever, into a StgaError that names the file:
    "cannot be accessed (Permission denied)"."""
    try:
        yield
    except OSError as error:
        if error.errno is None:  # a library's own
            raise
        name = error.filename if isinstance(error.filename, str | bytes) else ""
        path = os.fsdecode(name) or "a file or device"
        raise StgaError(f"{path}: cannot be accessed ({error.strerror})") from error
    except RuntimeError as error:  # pathlib's before Python 3.13, of a link to itself
        if not str(error).startswith("Symlink loop"):
            raise
        raise StgaError(f"{error}: cannot be accessed") from error


def exit_code(work: Callable[[], object]) -> int:
    """Exit code of a program that does this work: 0, or 2 after a StgaError, which goes to
    stderr."""
    try:
        with telling_refusals():
            work()
    except StgaError as error:
        print(f"stga: {error}", file=sys.stderr)
        return 2
    return 0


def one_line(message: str) -> str:
    """The message in bounded length, with control characters and lone surrogates escaped."""
    return printable(_cut(message, MAX_MESSAGE_CHARACTERS))


def printable(line: str) -> str:
    """The line with control characters and lone surrogates escaped, which a terminal would obey."""
    return _UNPRINTABLE.sub(lambda found: ascii(found[0])[1:-1], line)


def shorten(value: object) -> str:
    """The value as a message quotes it: its repr, with the middle of a long one left out."""
    try:
        return _cut(_repr.repr(value), MAX_VALUE_CHARACTERS)
    except ValueError:  # Python does not write whole numbers of more than 4,300 digits
        return "a number of too many digits"


def _cut(text: str, limit: int) -> str:
    half = (limit - 1) // 2
    return text if len(text) <= limit else f"{text[:half]}…{text[-half:]}"


def listed(names: Sequence[object], most: int = 5) -> str:
    """The first names, and how many more there are."""
    more = len(names) - most
    return ", ".join(map(str, names[:most])) + (f" and {more} more" if more > 0 else "")
