"""The render engine "STGA Splats": images and viewports of splats exactly as trained, with alpha
and depth for compositing. The GPU draws them, or, where it cannot, the training rasterizer."""

import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import cached_property, partial
from typing import Any, NamedTuple
from weakref import ref

import bpy
import gpu
import numpy as np
from bpy.app.handlers import persistent

from ...capture.camera import Camera
from ...errors import StgaError
from ...raster.posed_splats import ComposedImage, PosedSplats
from ...raster.splat_shader import MIN_ALPHA
from ...render.client import RenderClient, missing_packages
from ..cameras import Eye, render_camera, viewport_camera
from ..gpu.packing import View
from ..gpu.renderer import SplatRenderer, has_gpu_context
from ..layers import SceneLayer
from ..light import settings_values
from ..objects import Warn, log_warning
from .scene_splats import SplatCache, visible_layers
from .view_transform import combined, inverse_view, measure, needs_inverse, scene_background, srgb
from .viewport_display import ENGINE, is_drawn_by_engine, region_view

MAX_RENDER_TIME_S = 0.05
"""Time an image of a moving view may take; its resolution is adapted to that."""
# fractions of the viewport's width and height in pixels
INITIAL_SCALE = 0.5
MIN_SCALE = 1 / 8
POLL_INTERVAL_S = 1 / 60


class RenderRequest(NamedTuple):
    """A viewport image: splats, a camera of full size, and the scene-linear color behind, or
    None."""

    layers: Sequence[PosedSplats]
    camera: Camera
    background: tuple[float, ...] | None

    def key(self) -> tuple[Any, ...]:
        """Equal for requests that show the same layers (by identity) from the same camera."""
        *intrinsics, pose = (getattr(self.camera, each.name) for each in fields(Camera))
        return id(self.layers), *intrinsics, pose.tobytes(), self.background


class ViewportRenderer:
    """Renders the latest request in a thread, which touches nothing of Blender and ends with the
    image in full resolution. render: (request, scale of the camera's size) -> image (H, W, 4)
    float32. image: the last one, or None; error: why the last request failed, else empty."""

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
        if (thread := self._thread) is not None:
            thread.join()

    def is_busy(self) -> bool:
        return self._thread is not None

    def take_update(self) -> bool:
        """Whether `image` or `error` has changed since the last call."""
        with self._lock:
            had_update = self._has_update
            self._has_update = False
        return had_update

    def _run(self) -> None:
        request: RenderRequest | None = None
        scale = 0.0
        while True:
            with self._lock:
                last = request
                request = self._request
                if request is None or (request is last and scale == 1):
                    self._thread = None
                    return
                scale = 1.0 if request is last else self._moving_scale
            begin = time.perf_counter()
            try:
                self.image = self._render(request, scale)
                self.error = ""
            except Exception as error:  # shown in the viewport: it would end the thread unseen
                kind = "" if isinstance(error, StgaError) else f"{type(error).__name__}: "
                self.error = f"{kind}{error}"
                scale = 1.0
            elapsed_s = time.perf_counter() - begin
            if scale < 1 or elapsed_s < MAX_RENDER_TIME_S:
                factor = np.sqrt(MAX_RENDER_TIME_S / max(elapsed_s, 1e-3))
                self._moving_scale = float(np.clip(self._moving_scale * factor, MIN_SCALE, 1.0))
            with self._lock:
                self._has_update = True


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
    while _active:
        _active.popitem()[0].join()


def _poll() -> float | None:
    """Redraw what has changed; seconds until the next call, None once no thread runs."""
    for renderer, known in list(_active.items()):
        # before the update is taken, so that the last one is not missed
        is_busy = renderer.is_busy()
        engine = known()
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
    """A render client whose Python (`find_python`, which may raise StgaError) and device
    (`find_device`) the main thread looks up, for render threads."""

    def __init__(self, find_python: Callable[[], str], find_device: Callable[[], str]) -> None:
        self._find_python = find_python
        self._find_device = find_device
        self._python: str | StgaError = ""
        self._device = "auto"
        self.client = RenderClient(self.python, lambda: self._device)

    def update(self) -> None:
        """Look them up again; reads preferences, and files where another Python is needed."""
        self._device = self._find_device()
        if missing_packages():
            try:
                self._python = self._find_python()
            except StgaError as error:
                self._python = error

    def python(self) -> str:
        """As last looked up. Raises StgaError where there was none."""
        if isinstance(self._python, StgaError):
            raise self._python
        return self._python


