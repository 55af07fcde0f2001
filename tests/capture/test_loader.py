"""The thread that loads the next views."""

import itertools
import threading
import time

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from refusal import refusal

from stga_addon.capture import loader as module
from stga_addon.capture.images import read_view
from stga_addon.capture.loader import LoaderLimits, ViewLoader
from stga_addon.capture.open import open_capture

from . import factory

VIEW_BYTES = factory.WIDTH * factory.HEIGHT * 4  # image and mask


@pytest.fixture
def views(tmp_path):
    capture = open_capture(factory.write_mesh_capture(tmp_path / "capture"))
    return [view for split in capture.views.values() for view in split]


@pytest.fixture
def decoded(monkeypatch):
    """Names of the views in the order in which they are decoded."""
    names = []

    def counted(view, *rest):
        names.append(view.name)
        return read_view(view, *rest)

    monkeypatch.setattr(module, "read_view", counted)
    return names


def loader_threads():
    return sum(thread.name.startswith("view ") for thread in threading.enumerate())


def wait_until(condition):
    deadline = time.monotonic() + 10
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.005)


@pytest.mark.parametrize("readers", [1, 4])
def test_order_and_content(views, readers):
    """Catches views out of order, doubled, lost at the end, or paired with another's image, a
    deadlock where a single view exceeds the queue, and a consumer that changes the cached image
    under the next visit's feet."""
    order = [views[i] for i in (3, 1, 1, 8, 0)]
    with ViewLoader(order, limits=LoaderLimits(queue_bytes=1, readers=readers)) as loader:
        loaded = list(loader)
    assert [item.view for item in loaded] == order
    for view, image, mask, _ in loaded:
        assert mask is not None
        assert_array_equal(image, factory.picture(view.timestep, view.camera_index))
        assert_array_equal(mask, factory.silhouette() * 255)
        for array in (image, mask):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 0


def test_cache_is_bounded(views, decoded):
    """Catches a cache that outgrows its limit, or throws out what the next epoch asks for."""
    sequence = [views[i] for i in (0, 1, 0, 2, 2, 1)]
    with ViewLoader(sequence, limits=LoaderLimits(cache_bytes=2 * VIEW_BYTES)) as loader:
        list(loader)
    # There is room for 0 and 1; 2 is decoded whenever it comes, and drives nothing out.
    assert decoded == [views[i].name for i in (0, 1, 2, 2)]


def test_scales_by_position(views, decoded):
    """Catches a full-size image from the cache where a small one is due, a camera that does not
    match it, and a coarse-to-fine run whose small images fill the cache for good."""
    sizes = [0.5, 0.5, 1.0, 1.0, 0.25]
    with ViewLoader(
        [views[0]] * 5, scale=sizes.__getitem__, limits=LoaderLimits(cache_bytes=VIEW_BYTES)
    ) as loader:
        loaded = list(loader)
    shapes = [image.shape[:2] for _, image, *_ in loaded]
    assert shapes == [(30, 20), (30, 20), (60, 40), (60, 40), (15, 10)]
    assert shapes == [(view.camera.height, view.camera.width) for view, *_ in loaded]
    assert len(decoded) == 3


@pytest.mark.parametrize("readers", [1, 4])
def test_errors_come_where_their_view_would(views, readers):
    """Catches an error lost in the thread, or raised before the good views ahead of it; a hang
    afterwards; and an exception of the given iterator taken for its end."""
    views[2].image.write_bytes(b"broken")
    with ViewLoader(views, limits=LoaderLimits(readers=readers)) as loader:
        assert next(loader)[0] is views[0]
        assert next(loader)[0] is views[1]
        for _ in range(2):
            with refusal("is not a readable image"):
                next(loader)
    assert loader_threads() == 0

    def order():
        yield views[0]
        raise ValueError("bad schedule")

    with ViewLoader(order(), limits=LoaderLimits(readers=readers)) as loader:
        next(loader)
        with pytest.raises(ValueError, match="bad schedule"):
            next(loader)


def test_readers_work_at_a_time(views):
    """Catches images that are decoded one after the other, for which many cores and GPUs wait."""
    together = threading.Barrier(3)

    def prepare(view, image, mask):
        together.wait(timeout=10)
        return image, mask

    with ViewLoader(views[:6], prepare=prepare, limits=LoaderLimits(readers=3)) as loader:
        assert [loaded.view for loaded in loader] == views[:6]


@pytest.mark.parametrize("readers", [1, 4])
def test_closes_from_any_state(views, readers):
    """Catches a thread left behind: full queue, finished, unused, or closed twice."""
    limits = LoaderLimits(queue_bytes=VIEW_BYTES, readers=readers)
    loader = ViewLoader(itertools.cycle(views), limits=limits)
    next(loader)
    loader.__exit__(RuntimeError, RuntimeError("stop"), None)
    loader.close()
    with pytest.raises(StopIteration):
        next(loader)
    ViewLoader([]).close()
    with ViewLoader(views) as finished:
        list(finished)
    assert loader_threads() == 0


def test_meshes_are_read_in_the_thread_and_bounded(views):
    """Catches meshes of another timestep, or read by the consumer, and a thread that runs ahead
    without limit on an endless order of views."""
    read = []

    def mesh(timestep):
        read.append((timestep, threading.current_thread().name))
        return np.full((1000, 3), float(timestep))

    item_bytes = VIEW_BYTES + 24_000
    limits = LoaderLimits(queue_bytes=2 * item_bytes, cache_bytes=0)
    with ViewLoader(itertools.cycle(views), limits=limits, mesh=mesh) as loader:
        first = next(loader)
        wait_until(lambda: len(read) == 4)
        time.sleep(0.1)
        assert len(read) == 4  # one taken, two ready, one waiting for room
        for loaded in (first, *itertools.islice(loader, 8)):
            assert loaded.mesh is not None
            assert (loaded.mesh == loaded.view.timestep).all()
    assert {thread for _, thread in read} == {"view loader"}
