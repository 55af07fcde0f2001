"""A viewport of the render engine: drawn by the GPU, or, where that fails, images of the rasterizer
from a thread."""

import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any
from weakref import ref

import bpy
import gpu
import numpy as np

from ...capture.camera import Camera
from ...errors import StgaError
from ...raster.posed_splats import PosedSplats
from ...render.client import RenderClient, missing_packages
from ..cameras import viewport_camera
from ..gpu.renderer import SplatRenderer
from ..layers import SceneLayer
from ..light.settings import settings_values
from .scene_splats import SplatCache, visible_layers
from .view_transform import combined, scene_background, srgb_background
from .viewport_display import is_drawn_by_engine, region_view

MAX_RENDER_TIME_S = 0.05
"""Time an image of a moving view may take; its resolution is adapted to that."""
INITIAL_SCALE = 0.5
MIN_SCALE = 1 / 8
"""Fractions of the viewport's width and height in pixels."""


@dataclass(frozen=True, eq=False)
class RenderRequest:
    """What one viewport image shows.

    layers: the scene's splats; camera: at the viewport's full size; background: scene-linear RGB,
    None if transparent.
    """

    layers: Sequence[PosedSplats]
    camera: Camera
    background: tuple[float, ...] | None

    def key(self) -> tuple[Any, ...]:
        """Equal for requests that show the same layers (by identity) from the same camera."""
        camera = self.camera
        intrinsics = camera.width, camera.height, camera.fl_x, camera.fl_y, camera.cx, camera.cy
        return id(self.layers), *intrinsics, camera.world_to_camera.tobytes(), self.background


class ViewportRenderer:
    """Renders the latest request in a thread, which ends once that request has its full-resolution
    image.

    render: (request, scale) -> image (H, W, 4) float32, scale being a fraction of the camera's
    size. The thread touches nothing of Blender; the main thread polls `is_busy` and `take_update`.

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
        """Render this next, instead of what was requested before; returns False if it is the
        same."""
        with self._lock:
            if self._request is not None and request.key() == self._request.key():
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
            # shown in the viewport: an exception would end the thread unseen
            except Exception as error:
                self.error, scale = f"{type(error).__name__}: {error}", 1.0
            elapsed_s = time.perf_counter() - begin
            if scale < 1 or elapsed_s < MAX_RENDER_TIME_S:
                factor = np.sqrt(MAX_RENDER_TIME_S / max(elapsed_s, 1e-3))
                self._moving_scale = float(np.clip(self._moving_scale * factor, MIN_SCALE, 1.0))
            with self._lock:
                self._has_update = True

    def _next_step(
        self, last: RenderRequest | None, scale: float
    ) -> tuple[RenderRequest, float] | None:
        """The request to render now and its scale; None ends the thread. last, scale: the image
        just rendered."""
        with self._lock:
            latest = self._request
            if latest is None or (latest is last and scale == 1):
                self._thread = None
                return None
            return latest, 1.0 if latest is last else self._moving_scale


class ViewportImage:
    """An image as a GPU texture."""

    def __init__(self) -> None:
        self._uploaded: np.ndarray | None = None
        self._texture: Any = None

    def draw(self, image: np.ndarray, width: int, height: int) -> None:
        """Draw an image (H, W, 4), bottom row first, over a region of width × height pixels."""
        from gpu_extras.presets import draw_texture_2d

        if image is not self._uploaded:
            rows, columns, _ = image.shape
            pixels = gpu.types.Buffer("FLOAT", image.size, image.ravel())
            self._texture = gpu.types.GPUTexture((columns, rows), format="RGBA16F", data=pixels)
            self._uploaded = image
        gpu.state.blend_set("ALPHA_PREMULT")
        draw_texture_2d(self._texture, (0, 0), width, height)
        gpu.state.blend_set("NONE")


POLL_INTERVAL_S = 1 / 60

_active: dict[ViewportRenderer, "ref[Any]"] = {}
"""Renderers whose threads run, and the engines of their viewports; Blender frees an engine with its
viewport."""


def redraw_when_rendered(renderer: ViewportRenderer, engine: Any) -> None:
    """Call `engine.tag_redraw()` for each image of the renderer, until its thread ends."""
    _active[renderer] = ref(engine)
    if not bpy.app.timers.is_registered(_poll):
        bpy.app.timers.register(_poll, first_interval=POLL_INTERVAL_S, persistent=True)


def stop_redraws() -> None:
    """End the timer and the render threads; waits for the images in progress."""
    if bpy.app.timers.is_registered(_poll):
        bpy.app.timers.unregister(_poll)
    for renderer in _active:
        renderer.cancel()
    for renderer in _active:
        renderer.join()
    _active.clear()


def _poll() -> float | None:
    """Redraw what has changed; returns the seconds until the next call, None once every thread has
    ended."""
    for renderer in list(_active):
        # before the update is taken, so that the last one is not missed
        is_busy = renderer.is_busy()
        if not _redraw(renderer):
            renderer.cancel()
            del _active[renderer]
        elif not is_busy:
            del _active[renderer]
    return POLL_INTERVAL_S if _active else None


def _redraw(renderer: ViewportRenderer) -> bool:
    """Redraw the renderer's viewport if there is something new; False where the viewport was
    closed."""
    engine = _active[renderer]()
    if engine is None:
        return False
    try:
        if renderer.take_update():
            engine.tag_redraw()
    except ReferenceError:  # Blender has freed its part of the engine
        return False
    return True


class Rasterizer:
    """A render client whose Python and device the main thread looks up, for render threads.

    find_python   the interpreter that renders where Blender's own cannot; raises StgaError where
                  there is none
    find_device   the device, as `render.device.Composer` takes it
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


