"""One window at a time: a second one takes the keyboard and the processor from the first."""

from collections.abc import Callable, Iterator

import pytest
from filelock import FileLock


@pytest.fixture(scope="module", autouse=True)
def window(alone: Callable[[str], FileLock]) -> Iterator[None]:
    with alone("window"):
        yield