class EngineViewport:
    """What one viewport of the engine keeps between redraws; its engine alone owns it, so that the
    main thread frees the texture."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        def render(request: RenderRequest, scale: float) -> np.ndarray:
            """Scene-linear RGBA, bottom row first; runs in a render thread."""
            image = rasterizer.client.compose(request.layers, request.camera.scaled(scale))
            return np.ascontiguousarray(combined(image.rgb, image.alpha, request.background)[::-1])

        self._rasterizer = rasterizer
        self.renderer = ViewportRenderer(render)
        self.error = ""
        self._uploaded: np.ndarray | None = None
        self._texture: Any = None
        self._gpu: SplatRenderer | None = None
        self._gpu_failed = False
        self._cache = SplatCache()
        self._layers: list[SceneLayer] | None = None
        self._posed: list[PosedSplats] = []
        self._posed_for = b""
        self._lighting: tuple[Any, ...] = ()

    def update(self, depsgraph: Any) -> None:
        """The scene has changed: pose the splats again, and read edited meshes again."""
        self._layers = None
        self._cache.scene_changed(depsgraph)

    def draw(self, context: Any, depsgraph: Any) -> bool:
        """Draw the current view with the GPU; returns False where it cannot."""
        if self._gpu_failed:
            return False
        try:
            color = scene_background(depsgraph.scene)
            if color is not None:
                gpu.state.active_framebuffer_get().clear(color=(*color, 1.0))
            is_read = is_drawn_by_engine(context) and self._update_layers(context, depsgraph)
            if is_read and self._layers:
                self._gpu = self._gpu or SplatRenderer()
                x, y, width, height = gpu.state.viewport_get()
                view, to_depth = region_view(context.region_data, width, height)
                self._gpu.draw(self._layers, view)
                self._gpu.composite((x, y), to_depth, None if color is None else srgb(color))
        except Exception:  # from then on, the rasterizer renders
            traceback.print_exc()
            self._gpu = None
            self._gpu_failed = True
            self._layers = None
        return not self._gpu_failed

    def request_image(self, context: Any, depsgraph: Any) -> bool:
        """Request an image of the current view; whether it differs from the last one requested."""
        region = context.region
        if not self._update_layers(context, depsgraph):
            self.renderer.error = self.error
            self.renderer.image = None
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
            self._posed = []
            self._posed_for = b""
            self.error = ""
        return True

    def draw_image(self, image: np.ndarray, width: int, height: int) -> None:
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


BACKGROUND_DEPTH = 1e10  # meters: what Blender's engines write where a pixel shows nothing
SHARED_PANELS = ("EEVEE_WORLD_PT_surface", "VIEWLAYER_PT_layer")  # for some engines, and this one

_rasterizer = Rasterizer(lambda: "", lambda: "auto")


class SplatsEngine(bpy.types.RenderEngine):  # type: ignore[misc]
    bl_idname = ENGINE
    bl_label = "STGA Splats"
    bl_use_eevee_viewport = True  # Material Preview stays EEVEE's
    bl_use_gpu_context = has_gpu_context()

    @cached_property  # no __init__: its signature differs between Blender's versions
    def _viewport(self) -> EngineViewport:
        return EngineViewport(_rasterizer)

    def update_render_passes(self, scene: Any = None, renderlayer: Any = None) -> None:
        self.register_pass(scene, renderlayer, "Combined", 4, "RGBA", "COLOR")
        if renderlayer.use_pass_z:
            self.register_pass(scene, renderlayer, "Depth", 1, "Z", "VALUE")

    def render(self, depsgraph: Any) -> None:
        # x, y, width, height in pixels of the render region, from below, rounded as by Blender
        message = ""
        border = (0, 0, self.resolution_x, self.resolution_y)
        r = depsgraph.scene.render
        if r.use_border:
            edges = [r.border_min_x, r.border_min_y, r.border_max_x, r.border_max_y]
            pixels = np.array(edges, np.float32) * np.array([*border[2:]] * 2, np.float32)
            left, low, right, high = pixels.astype(int).tolist()
            border = left, low, right - left, high - low
        # Passes that the view layer has, of each view; those not given stay empty.
        result = self.begin_result(0, 0, *border[2:], layer=depsgraph.view_layer.name)
        try:
            for view in result.views:
                passes = self._render(depsgraph, border, view.name)
                for name, values in passes.items():
                    render_pass = result.layers[0].passes.find_by_name(name, view.name)
                    if render_pass is not None:
                        from_bottom = np.ascontiguousarray(values[::-1], np.float32)
                        render_pass.rect.foreach_set(from_bottom.ravel())
        except Exception as error:  # raised, it would not stop Blender from saving an empty image
            message = str(error)
            if not isinstance(error, StgaError):
                traceback.print_exc()
                message = f"Unexpected error ({type(error).__name__}: {error}); see the console"
        self.end_result(result)
        if message:
            self.report({"ERROR"}, message)  # raised in scripts; nothing is saved
            if not bpy.app.background:
                self.error_set(message)  # shown in place of the image

    def _render(
        self, depsgraph: Any, border: tuple[int, int, int, int], view_name: str
    ) -> dict[str, np.ndarray]:
        """Values (H, W, channels) of each pass, top row first. view_name: of a stereo image, or
        empty."""
        scene = depsgraph.scene
        camera = self._camera(depsgraph, border, view_name)
        layers = visible_layers(depsgraph, SplatCache())
        self.update_stats("", f"{sum(len(layer.splats) for layer in layers)} splats")
        held_out = any(layer.holdout for layer in layers)
        shown = [layer.painted(0.0) if layer.holdout else layer for layer in layers]
        image = self._image(shown, camera)
        hidden = np.zeros_like(image.alpha)
        if held_out:  # white where splats are seen, black where holdouts hide them
            white = [layer.painted(0.0 if layer.holdout else 1.0) for layer in layers]
            hidden = np.clip(image.alpha - self._image(white, camera).rgb[0], 0, image.alpha)
        view = inverse_view(scene)
        if view is None and needs_inverse(scene):
            problem = "The view transform could not be measured in time and changes colors"
            self.report({"WARNING"}, f"{problem}; render again, or choose Standard")
        assert image.depth is not None
        threshold = max(depsgraph.view_layer.pass_alpha_threshold, MIN_ALPHA)
        covered = image.alpha - hidden >= threshold
        background = scene_background(scene)
        return {
            "Combined": combined(image.rgb, image.alpha, background, view, hidden),
            "Depth": np.where(covered, image.depth, BACKGROUND_DEPTH)[..., None],
        }

    def _camera(self, depsgraph: Any, border: tuple[int, int, int, int], view_name: str) -> Camera:
        """The scene's camera, or the eye of it, or the camera, that a view is seen by."""
        scene = depsgraph.scene
        eye = None
        camera = view_camera(scene, view_name)
        if camera is not None and view_name:
            self.active_view_set(view_name)
            pose = np.array(self.camera_model_matrix(camera), np.float64)
            eye = Eye(pose, self.camera_shift_x(camera))
        evaluated = camera.evaluated_get(depsgraph) if camera is not None else None
        size = self.resolution_x, self.resolution_y
        return render_camera(evaluated, depsgraph, *size, border, eye)

    def _image(self, layers: list[SceneLayer], camera: Camera) -> ComposedImage:
        image = draw_image(layers, camera, partial(self.report, {"WARNING"}))
        if image is None:
            _rasterizer.update()
            posed = [layer.posed(camera.position) for layer in layers]
            image = _rasterizer.client.compose(posed, camera, with_depth=True)
            if _rasterizer.client.failure:
                self.report({"WARNING"}, _rasterizer.client.failure)
        return image

    def view_update(self, context: Any, depsgraph: Any) -> None:
        self._viewport.update(depsgraph)

    def view_draw(self, context: Any, depsgraph: Any) -> None:
        viewport = self._viewport
        region = context.region
        renderer = viewport.renderer
        if viewport.draw(context, depsgraph):
            self.update_stats("", viewport.error)
            return
        if viewport.request_image(context, depsgraph):
            redraw_when_rendered(renderer, self)
        self.update_stats("", renderer.error)
        if renderer.image is not None:
            self.bind_display_space_shader(depsgraph.scene)
            viewport.draw_image(renderer.image, region.width, region.height)
            self.unbind_display_space_shader()


