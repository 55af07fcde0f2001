"""The render engine "STGA Splats": final images, animations and viewports that show splats exactly
as trained.

The GPU draws them, or, where it cannot, the training rasterizer. It renders splats and nothing
else; meshes are composited by its alpha and depth. Registering it imports no rasterizer: that
happens with the first image.
"""

import logging
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any
from weakref import ref

import bpy
import gpu
import numpy as np
from bpy.app.handlers import persistent

from ...capture.camera import Camera
from ...errors import StgaError
from ...raster.posed_splats import ComposedImage, PosedSplats
from ...render.client import RenderClient, missing_packages
from ..cameras import render_camera, viewport_camera
from ..gpu.packing import View
from ..gpu.renderer import SplatRenderer, has_gpu_context
from ..gpu.shaders import MIN_ALPHA
from ..layers import SceneLayer
from ..light import settings_values
from .scene_splats import SplatCache, visible_layers
from .view_transform import (
    combined,
    inverse_view,
    measure,
    needs_inverse,
    scene_background,
    srgb_background,
)
from .viewport_display import ENGINE, is_drawn_by_engine, region_view

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
        *intrinsics, pose = (getattr(self.camera, each.name) for each in fields(Camera))
        return id(self.layers), *intrinsics, pose.tobytes(), self.background


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
        """Render this next, instead of what was requested; False if it is the same."""
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
        while True:
            with self._lock:
                last, request = request, self._request
                if request is None or (request is last and scale == 1):
                    self._thread = None
                    return
                scale = 1.0 if request is last else self._moving_scale
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
"""Renderers whose threads run, and engines, which Blender frees with their viewports."""


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
    """Redraw what has changed; seconds until the next call, None once no thread runs."""
    for renderer, known in list(_active.items()):
        # before the update is taken, so that the last one is not missed
        is_busy, engine = renderer.is_busy(), known()
        try:
            if engine is not None and renderer.take_update():
                engine.tag_redraw()
        except ReferenceError:  # Blender has freed its part of the engine
            engine = None
        if engine is None:
            renderer.cancel()
        if engine is None or not is_busy:
            del _active[renderer]
    return POLL_INTERVAL_S if _active else None


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
        """The scene has changed: pose the splats again, and read edited meshes again."""
        self._layers = None
        self._cache.light.forget_casters()
        changed = (update.id for update in depsgraph.updates)
        self._cache.discard({each.original for each in changed if isinstance(each, bpy.types.Mesh)})

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
        is_lit = any(layer.relit for layer in self._layers)
        seen_from = camera.position.tobytes() if is_lit else b"anywhere"
        if seen_from != self._posed_for:
            self._posed = [layer.posed(camera.position) for layer in self._layers]
            self._posed_for = seen_from
        if not self.renderer.is_busy():
            self._rasterizer.update()
        background = scene_background(depsgraph.scene)
        return self.renderer.request(RenderRequest(self._posed, camera, background))

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
        if not is_drawn_by_engine(context) or not self._update_layers(context, depsgraph):
            return
        if not self._layers:
            return
        self._gpu = self._gpu or SplatRenderer()
        x, y, width, height = gpu.state.viewport_get()
        view, to_depth = region_view(context.region_data, width, height)
        self._gpu.draw(self._layers, view)
        self._gpu.composite((x, y), to_depth, srgb_background(depsgraph.scene))


def _render_request(client: RenderClient, request: RenderRequest, scale: float) -> np.ndarray:
    """(H, W, 4) float32 scene-linear RGBA, bottom row first; runs in a render thread."""
    image = client.compose(request.layers, request.camera.scaled(scale))
    return np.ascontiguousarray(combined(image.rgb, image.alpha, request.background)[::-1])


BACKGROUND_DEPTH = 1e10  # meters: what Blender's engines write where a pixel shows nothing
VIEW_TRANSFORM_UNKNOWN = (
    "The view transform could not be measured in time and changes the splats' colors; "
    "render again, or choose Standard"
)

_rasterizer = Rasterizer(lambda: "", lambda: "auto")

# Those that are for some engines only and apply to this one too.
SHARED_PANELS = ("EEVEE_WORLD_PT_surface", "VIEWLAYER_PT_layer")


