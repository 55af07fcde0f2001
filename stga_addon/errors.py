"""The exception for the user's mistakes, whose message is shown without a traceback."""

import re

MAX_MESSAGE_CHARACTERS = 1000
_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")


class StgaError(Exception):
    """A mistake or a failure outside the code: bad file, bad option, full disk.

    The message is one sentence that names the file, the field and what was expected. The command line prints it and
    exits with 2; Blender's operators report it. It may quote files, so it is made printable and bounded.
    """

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


def one_line(text: str) -> str:
    """`text` with control characters and lone surrogates as escapes and the middle of a long one left out."""
    if len(text) > MAX_MESSAGE_CHARACTERS:
        half = MAX_MESSAGE_CHARACTERS // 2
        text = f"{text[:half]} … {text[-half:]}"
    return _UNPRINTABLE.sub(lambda found: ascii(found[0])[1:-1], text)