def view_camera(scene: Any, view_name: str) -> Any:
    """The camera of a view: the scene's, but with Multi-View that of its name with the view's
    suffix, where there is one; None without a camera."""
    camera = scene.camera
    views = scene.render.views
    if camera is None or not view_name or scene.render.views_format != "MULTIVIEW":
        return camera
    suffixes = [each.camera_suffix for each in views if camera.name.endswith(each.camera_suffix)]
    if not suffixes:
        return camera
    name = camera.name.removesuffix(suffixes[0]) + views[view_name].camera_suffix
    return scene.objects.get(name) or camera


_told: set[str] = set()
"""Why the GPU cannot draw, each sentence once in this process."""


def draw_image(
    layers: list[SceneLayer], camera: Camera, warn: Warn = log_warning
) -> ComposedImage | None:
    """A final image drawn by the GPU; None where Blender has no context of it, or the GPU fails,
    which is told once."""
    if not has_gpu_context():
        return None
    try:
        renderer = SplatRenderer()
        renderer.draw(layers, View(camera))
        return renderer.read()
    except Exception as error:  # of many kinds, by device and version
        reason = f"Splats are not drawn by Blender's GPU module ({error})"
        if reason not in _told:
            _told.add(reason)
            warn(reason)
        return None


@persistent
def _before_render(*_: Any) -> None:
    """Measure the view transforms of all scenes of this engine: a compositor may render any."""
    for scene in [scene for scene in bpy.data.scenes if scene.render.engine == ENGINE]:
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
