"""Background loading of views, so that training does not wait for the disk."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from threading import Condition, Thread
from time import perf_counter
from typing import NamedTuple

import numpy as np

from .images import WHITE, read_view
from .model import View

Preparation = Callable[[View, np.ndarray, np.ndarray | None], tuple[np.ndarray, np.ndarray | None]]
"""(view, image (H, W, 3) uint8, mask (H, W) uint8 or None) -> image and mask."""
_Key = tuple[Path, Path | None, bool, int, int, float]
"""Image, mask, timestep and camera of what is decoded, and its scale."""


class LoadedView(NamedTuple):
    """A view with image (H, W, 3) uint8, and mask (H, W) uint8 and mesh (V, 3) where there are."""

    view: View
    image: np.ndarray
    mask: np.ndarray | None = None
    mesh: np.ndarray | None = None

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in self[1:] if isinstance(array, np.ndarray))


class LoaderLimits(NamedTuple):
    """Bounds on the views that are ready (at least one), on decoded images that are kept for later
    epochs, and on images that are decoded at a time; memory does not depend on the sequence's
    length."""

    queue_bytes: int = 16 << 20
    cache_bytes: int = 224 << 20
    readers: int = 1


DEFAULT_LIMITS = LoaderLimits()


class ViewLoader:
    """Iterator over the `LoadedView` of each of `views`, read ahead by a thread.

    views    consumed in the thread, only as far ahead as the queue allows; may be endless, must not
             block
    scale    position in `views` -> image scale in (0, 1], for coarse-to-fine; the yielded view's
             camera is scaled too
    prepare  (view, image, mask) -> image and mask to yield instead, applied once per image read;
             None: those read; several readers call it at a time
    mesh     timestep -> mesh (V, 3) or None, read in the thread as well; None yields no meshes
    waited_s seconds that the consumer has waited so far

    Views come in their order, however many readers there are. Arrays are read-only and shared with
    the cache. An exception in the thread is raised where its view would have come. Use as a context
    manager, or call `close`.
    """

    def __init__(
        self,
        views: Iterable[View],
        scale: Callable[[int], float] = lambda position: 1.0,
        background: tuple[int, int, int] = WHITE,
        limits: LoaderLimits = DEFAULT_LIMITS,
        prepare: Preparation | None = None,
        mesh: Callable[[int], np.ndarray | None] | None = None,
    ) -> None:
        self.waited_s = 0.0
        self._readers = limits.readers
        self._scale = scale
        self._background = background
        self._prepare = prepare
        self._mesh = mesh
        self._queue_bytes = limits.queue_bytes
        # The first views of one scale. They come in random order, each once per epoch: one evicted
        # to make room would be needed sooner than what replaces it, so nothing is evicted until
        # another scale is asked for.
        self._cache: dict[_Key, LoadedView] = {}
        self._cache_bytes = limits.cache_bytes
        self._cached_bytes = 0
        self._cached_scale = 1.0
        self._ready: deque[LoadedView] = deque()
        self._ready_bytes = 0
        self._error: BaseException | None = None
        self._finished = self._closed = False
        self._changed = Condition()
        work = partial(self._work, iter(views))
        self._thread = Thread(target=work, name="view loader", daemon=True)
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
                self._ready_bytes -= loaded.nbytes
                self._changed.notify_all()
                return loaded
            if self._error is not None and not self._closed:
                raise self._error
            raise StopIteration

    def __enter__(self) -> "ViewLoader":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the thread and release its memory; may be called twice."""
        with self._changed:
            self._closed = True
            self._ready.clear()
            self._ready_bytes = 0
            self._changed.notify_all()
        self._thread.join()
        self._cache.clear()

    def _work(self, views: Iterator[View]) -> None:
        try:
            with ThreadPoolExecutor(self._readers, "view reader") as pool:
                self._fill(self._read(views, pool))
        except BaseException as error:  # raised again in the consumer's thread
            self._error = error
        finally:
            with self._changed:
                self._finished = True
                self._changed.notify_all()

    def _fill(self, every: Iterator[LoadedView]) -> None:
        """Make views ready as long as there is room."""
        for loaded in every:
            if self._mesh is not None:
                loaded = loaded._replace(mesh=self._mesh(loaded.view.timestep))
            with self._changed:
                self._changed.wait_for(partial(self._has_room, loaded.nbytes))
                if self._closed:
                    return
                self._ready.append(loaded)
                self._ready_bytes += loaded.nbytes
                self._changed.notify_all()

    def _read(self, views: Iterator[View], pool: Executor) -> Iterator[LoadedView]:
        """Each view in its order, as many being decoded ahead as there are readers; an error of
        `views` comes after those before it."""
        reading = deque[tuple[_Key, Future[LoadedView]]]()
        stopped: BaseException | None = None
        position = 0
        while reading or stopped is None:
            if stopped is None and len(reading) < self._readers:
                try:
                    reading.append(self._begin(next(views), self._scale(position), pool))
                except BaseException as error:  # or the end: after what is being decoded
                    stopped = error
                position += 1
            else:
                key, future = reading.popleft()
                yield self._kept(key, future.result())
        if not isinstance(stopped, StopIteration):
            raise stopped

    def _has_room(self, size: int) -> bool:
        within = self._ready_bytes + size <= self._queue_bytes
        return self._closed or not self._ready or within

    def _begin(self, view: View, scale: float, pool: Executor) -> tuple[_Key, Future[LoadedView]]:
        key = (
            view.image,
            view.mask,
            view.is_mask_inverted,
            view.timestep,
            view.camera_index,
            scale,
        )
        known = self._cache.get(key)
        if known is None:
            return key, pool.submit(self._decode, view, scale)
        done = Future[LoadedView]()
        done.set_result(known)
        return key, done

    def _decode(self, view: View, scale: float) -> LoadedView:
        loaded = LoadedView(*read_view(view, scale, self._background))
        if self._prepare is not None:
            image, mask = self._prepare(loaded.view, loaded.image, loaded.mask)
            loaded = LoadedView(loaded.view, image, mask)
        for array in (loaded.image, loaded.mask):
            if array is not None:
                array.setflags(write=False)
        return loaded

    def _kept(self, key: _Key, loaded: LoadedView) -> LoadedView:
        """The view, kept for later epochs where there is room."""
        scale = key[-1]
        if scale != self._cached_scale:
            self._cache.clear()
            self._cached_bytes = 0
            self._cached_scale = scale
        if key not in self._cache and self._cached_bytes + loaded.nbytes <= self._cache_bytes:
            self._cache[key] = loaded
            self._cached_bytes += loaded.nbytes
        return loaded
