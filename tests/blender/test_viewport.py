"""The viewport's drawing thread, without a GPU."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("bpy")

from stga_addon.capture.camera import Camera
from stga_addon.errors import StgaError
from stga_addon.scene.render import viewport
from stga_addon.scene.render.camera import camera_of, viewport_camera
from stga_addon.scene.render.viewport import Sketcher, Wish

CAMERA = Camera(800, 600, 700.0, 700.0, 400.0, 300.0, np.eye(4))


def wish(x: float = 0.0, layers=(), world=None) -> Wish:
    pose = np.eye(4)
    pose[0, 3] = x
    return Wish(layers, replace(CAMERA, world_to_camera=pose), world)


class Sketches:
    """A sketcher whose pictures only name what they show; each waits until it is let go."""

    def __init__(self, error: Exception | None = None, waits: bool = False) -> None:
        self.painted: list[tuple[Wish, float]] = []
        self.error, self.go = error, threading.Semaphore(0 if waits else 10**6)
        self.rested = threading.Event()
        self.sketcher = Sketcher(self.paint, lambda: None)

    def paint(self, wanted: Wish, share: float) -> np.ndarray:
        self.go.acquire()
        self.painted.append((wanted, share))
        if self.error:
            raise self.error
        return np.zeros((round(600 * share), round(800 * share), 4), np.float32)

    def rest(self) -> None:
        for _ in range(500):
            if not self.sketcher._busy:
                return
            time.sleep(0.01)
        raise AssertionError("the thread never came to rest")


def test_a_resting_view_gets_the_full_picture():
    """Catches a view that stays coarse, and one that is drawn again and again."""
    seen = Sketches()
    asked = wish()
    seen.sketcher.ask(asked)
    seen.rest()
    shares = [share for _, share in seen.painted]
    assert shares[0] < 1
    assert shares[-1] == 1
    assert seen.sketcher.picture is not None
    assert seen.sketcher.picture.shape == (600, 800, 4)
    seen.sketcher.ask(wish(layers=asked.layers))
    seen.rest()
    assert len(seen.painted) == len(shares)


def test_a_moving_view_gets_the_newest_picture():
    """Catches a queue: views that have passed by must not be drawn."""
    seen = Sketches(waits=True)
    for x in range(20):
        seen.sketcher.ask(wish(float(x)))
    seen.go.release(10**6)
    seen.rest()
    assert len(seen.painted) <= 4
    last, share = seen.painted[-1]
    assert (last.camera.world_to_camera[0, 3], share) == (19, 1)


def test_slow_pictures_get_coarser(monkeypatch):
    """Catches a viewport that stutters on a slow machine."""
    monkeypatch.setattr(viewport, "PATIENCE_S", 1e-9)
    seen = Sketches()
    for x in range(12):
        seen.sketcher.ask(wish(float(x)))
        seen.rest()
    coarse = [share for _, share in seen.painted if share < 1]
    assert coarse[-1] == viewport.COARSEST < coarse[0]


@pytest.mark.parametrize("error", [StgaError("no head"), ValueError("no head")])
def test_mishaps_are_said(error):
    """Catches a thread that dies silently, and one that tries for ever."""
    seen = Sketches(error)
    seen.sketcher.ask(wish())
    seen.rest()
    assert "no head" in seen.sketcher.error
    assert len(seen.painted) == 1
    seen.error = None
    seen.sketcher.ask(wish(1.0))
    seen.rest()
    assert seen.sketcher.error == ""


def test_orthographic_views_are_seen_from_afar():
    """Catches views of the numpad that show something else than Blender's grid: points fall where it draws them."""
    from mathutils import Matrix

    class Region:
        is_perspective = False
        view_matrix = Matrix.Translation((0.02, 0.05, -3)) @ Matrix.Rotation(0.4, 4, "X")
        window_matrix = Matrix(((2.5, 0, 0, 0.1), (0, 3.3, 0, -0.2), (0, 0, -0.1, 0), (0, 0, 0, 1)))

    camera = viewport_camera(Region, 800, 600)
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.normal(0, 0.1, (50, 3)), np.ones(50)])
    clip = points @ np.array(Region.view_matrix).T @ np.array(Region.window_matrix).T
    expected = np.stack([(clip[:, 0] + 1) * 400, (1 - clip[:, 1]) * 300], -1)
    seen = points @ camera.world_to_camera.T
    x = camera.fl_x * seen[:, 0] / seen[:, 2] + camera.cx
    y = camera.fl_y * seen[:, 1] / seen[:, 2] + camera.cy
    np.testing.assert_allclose(np.stack([x, y], -1), expected, atol=2.0)


def test_perspective_views():
    """Catches a principal point on the wrong side."""
    projection = np.array([[2.0, 0, 0.1, 0], [0, 3.0, -0.2, 0], [0, 0, -1, -0.02], [0, 0, -1, 0]])
    camera = camera_of(np.eye(4), projection, 800, 600)
    point = np.array([0.1, -0.2, -1.5, 1])
    clip = projection @ point
    expected = (clip[0] / clip[3] + 1) * 400, (1 - clip[1] / clip[3]) * 300
    seen = camera.world_to_camera @ point
    assert camera.fl_x * seen[0] / seen[2] + camera.cx == pytest.approx(expected[0])
    assert camera.fl_y * seen[1] / seen[2] + camera.cy == pytest.approx(expected[1])