class EngineViewport:
    """What one viewport of the engine keeps between redraws.

    Owned by its engine alone, so that the texture is freed with it, by the main thread.
    """

    def __init__(self, rasterizer: Rasterizer) -> None:
        self._rasterizer = rasterizer
        self.renderer = ViewportRenderer(partial(_render_request, rasterizer.client))
        self.image = ViewportImage()
        self.error = ""
        self._gpu: SplatRenderer | None = None
        self._gpu_failed = False
        self._cache = SplatCache()
        self._layers: list[SceneLayer] | None = None
        self._posed: list[PosedSplats] = []
        self._posed_for: bytes = b""
        self._lighting: tuple[Any, ...] = ()

    def update(self, depsgraph: Any) -> None:
        """The scene has changed: pose the splats again, and read meshes again that were edited
        themselves."""
        self._layers = None
        self._cache.light.casters.forget()
        self._cache.discard(
            {
                update.id.original
                for update in depsgraph.updates
                if isinstance(update.id, bpy.types.Mesh)
            }
        )

    def draw(self, context: Any, depsgraph: Any) -> bool:
        """Draw the current view with the GPU; returns False where it cannot."""
        if self._gpu_failed:
            return False
        try:
            self._draw(context, depsgraph)
        except Exception:  # from then on, the rasterizer renders
            traceback.print_exc()
            self._gpu, self._gpu_failed, self._layers = None, True, None
        return not self._gpu_failed

    def request_image(self, context: Any, depsgraph: Any) -> bool:
        """Request an image of the current view; whether it differs from the last one requested."""
        region = context.region
        if not self._update_layers(context, depsgraph):
            self.renderer.error, self.renderer.image = self.error, None
            return False
        camera = viewport_camera(context.region_data, region.width, region.height)
        # Posed again for another camera where highlights depend on it.
        assert self._layers is not None
        seen_from = (
            camera.position.tobytes() if any(layer.relit for layer in self._layers) else b"anywhere"
        )
        if seen_from != self._posed_for:
            self._posed, self._posed_for = (
                [layer.posed(camera.position) for layer in self._layers],
                seen_from,
            )
        if not self.renderer.is_busy():
            self._rasterizer.update()
        return self.renderer.request(
            RenderRequest(self._posed, camera, scene_background(depsgraph.scene))
        )

    def _update_layers(self, context: Any, depsgraph: Any) -> bool:
        """Read the scene if it has changed; returns False, and sets `error`, where that fails."""
        lighting = settings_values(depsgraph.scene)
        if self._layers is None or lighting != self._lighting:
            self._lighting = lighting
            try:
                self._layers = visible_layers(depsgraph, self._cache, context.space_data)
            except StgaError as error:
                self.error = str(error)
                return False
            self._posed, self._posed_for, self.error = [], b"", ""
        return True

    def _draw(self, context: Any, depsgraph: Any) -> None:
        color = scene_background(depsgraph.scene)
        if color is not None:
            gpu.state.active_framebuffer_get().clear(color=(*color, 1.0))
        if (
            not is_drawn_by_engine(context)
            or not self._update_layers(context, depsgraph)
            or not self._layers
        ):
            return
        self._gpu = self._gpu or SplatRenderer()
        x, y, width, height = gpu.state.viewport_get()
        view, to_depth = region_view(context.region_data, width, height)
        self._gpu.draw(self._layers, view)
        self._gpu.composite((x, y), to_depth, srgb_background(depsgraph.scene))


def _render_request(client: RenderClient, request: RenderRequest, scale: float) -> np.ndarray:
    """(H, W, 4) float32 scene-linear RGBA, bottom row first; runs in the viewport's render
    thread."""
    image = client.compose(request.layers, request.camera.scaled(scale))
    return np.ascontiguousarray(combined(image.rgb, image.alpha, request.background)[::-1])
