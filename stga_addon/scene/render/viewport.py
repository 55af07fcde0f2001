"""Viewport images from a background thread: coarse while the view moves, at full resolution once it rests."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...capture.camera import Camera
from ...errors import StgaError
from ...raster.posed_splats import PosedSplats

MAX_RENDER_TIME_S = 0.05
"""Time an image of a moving view may take; its resolution is adapted to that."""
INITIAL_SCALE = 0.5
MIN_SCALE = 1 / 8
"""Fractions of the viewport's width and height in pixels."""


@dataclass(frozen=True, eq=False)
class RenderRequest:
    """What one viewport image shows.

    layers: the scene's splats; camera: at the viewport's full size; background: scene-linear RGB, None if transparent.
    """

    layers: Sequence[PosedSplats]
    camera: Camera
    background: tuple[float, ...] | None

    def is_same(self, other: "RenderRequest | None") -> bool:
        """Whether both show the same layers (by identity) from the same camera."""
        return other is not None and self.layers is other.layers and self._view() == other._view()

    def _view(self) -> tuple[Any, ...]:
        camera = self.camera
        intrinsics = camera.width, camera.height, camera.fl_x, camera.fl_y, camera.cx, camera.cy
        return *intrinsics, camera.world_to_camera.tobytes(), self.background


class ViewportRenderer:
    """Renders the latest request in a thread, which ends once that request has its full-resolution image.

    render: (request, scale) -> image (H, W, 4) float32, scale being a fraction of the camera's size.
    The thread touches nothing of Blender; the main thread polls `is_busy` and `take_update`.

    image  the last image rendered, or None
    error  why the last request failed, else empty
    """

    def __init__(self, render: Callable[[RenderRequest, float], np.ndarray]) -> None:
        self._render = render
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._request: RenderRequest | None = None
        self._moving_scale = INITIAL_SCALE
        self._has_update = False
        self.image: np.ndarray | None = None
        self.error = ""

    def request(self, request: RenderRequest) -> bool:
        """Render this next, instead of what was requested before; returns False if it is the same."""
        with self._lock:
            if request.is_same(self._request):
                return False
            self._request = request
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, daemon=True)
                self._thread.start()
            return True

    def cancel(self) -> None:
        """Render nothing more than the image in progress."""
        with self._lock:
            self._request = None

    def join(self) -> None:
        """Wait for the end of the thread, if it runs."""
        thread = self._thread
        if thread is not None:
            thread.join()

    def is_busy(self) -> bool:
        return self._thread is not None

    def take_update(self) -> bool:
        """Whether `image` or `error` has changed since the last call."""
        with self._lock:
            had_update, self._has_update = self._has_update, False
        return had_update

    def _run(self) -> None:
        request: RenderRequest | None = None
        scale = 0.0
        while (next_step := self._next_step(request, scale)) is not None:
            request, scale = next_step
            begin = time.perf_counter()
            try:
                self.image, self.error = self._render(request, scale), ""
            except StgaError as error:
                self.error, scale = str(error), 1.0
            except Exception as error:  # shown in the viewport: an exception would end the thread unseen
                self.error, scale = f"{type(error).__name__}: {error}", 1.0
            self._adapt_scale(scale, time.perf_counter() - begin)
            with self._lock:
                self._has_update = True

    def _next_step(self, last: RenderRequest | None, scale: float) -> tuple[RenderRequest, float] | None:
        """The request to render now and its scale; None ends the thread. last, scale: the image just rendered."""
        with self._lock:
            latest = self._request
            if latest is None or (latest is last and scale == 1):
                self._thread = None
                return None
            return latest, 1.0 if latest is last else self._moving_scale

    def _adapt_scale(self, scale: float, elapsed_s: float) -> None:
        if scale < 1 or elapsed_s < MAX_RENDER_TIME_S:
            factor = np.sqrt(MAX_RENDER_TIME_S / max(elapsed_s, 1e-3))
            self._moving_scale = float(np.clip(self._moving_scale * factor, MIN_SCALE, 1.0))


class ViewportImage:
    """An image as a GPU texture."""

    def __init__(self) -> None:
        self._uploaded: np.ndarray | None = None
        self._texture: Any = None

    def draw(self, image: np.ndarray, width: int, height: int) -> None:
        """Draw an image (H, W, 4), bottom row first, over a region of width × height pixels."""
        import gpu
        from gpu_extras.presets import draw_texture_2d

        if image is not self._uploaded:
            rows, columns, _ = image.shape
            pixels = gpu.types.Buffer("FLOAT", image.size, image.ravel())
            self._texture = gpu.types.GPUTexture((columns, rows), format="RGBA16F", data=pixels)
            self._uploaded = image
        gpu.state.blend_set("ALPHA_PREMULT")
        draw_texture_2d(self._texture, (0, 0), width, height)
        gpu.state.blend_set("NONE")
