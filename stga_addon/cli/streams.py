"""Standard streams that never raise: closed, full, broken pipes, ASCII-only encodings."""

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


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
        io.BufferedWriter(Output(stream.fileno(), "w", closefd=False)), encoding=stream.encoding,
        errors="backslashreplace", line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )  # fmt: skip
