"""Pictures for a viewport that is orbited: coarse ones while it moves, a full one when it rests, none on the UI's time.

Importing this needs no GPU: `gpu` comes with the first picture.
"""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...capture.camera import Camera
from ...errors import StgaError
from ...raster.posed_splats import PosedSplats
from ...raster.render_client import RenderClient

PATIENCE_S = 0.05
"""A picture of a moving view may take this long; it gets coarser until it does."""
COARSEST = 1 / 8


@dataclass(frozen=True, eq=False)
class Wish:
    """What a viewport wants to see: layers, the camera at full size, and the world's colour behind, or None."""

    layers: Sequence[PosedSplats]
    camera: Camera
    world: tuple[float, ...] | None

    def is_same(self, other: "Wish | None") -> bool:
        return other is not None and self.layers is other.layers and self._numbers() == other._numbers()

    def _numbers(self) -> tuple[Any, ...]:
        camera = self.camera
        lens = camera.width, camera.height, camera.fl_x, camera.fl_y, camera.cx, camera.cy
        return *lens, camera.world_to_camera.tobytes(), self.world


class Sketcher:
    """Draws the newest wish in a thread of its own, which lives until nothing is left to refine.

    paint: (wish, share of the full size) -> picture (H, W, 4); shown: called in the thread when there is news.
    """

    def __init__(self, paint: Callable[[Wish, float], np.ndarray], shown: Callable[[], None]) -> None:
        self._paint, self._shown = paint, shown
        self._lock = threading.Lock()
        self._wish: Wish | None = None
        self._busy = False
        self._share = 0.5
        self.picture: np.ndarray | None = None
        self.error = ""

    def ask(self, wish: Wish) -> None:
        """Have this drawn next; a wish that is already being drawn changes nothing."""
        with self._lock:
            if wish.is_same(self._wish):
                return
            self._wish = wish
            if not self._busy:
                self._busy = True
                threading.Thread(target=self._draw, daemon=True).start()

    def _draw(self) -> None:
        done: Wish | None = None
        share = 0.0
        while True:
            with self._lock:
                wish = self._wish
                if wish is None or (wish is done and share == 1):
                    self._busy = False
                    return
                # A view that still moves gets a coarse picture, one that rests the full one.
                share = 1.0 if wish is done else self._share
            begin = time.perf_counter()
            try:
                self.picture, self.error = self._paint(wish, share), ""
            except StgaError as error:
                self.error, share = str(error), 1.0
            except Exception as error:  # a thread that dies silently would leave the viewport waiting for ever
                self.error, share = f"{type(error).__name__}: {error}", 1.0
            took = time.perf_counter() - begin
            if share < 1 or took < PATIENCE_S:
                self._share = float(np.clip(self._share * np.sqrt(PATIENCE_S / max(took, 1e-3)), COARSEST, 1.0))
            done = wish
            self._shown()


def painted(painter: RenderClient, combine: Callable[..., np.ndarray], wish: Wish, share: float) -> np.ndarray:
    """(H, W, 4) float32 for the GPU, bottom row first."""
    picture = painter.compose(wish.layers, wish.camera.scaled(share))
    return np.ascontiguousarray(combine(picture.rgb, picture.alpha, wish.world)[::-1])


class Screen:
    """A picture on the GPU."""

    def __init__(self) -> None:
        self._shown: np.ndarray | None = None
        self._texture: Any = None

    def draw(self, picture: np.ndarray, width: int, height: int) -> None:
        """Draw a picture (H, W, 4) over a region of that size."""
        import gpu
        from gpu_extras.presets import draw_texture_2d

        if picture is not self._shown:
            rows, columns, _ = picture.shape
            pixels = gpu.types.Buffer("FLOAT", picture.size, picture.ravel())
            self._texture = gpu.types.GPUTexture((columns, rows), format="RGBA16F", data=pixels)
            self._shown = picture
        gpu.state.blend_set("ALPHA_PREMULT")
        draw_texture_2d(self._texture, (0, 0), width, height)
        gpu.state.blend_set("NONE")
