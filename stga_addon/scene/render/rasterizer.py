"""The training rasterizer, which renders where Blender has no GPU context: with which Python, and on which device."""

from collections.abc import Callable

from ...errors import StgaError
from ...render.client import RenderClient, missing_packages


class Rasterizer:
    """A render client whose Python and device the main thread looks up, for render threads.

    find_python   the interpreter that renders where Blender's own cannot; raises StgaError where there is none
    find_device   the device, as `render.compose.Composer` takes it
    """

    def __init__(self, find_python: Callable[[], str], find_device: Callable[[], str]) -> None:
        self._find_python, self._find_device = find_python, find_device
        self._python = self._error = ""
        self._device = "auto"
        self.client = RenderClient(self.python, lambda: self._device)

    def update(self) -> None:
        """Look them up again; reads preferences, and files where another Python is needed."""
        self._device = self._find_device()
        if missing_packages():
            try:
                self._python, self._error = self._find_python(), ""
            except StgaError as error:
                self._error = str(error)

    def python(self) -> str:
        """As last looked up. Raises StgaError where there was none."""
        if self._error:
            raise StgaError(self._error)
        return self._python
