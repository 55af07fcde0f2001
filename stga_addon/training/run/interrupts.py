"""Ctrl-C as a request that a training loop answers between two steps."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interrupt_requests() -> Iterator[list[int]]:
    """A list that receives the first Ctrl-C; the second one raises KeyboardInterrupt.

    Without effect off the main thread and in Blender, which handles Ctrl-C itself.
    """
    requests: list[int] = []

    def request(number: int, _frame: object) -> None:
        if requests:
            raise KeyboardInterrupt
        requests.append(number)

    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield requests
        return
    signal.signal(signal.SIGINT, request)
    try:
        yield requests
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
