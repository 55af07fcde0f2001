"""The exception whose message is shown to the user."""

import reprlib

MAX_MESSAGE_CHARACTERS = 2000
MAX_VALUE_CHARACTERS = 80

_repr = reprlib.Repr()
_repr.maxlevel, _repr.maxstring, _repr.maxother = 2, MAX_VALUE_CHARACTERS, MAX_VALUE_CHARACTERS


class StgaError(Exception):
    """A failure with a cause outside the code: bad file, bad option, full disk.

    The message is one sentence that names the file, the field and what was expected. The command line
    prints it and exits with 2; Blender's operators report it; neither shows a traceback.
    """

    def __init__(self, message: str) -> None:
        # A path may hold lone surrogates, which no output stream can encode.
        super().__init__(_cut(message.encode("utf-8", "backslashreplace").decode("utf-8"), MAX_MESSAGE_CHARACTERS))


def shorten(value: object) -> str:
    """The value as a message quotes it: its repr, with the middle of a long one left out."""
    return _cut(_repr.repr(value), MAX_VALUE_CHARACTERS)


def _cut(text: str, limit: int) -> str:
    half = (limit - 1) // 2
    return text if len(text) <= limit else f"{text[:half]}…{text[-half:]}"
