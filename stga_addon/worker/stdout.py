"""Standard output as a message stream that nothing else can write to."""

import os
import sys
from typing import BinaryIO


def claim_stdout() -> BinaryIO:
    """Return a stream on standard output, and send whatever else is written there to standard error.

    Call it before anything that may print is imported: libraries in C write to descriptor 1, whatever `sys.stdout` is.
    """
    sys.stdout.flush()
    try:
        os.fstat(2)
    except OSError:  # standard error is closed
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    messages = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    return messages
