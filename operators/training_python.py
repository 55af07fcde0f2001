"""The choice of the Python that tracks and trains, and its test."""

from functools import lru_cache
from subprocess import Popen
from time import monotonic
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.jobs.python_check import CHECK_TIMEOUT_S, Checked, finish_check, start_check
from ..stga_addon.worker.training_python import find_training_python
from . import ids, monitor
from .common import polled, preferences, reporting

POLL_INTERVAL_S = 0.3


def training_python(context: Any, given: str = "") -> str:
    """The interpreter that tracks and trains: the one given, else that of `find_training_python`.

    Raises StgaError where none of them can.
    """
    return bpy.path.abspath(given) if given else find_training_python(_preferred(context))


def has_training_python(context: Any) -> bool:
    """Whether `training_python` finds one, for panels."""
    return bool(_lookup(_preferred(context)))


@lru_cache(maxsize=1)
def _lookup(preferred: str) -> str:
    try:
        return find_training_python(preferred)
    except StgaError:
        return ""


def _preferred(context: Any) -> str:
    """The Python in the preferences; "" where none is."""
    stored = preferences(context)
    return bpy.path.abspath(stored.training_python) if stored and stored.training_python else ""


class _Test:
    """The last test of an interpreter: running, or with what it found."""

    def __init__(self) -> None:
        self.python, self.error = "", ""
        self.found: Checked | None = None
        self._process: Popen[str] | None = None
        self._begun_s = 0.0

    @property
    def is_running(self) -> bool:
        return self._process is not None

    def begin(self, python: str) -> None:
        """Raises StgaError where the interpreter cannot be started."""
        self._process, self._begun_s = start_check(python), monotonic()
        self.python, self.found, self.error = python, None, ""

    def end(self, timeout_s: float) -> None:
        """Wait for what the test finds."""
        assert self._process is not None
        try:
            self.found = finish_check(self.python, self._process, timeout_s)
        except StgaError as error:
            self.error = str(error)
        self._process = None

    def tick(self) -> float | None:
        assert self._process is not None
        if self._process.poll() is None and monotonic() - self._begun_s < CHECK_TIMEOUT_S:
            return POLL_INTERVAL_S
        self.end(timeout_s=1.0)
        monitor.redraw()
        return None

    def close(self) -> None:
        if self._process is not None:
            self._process.kill()
            self.end(timeout_s=1.0)


test = _Test()


class TestPython(bpy.types.Operator):
    """Start the Python that tracks and trains, and report its versions of torch and numba and its
    device, or what it lacks"""

    bl_idname = ids.TEST_PYTHON
    bl_label = "Test"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    python: bpy.props.StringProperty(
        name="Python", description="The interpreter to test; empty: the one that trains",
        subtype="FILE_PATH",
    )  # fmt: skip

    @classmethod
    def poll(cls, context: Any) -> bool:
        return polled(cls, not test.is_running, "A test is running")

    @reporting
    def execute(self, context: Any) -> set[str]:
        test.begin(training_python(context, self.python))
        if monitor.has_timer():
            monitor.watch(test)
            return {"FINISHED"}
        test.end(CHECK_TIMEOUT_S)
        if test.found is None:
            raise StgaError(test.error)
        self.report({"INFO"}, test.found.line)
        return {"FINISHED"}
