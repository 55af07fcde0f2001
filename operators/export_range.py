"""Export of a range of frames beside the user interface: Blender poses the head, a thread writes
the files."""

from collections.abc import Callable
from contextlib import suppress
from queue import Empty, Queue
from threading import Thread
from typing import Any

from ..stga_addon.export.formats import Meshes
from ..stga_addon.progress import Cancelled
from ..stga_addon.scene.arrays import evaluated_vertices
from ..stga_addon.scene.objects import iterate_frames

MAX_WAITING_MESHES = 2


class RangeExport:
    """An export that advances by a frame whenever `step` is called.

    head: what plays; frames: of the scene; write: takes the numbered meshes, and raises StgaError
    where it fails.
    done, total: frames posed so far, and all.
    """

    def __init__(self, head: Any, frames: range, write: Callable[[Meshes], Any]) -> None:
        self.done, self.total = 0, len(frames)
        self._head, self._frames = head, iterate_frames(frames)
        self._queue: Queue[Any] = Queue(MAX_WAITING_MESHES)
        self._is_fed = False
        self._error: Exception | None = None
        self._thread = Thread(target=self._run, args=(write,), name="stga export", daemon=True)
        self._thread.start()

    def step(self) -> bool:
        """Pose the next frame if the thread has room for it; whether the thread is still at
        work."""
        if not self._is_fed and not self._queue.full():
            frame = next(self._frames, None)
            self._is_fed = frame is None
            self._queue.put(None if frame is None else (frame, evaluated_vertices(self._head)))
            self.done += frame is not None
        return self._thread.is_alive()

    def finish(self) -> bool:
        """End the export, restore the scene's frame; whether it is whole. Raises what the thread
        failed with."""
        self._frames.close()
        if not self._is_fed:
            with suppress(Empty):
                while True:
                    self._queue.get_nowait()
            self._queue.put(Cancelled())
        self._thread.join()
        if self._error is not None and not isinstance(self._error, Cancelled):
            raise self._error
        return self._error is None

    def _run(self, write: Callable[[Meshes], Any]) -> None:
        try:
            write(self._meshes())
        except Exception as error:
            self._error = error

    def _meshes(self) -> Meshes:
        while (item := self._queue.get()) is not None:
            if isinstance(item, Cancelled):
                raise item
            yield item
