"""The viewport's render thread and redraw timer, without a GPU."""

import gc
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import bpy
import numpy as np
import pytest

from stga_addon.capture.camera import Camera
from stga_addon.errors import StgaError
from stga_addon.scene.render import engine as engine_viewport
from stga_addon.scene.render.engine import RenderRequest, ViewportRenderer

CAMERA = Camera(800, 600, 700.0, 700.0, 400.0, 300.0, np.eye(4))


def request(x: float = 0.0, layers=(), background=None) -> RenderRequest:
    pose = np.eye(4)
    pose[0, 3] = x
    return RenderRequest(layers, replace(CAMERA, world_to_camera=pose), background)


class Recorder:
    """A renderer of empty images that records requests; one image per `go`."""

    def __init__(self, error: Exception | None = None, waits: bool = False) -> None:
        self.rendered: list[tuple[RenderRequest, float]] = []
        self.error = error
        self.go = threading.Semaphore(0 if waits else 10**6)
        self.started = threading.Event()
        self.renderer = ViewportRenderer(self.render)

    def render(self, requested: RenderRequest, scale: float) -> np.ndarray:
        self.started.set()
        self.go.acquire()
        self.rendered.append((requested, scale))
        if self.error:
            raise self.error
        return np.zeros((round(600 * scale), round(800 * scale), 4), np.float32)

    def wait_for(self, images: int) -> None:
        deadline = time.monotonic() + 5
        while len(self.rendered) < images:
            assert time.monotonic() < deadline, "the thread renders nothing"
            time.sleep(0.001)


class Engine:
    """Records from which threads it was asked to redraw."""

    def __init__(self, freed: bool = False) -> None:
        self.threads: list[threading.Thread] = []
        self.freed = freed

    def tag_redraw(self) -> None:
        if self.freed:
            raise ReferenceError("StructRNA of type STGA_SPLATS has been removed")
        self.threads.append(threading.current_thread())


@pytest.fixture(autouse=True)
def _stopped_timer() -> Iterator[None]:
    yield
    engine_viewport.stop_redraws()


def test_views_are_rendered_from_their_latest_request():
    """Catches a queue of passed views, a view that stays coarse, or is rendered again."""
    recorder = Recorder(waits=True)
    requests = [request(float(x)) for x in range(20)]
    assert all(map(recorder.renderer.request, requests))
    recorder.go.release(10**6)
    recorder.renderer.join()
    assert len(recorder.rendered) <= 4
    assert recorder.rendered[0][1] < 1
    last, scale = recorder.rendered[-1]
    assert (last.camera.world_to_camera[0, 3], scale) == (19, 1)
    assert recorder.renderer.image.shape == (600, 800, 4)
    rendered = len(recorder.rendered)
    assert not recorder.renderer.request(request(19.0, layers=last.layers))
    assert not recorder.renderer.is_busy()
    assert len(recorder.rendered) == rendered


def test_slow_images_get_coarser(monkeypatch):
    """Catches a viewport that stutters on a slow machine."""
    monkeypatch.setattr(engine_viewport, "MAX_RENDER_TIME_S", 1e-9)
    recorder = Recorder()
    for x in range(12):
        recorder.renderer.request(request(float(x)))
        recorder.renderer.join()
    coarse = [scale for _, scale in recorder.rendered if scale < 1]
    assert coarse[-1] == engine_viewport.MIN_SCALE < coarse[0]


@pytest.mark.parametrize("error", [StgaError("no head"), ValueError("no head")])
def test_failures_are_reported(error):
    """Catches a thread that ends without a message, and one that retries forever."""
    recorder = Recorder(error)
    recorder.renderer.request(request())
    recorder.renderer.join()
    assert "no head" in recorder.renderer.error
    assert len(recorder.rendered) == 1
    recorder.error = None
    recorder.renderer.request(request(1.0))
    recorder.renderer.join()
    assert recorder.renderer.error == ""


def test_viewports_are_redrawn_from_the_main_thread():
    """Catches bpy in the render thread, a lost last image, and an idle timer."""
    recorder = Recorder(waits=True)
    engine = Engine()
    recorder.renderer.request(request())
    engine_viewport.redraw_when_rendered(recorder.renderer, engine)
    assert bpy.app.timers.is_registered(engine_viewport._poll)
    assert engine_viewport._poll() == engine_viewport.POLL_INTERVAL_S
    assert engine.threads == []  # nothing was rendered yet
    for images in (1, 2):  # a coarse one, then the full one
        recorder.go.release()
        recorder.wait_for(images)
        while not recorder.renderer._has_update:
            time.sleep(0.001)
        engine_viewport._poll()
        assert engine.threads == [threading.main_thread()] * images
    recorder.renderer.join()
    assert engine_viewport._poll() is None
    assert len(engine.threads) == 2
    assert engine_viewport._active == {}


@pytest.mark.parametrize("freed", [False, True])
def test_a_closed_viewport_ends_its_thread(freed):
    """Catches a thread nobody sees, an engine kept by the timer, and a timer that fails."""
    recorder = Recorder(waits=True)
    engine = Engine(freed)
    recorder.renderer.request(request())
    recorder.started.wait()
    engine_viewport.redraw_when_rendered(recorder.renderer, engine)
    if not freed:  # else Blender's part of it is gone while Python still holds its own
        del engine
        gc.collect()
        engine_viewport._poll()
    recorder.go.release()
    recorder.wait_for(1)
    if freed:
        while not recorder.renderer._has_update:
            time.sleep(0.001)
        engine_viewport._poll()
        recorder.go.release()
    recorder.renderer.join()
    assert recorder.rendered[-1][1] < 1 or freed
    assert engine_viewport._poll() is None


def test_stopping_ends_timer_and_threads():
    """Catches an extension that still renders, or calls its timer, after it was disabled."""
    recorder = Recorder(waits=True)
    engine = Engine()
    recorder.renderer.request(request())
    recorder.started.wait()
    engine_viewport.redraw_when_rendered(recorder.renderer, engine)

    def finish_image_once_cancelled() -> None:
        while recorder.renderer._request is not None:
            time.sleep(0.001)
        recorder.go.release(10**6)

    threading.Thread(target=finish_image_once_cancelled).start()
    engine_viewport.stop_redraws()
    assert not bpy.app.timers.is_registered(engine_viewport._poll)
    assert not recorder.renderer.is_busy()
    assert len(recorder.rendered) == 1
    assert engine.threads == []
