"""A thread that holds the next views ready, so that training never waits for the disk."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from threading import Condition, Thread
from time import perf_counter
from types import TracebackType

import numpy as np

from .images import WHITE, read_view
from .model import View

LoadedView = tuple[View, np.ndarray, np.ndarray | None]


class ViewLoader:
    """Yields (view, image (H, W, 3) uint8, mask (H, W) uint8 or None) for each of `views`, in order.

    views   drawn in the loader's thread, only as far ahead as the queue reaches; may be endless, must not block
    scale   position in `views` -> size in (0, 1], for coarse-to-fine; the yielded view's camera is scaled alike
    correct   (view, image, mask) -> the image to yield instead, applied once to each that is read; None for none
    queue_bytes, cache_bytes  bounds on what is ready ahead (at least one view), and on decoded views kept for
            their next visit; memory depends on these, not on how long the sequence is
    waited_s  seconds that the consumer has waited so far

    Arrays are read-only and shared with the cache. What fails in the thread is raised where its view would have
    come. Use as a context manager, or call `close`.
    """

    def __init__(
        self,
        views: Iterable[View],
        scale: Callable[[int], float] = lambda position: 1.0,
        background: tuple[int, int, int] = WHITE,
        queue_bytes: int = 16 << 20,
        cache_bytes: int = 224 << 20,
        correct: Callable[[View, np.ndarray, np.ndarray | None], np.ndarray] | None = None,
    ) -> None:
        self.waited_s = 0.0
        self._scale, self._background, self._correct = scale, background, correct
        self._queue_bytes = queue_bytes
        self._cache = _Cache(cache_bytes)
        self._ready: deque[LoadedView] = deque()
        self._ready_bytes = 0
        self._error: BaseException | None = None
        self._finished = self._closed = False
        self._changed = Condition()
        self._thread = Thread(target=self._work, args=(iter(views),), name="view loader", daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[LoadedView]:
        return self

    def __next__(self) -> LoadedView:
        start = perf_counter()
        with self._changed:
            self._changed.wait_for(lambda: self._ready or self._finished or self._closed)
            self.waited_s += perf_counter() - start
            if self._ready and not self._closed:
                loaded = self._ready.popleft()
                self._ready_bytes -= _size(loaded)
                self._changed.notify_all()
                return loaded
            if self._error is not None and not self._closed:
                raise self._error
            raise StopIteration

    def __enter__(self) -> "ViewLoader":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the thread and let go of everything it holds; may be called twice."""
        with self._changed:
            self._closed = True
            self._ready.clear()
            self._ready_bytes = 0
            self._changed.notify_all()
        self._thread.join()
        self._cache.clear()

    def _work(self, views: Iterator[View]) -> None:
        try:
            for position, view in enumerate(views):
                if not self._offer(self._load(view, self._scale(position))):
                    return
        except BaseException as error:  # Whatever it is, it belongs to the consumer.
            self._error = error
        finally:
            with self._changed:
                self._finished = True
                self._changed.notify_all()

    def _offer(self, loaded: LoadedView) -> bool:
        """Wait for room, then queue; False once closed."""
        size = _size(loaded)
        with self._changed:
            self._changed.wait_for(
                lambda: self._closed or not self._ready or self._ready_bytes + size <= self._queue_bytes
            )
            if self._closed:
                return False
            self._ready.append(loaded)
            self._ready_bytes += size
            self._changed.notify_all()
            return True

    def _load(self, view: View, scale: float) -> LoadedView:
        key = (view.image, view.mask, view.timestep, view.camera_index, scale)
        kept = self._cache.get(key)
        if kept is None:
            kept = read_view(view, scale, self._background)
            if self._correct is not None:
                kept = kept[0], self._correct(*kept), kept[2]
            for array in kept[1:]:
                if isinstance(array, np.ndarray):
                    array.setflags(write=False)
            self._cache.put(key, kept)
        return kept


Key = tuple[Path, Path | None, int, int, float]


class _Cache:
    """The views of one size that came first, up to a number of bytes.

    Views are visited in random order, every one once an epoch: what is thrown out to make room would be asked for
    sooner than what replaces it, so nothing is thrown out until another size is asked for.
    """

    def __init__(self, limit: int) -> None:
        self._limit, self._held, self._scale = limit, 0, 1.0
        self._entries: dict[Key, LoadedView] = {}

    def get(self, key: Key) -> LoadedView | None:
        return self._entries.get(key)

    def put(self, key: Key, loaded: LoadedView) -> None:
        if key[-1] != self._scale:
            self.clear()
            self._scale = key[-1]
        if self._held + _size(loaded) <= self._limit:
            self._entries[key] = loaded
            self._held += _size(loaded)

    def clear(self) -> None:
        self._entries.clear()
        self._held = 0


def _size(loaded: LoadedView) -> int:
    _, image, mask = loaded
    return image.nbytes + (0 if mask is None else mask.nbytes)