class SplatsEngine(bpy.types.RenderEngine):  # type: ignore[misc]
    bl_idname = ENGINE
    bl_label = "STGA Splats"
    bl_use_eevee_viewport = True  # Material Preview stays EEVEE's
    bl_use_gpu_context = has_gpu_context()

    # No __init__: its signature differs between Blender's versions. Created when a viewport is
    # first drawn.
    _viewport: EngineViewport | None = None

    def update_render_passes(self, scene: Any = None, renderlayer: Any = None) -> None:
        self.register_pass(scene, renderlayer, "Combined", 4, "RGBA", "COLOR")
        if renderlayer.use_pass_z:
            self.register_pass(scene, renderlayer, "Depth", 1, "Z", "VALUE")

    def render(self, depsgraph: Any) -> None:
        message = ""
        try:
            passes = self._render(depsgraph)
        except StgaError as error:
            passes, message = {}, str(error)
        # raised here, it would not stop Blender from saving an image without passes
        except Exception as error:
            traceback.print_exc()
            reason = f"{type(error).__name__}: {error}"
            passes, message = {}, f"Unexpected error ({reason}); see the console"
        # Those that the view layer has; those not given stay empty.
        size = _border(depsgraph.scene.render, self.resolution_x, self.resolution_y)[2:]
        result = self.begin_result(0, 0, *size, layer=depsgraph.view_layer.name)
        for render_pass in result.layers[0].passes:
            if render_pass.name in passes:
                from_bottom = np.ascontiguousarray(passes[render_pass.name][::-1], np.float32)
                render_pass.rect.foreach_set(from_bottom.ravel())
        self.end_result(result)
        if message:
            self.report({"ERROR"}, message)  # raised in scripts; nothing is saved
            if not bpy.app.background:
                self.error_set(message)  # shown in place of the image

    def _render(self, depsgraph: Any) -> dict[str, np.ndarray]:
        """Values (H, W, channels) of each pass, top row first."""
        scene, size = depsgraph.scene, (self.resolution_x, self.resolution_y)
        border = _border(scene.render, *size)
        camera_object = scene.camera.evaluated_get(depsgraph) if scene.camera else None
        camera = render_camera(camera_object, depsgraph, *size, border)
        layers = visible_layers(depsgraph, SplatCache())
        self.update_stats("", f"{sum(len(layer.splats) for layer in layers)} splats")
        image = draw_image(layers, camera)
        if image is None:
            _rasterizer.update()
            posed = [layer.posed(camera.position) for layer in layers]
            image = _rasterizer.client.compose(posed, camera, with_depth=True)
            if _rasterizer.client.failure:
                self.report({"WARNING"}, _rasterizer.client.failure)
        view = inverse_view(scene)
        if view is None and needs_inverse(scene):
            self.report({"WARNING"}, VIEW_TRANSFORM_UNKNOWN)
        assert image.depth is not None
        covered = image.alpha >= max(depsgraph.view_layer.pass_alpha_threshold, MIN_ALPHA)
        return {
            "Combined": combined(image.rgb, image.alpha, scene_background(scene), view),
            "Depth": np.where(covered, image.depth, BACKGROUND_DEPTH)[..., None],
        }

    def view_update(self, context: Any, depsgraph: Any) -> None:
        self._get_viewport().update(depsgraph)

    def view_draw(self, context: Any, depsgraph: Any) -> None:
        viewport, region = self._get_viewport(), context.region
        if viewport.draw(context, depsgraph):
            self.update_stats("", viewport.error)
            return
        renderer = viewport.renderer
        if viewport.request_image(context, depsgraph):
            redraw_when_rendered(renderer, self)
        self.update_stats("", renderer.error)
        if renderer.image is not None:
            self.bind_display_space_shader(depsgraph.scene)
            viewport.image.draw(renderer.image, region.width, region.height)
            self.unbind_display_space_shader()

    def _get_viewport(self) -> EngineViewport:
        if self._viewport is None:
            self._viewport = EngineViewport(_rasterizer)
        return self._viewport


def draw_image(layers: list[SceneLayer], camera: Camera) -> ComposedImage | None:
    """A final image drawn by the GPU; None without a GPU context, or its memory."""
    if not has_gpu_context():
        return None
    try:
        renderer = SplatRenderer()
        renderer.draw(layers, View(camera))
        return renderer.read(with_depth=True)
    except Exception as error:  # of many kinds, by device and version
        logging.getLogger(__name__).info("No GPU rendering (%s); the rasterizer renders", error)
        return None


def _border(render: Any, width: int, height: int) -> tuple[int, int, int, int]:
    """x, y, width, height in pixels of the render region, from below, rounded as Blender does."""
    if not render.use_border:
        return 0, 0, width, height
    edges = render.border_min_x, render.border_min_y, render.border_max_x, render.border_max_y
    sizes = np.array([width, height] * 2, np.float32)
    left, low, right, high = (np.array(edges, np.float32) * sizes).astype(int).tolist()
    return left, low, right - left, high - low


@persistent
def _before_render(*_: Any) -> None:
    """Measure the view transforms of all scenes of this engine: a compositor may render any."""
    for scene in list(bpy.data.scenes):
        if scene.render.engine == ENGINE:
            measure(scene)


def register(
    find_python: Callable[[], str], find_device: Callable[[], str] = lambda: "auto"
) -> None:
    """find_python, find_device: as in `Rasterizer`."""
    global _rasterizer
    _rasterizer = Rasterizer(find_python, find_device)
    bpy.utils.register_class(SplatsEngine)
    bpy.app.handlers.render_pre.append(_before_render)
    for panel in _panels_by_engine():
        if "BLENDER_RENDER" in panel.COMPAT_ENGINES or panel.__name__ in SHARED_PANELS:
            panel.COMPAT_ENGINES.add(ENGINE)


def unregister() -> None:
    for panel in _panels_by_engine():
        panel.COMPAT_ENGINES.discard(ENGINE)
    bpy.app.handlers.render_pre.remove(_before_render)
    bpy.utils.unregister_class(SplatsEngine)
    stop_redraws()
    _rasterizer.client.close()


def _panels_by_engine() -> list[Any]:
    """The panels that list the engines they are for."""
    return [panel for panel in bpy.types.Panel.__subclasses__() if hasattr(panel, "COMPAT_ENGINES")]
