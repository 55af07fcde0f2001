"""What a reader may do with a file that is not for it: load it, or raise StgaError, quickly and in
little memory."""

import os
import time
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from stga_addon.errors import StgaError

SECONDS, MEGABYTES = 1.0, 200.0
GIGA = 10**9
"""As many values as a malformed file says it holds."""


def behaves(read: Callable[[], Any], folder: Path) -> str:
    """The error's message, or "" where `read` loads. Fails on anything else, on a reader that takes
    more than a second or 200 MB beyond the file itself, and on one that adds files to `folder` or
    beside it, or removes some."""
    before = _listing(folder)
    begin = time.perf_counter()
    message = _message(read)
    seconds = time.perf_counter() - begin
    # A busy machine may have stopped the process for a while: only a reader that is slow twice is
    # slow.
    if seconds > SECONDS:
        begin = time.perf_counter()
        _message(read)
        seconds = min(seconds, time.perf_counter() - begin)
    assert seconds < SECONDS, f"{seconds:.2f} s: {message}"
    tracemalloc.start()
    try:
        with suppress(StgaError):
            read()
        peak = tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()
    assert peak < MEGABYTES, f"{peak:.0f} MB: {message}"
    assert _listing(folder) == before
    return message


def _message(read: Callable[[], Any]) -> str:
    message = ""
    try:
        read()
    except StgaError as error:
        message = str(error) or "an error without a message"
    assert "\n" not in message[:80]
    assert message != "an error without a message"
    return message


def _listing(folder: Path) -> list[str]:
    """What is in a folder, at any depth, and what is beside it; the folders there are those of all
    other tests."""
    inside = [
        os.path.join(base, name)
        for base, dirs, files in os.walk(folder)
        for name in (*dirs, *files)
    ]
    return sorted([*inside, *os.listdir(folder.parent)])
