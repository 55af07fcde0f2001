"""The render engine "STGA Splats": final images, animations and viewports that show splats exactly as trained.

The GPU draws them, or, where it cannot, the training rasterizer. It renders splats and nothing else; meshes are
composited by its alpha and depth. Registering it imports no rasterizer: that happens with the first image.
"""

import logging
import traceback
from collections.abc import Callable
from functools import partial
from typing import Any

import bpy
import gpu
import numpy as np
from bpy.app.handlers import persistent

from ...capture.camera import Camera
from ...errors import StgaError
from ...raster.posed_splats import ComposedImage, PosedSplats
from ...render.client import RenderClient, missing_packages
from ..display.colors import linear_to_srgb, srgb_to_linear
from ..gpu.context import has_gpu_context
from ..gpu.packing import View
from ..gpu.renderer import SplatRenderer
from ..gpu.shaders import MIN_ALPHA
from ..gpu.viewport_display import ENGINE, is_drawn_by_engine, region_view, world_color
from ..layers import SceneLayer
from . import redraw
from .camera import render_camera, viewport_camera
from .scene_splats import SplatCache, visible_layers
from .view_transform import InverseView, inverse_view, measure, needs_inverse
from .viewport import RenderRequest, ViewportImage, ViewportRenderer

BACKGROUND_DEPTH = 1e10  # meters: what Blender's engines write where a pixel shows nothing
VIEW_TRANSFORM_UNKNOWN = (
    "The view transform could not be measured in time and changes the splats' colors; render again, or choose Standard"
)
# Blender's panels that are for some engines only and apply to this one too.
SHARED_PANELS = ("EEVEE_WORLD_PT_surface", "VIEWLAYER_PT_layer")


class RenderEnvironment:
    """The Python that renders where Blender's own cannot, and the device: looked up by the main thread, used by render
    threads.

    device  as `render.compose.Composer` takes it
    """

    def __init__(self, find: Callable[[], str], find_device: Callable[[], str]) -> None:
        self._find, self._find_device = find, find_device
        self._path = self._error = ""
        self.device = "auto"

    def update(self) -> None:
        """Look them up again; reads preferences, and files where another Python is needed."""
        self.device = self._find_device()
        if missing_packages():
            try:
                self._path, self._error = self._find(), ""
            except StgaError as error:
                self._error = str(error)

    def path(self) -> str:
        """As last looked up. Raises StgaError where there was none."""
        if self._error:
            raise StgaError(self._error)
        return self._path


_environment = RenderEnvironment(lambda: "", lambda: "auto")
_client = RenderClient(_environment.path, lambda: _environment.device)


class SplatsEngine(bpy.types.RenderEngine):  # type: ignore[misc]
    bl_idname = ENGINE
    bl_label = "STGA Splats"
    bl_use_eevee_viewport = True  # Material Preview stays EEVEE's
    bl_use_gpu_context = has_gpu_context()

    # No __init__: its signature differs between Blender's versions. Created when a viewport is first drawn.
    _viewport: "Viewport | None" = None

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
        except Exception as error:  # raised here, it would not stop Blender from saving an image without passes
            traceback.print_exc()
            passes, message = {}, f"Unexpected error ({type(error).__name__}: {error}); see the console"
        self._write_result(depsgraph, passes)
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
            _environment.update()
            image = _client.compose([layer.posed() for layer in layers], camera, with_depth=True)
            if _client.failure:
                self.report({"WARNING"}, _client.failure)
        view = inverse_view(scene)
        if view is None and needs_inverse(scene):
            self.report({"WARNING"}, VIEW_TRANSFORM_UNKNOWN)
        assert image.depth is not None
        covered = image.alpha >= max(depsgraph.view_layer.pass_alpha_threshold, MIN_ALPHA)
        return {
            "Combined": combined(image.rgb, image.alpha, _background(scene), view),
            "Depth": np.where(covered, image.depth, BACKGROUND_DEPTH)[..., None],
        }

    def _write_result(self, depsgraph: Any, passes: dict[str, np.ndarray]) -> None:
        """Hand the passes that the view layer has to Blender; those not given stay empty."""
        size = _border(depsgraph.scene.render, self.resolution_x, self.resolution_y)[2:]
        result = self.begin_result(0, 0, *size, layer=depsgraph.view_layer.name)
        for render_pass in result.layers[0].passes:
            if render_pass.name in passes:
                _write_pass(render_pass, passes[render_pass.name])
        self.end_result(result)

    def view_update(self, context: Any, depsgraph: Any) -> None:
        self._get_viewport().update(depsgraph)

    def view_draw(self, context: Any, depsgraph: Any) -> None:
        viewport, region = self._get_viewport(), context.region
        if viewport.draw(context, depsgraph):
            self.update_stats("", viewport.error)
            return
        renderer = viewport.renderer
        if viewport.request_image(context, depsgraph):
            redraw.redraw_when_rendered(renderer, self)
        self.update_stats("", renderer.error)
        if renderer.image is not None:
            self.bind_display_space_shader(depsgraph.scene)
            viewport.image.draw(renderer.image, region.width, region.height)
            self.unbind_display_space_shader()

    def _get_viewport(self) -> "Viewport":
        if self._viewport is None:
            self._viewport = Viewport()
        return self._viewport


class Viewport:
    """What one viewport of the engine keeps between redraws.

    Owned by its engine alone, so that the texture is freed with it, by the main thread.
    """

    def __init__(self) -> None:
        self.renderer = ViewportRenderer(partial(_render_request, _client))
        self.image = ViewportImage()
        self.error = ""
        self._gpu: SplatRenderer | None = None
        self._gpu_failed = False
        self._cache = SplatCache()
        self._layers: list[SceneLayer] | None = None
        self._posed: list[PosedSplats] = []

    def update(self, depsgraph: Any) -> None:
        """The scene has changed: pose the splats again, and read meshes again that were edited themselves."""
        self._layers = None
        self._cache.discard(
            {update.id.original for update in depsgraph.updates if isinstance(update.id, bpy.types.Mesh)}
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
        if not self.renderer.is_busy():
            _environment.update()
        return self.renderer.request(RenderRequest(self._posed, camera, _background(depsgraph.scene)))

    def _update_layers(self, context: Any, depsgraph: Any) -> bool:
        """Read the scene if it has changed; returns False, and sets `error`, where that fails."""
        if self._layers is None:
            try:
                self._layers = visible_layers(depsgraph, self._cache, context.space_data)
            except StgaError as error:
                self.error = str(error)
                return False
            self._posed = [layer.posed() for layer in self._layers] if self._gpu_failed else []
            self.error = ""
        return True

    def _draw(self, context: Any, depsgraph: Any) -> None:
        color = _background(depsgraph.scene)
        if color is not None:
            gpu.state.active_framebuffer_get().clear(color=(*color, 1.0))
        if not is_drawn_by_engine(context) or not self._update_layers(context, depsgraph) or not self._layers:
            return
        self._gpu = self._gpu or SplatRenderer()
        x, y, width, height = gpu.state.viewport_get()
        view, to_depth = region_view(context.region_data, width, height)
        self._gpu.draw(self._layers, view)
        self._gpu.composite((x, y), to_depth, srgb_background(depsgraph.scene))


def draw_image(layers: list[SceneLayer], camera: Camera) -> ComposedImage | None:
    """A final image drawn by the GPU; None where this Blender has no GPU context, or not the memory."""
    if not has_gpu_context():
        return None
    try:
        renderer = SplatRenderer()
        renderer.draw(layers, View(camera))
        return renderer.read(with_depth=True)
    except Exception as error:  # of many kinds, by device and version
        logging.getLogger(__name__).info("GPU rendering is not available (%s); the rasterizer renders", error)
        return None


def _render_request(client: RenderClient, request: RenderRequest, scale: float) -> np.ndarray:
    """(H, W, 4) float32 scene-linear RGBA, bottom row first; runs in the viewport's render thread."""
    image = client.compose(request.layers, request.camera.scaled(scale))
    return np.ascontiguousarray(combined(image.rgb, image.alpha, request.background)[::-1])


def combined(
    rgb: np.ndarray, alpha: np.ndarray, background: tuple[float, ...] | None, view: InverseView | None = None
) -> np.ndarray:
    """(H, W, 4) scene-linear RGBA, premultiplied, of splats rendered on black: sRGB rgb (3, H, W), alpha (H, W).

    Splats are blended in sRGB. So `background`, scene-linear (3,), is added as the sRGB that it is shown as, before the
    conversion. Where it is None the image stays transparent, and the color is converted as if it covered its pixel.
    view: the inverse of the view transform, None where that shows sRGB as it is.
    """
    to_linear = srgb_to_linear if view is None else view.to_linear
    image, covered = np.zeros((*alpha.shape, 4), np.float32), alpha > 0
    color, share = rgb[:, covered].T, alpha[covered][:, None]
    if background is None:
        image[covered, :3], image[..., 3] = to_linear(color / share) * share, alpha
    else:
        linear = np.array(background, np.float32)
        behind = linear_to_srgb(np.clip(linear, 0, 1)) if view is None else view.show(linear)
        image[...] = *background, 1
        image[covered, :3] = to_linear(np.clip(color + (1 - share) * behind, 0, 1))
    return image


def srgb_background(scene: Any) -> tuple[float, float, float] | None:
    """Color behind the splats as in `_background`, in sRGB 0…1."""
    linear = _background(scene)
    if linear is None:
        return None
    red, green, blue = linear_to_srgb(np.clip(np.array(linear, np.float64), 0, 1)).tolist()
    return red, green, blue


def _background(scene: Any) -> tuple[float, ...] | None:
    """Scene-linear color behind the splats, None where the film is transparent.

    From the world's Background node if its inputs are constants, else its viewport color; black without a world.
    """
    if scene.render.film_transparent:
        return None
    color = world_color(scene)
    return tuple(scene.world.color) if color is None else color


def _border(render: Any, width: int, height: int) -> tuple[int, int, int, int]:
    """x, y, width and height in pixels of the render region, from the bottom left, rounded as Blender does."""
    if not render.use_border:
        return 0, 0, width, height
    left, right = (int(np.float32(edge) * np.float32(width)) for edge in (render.border_min_x, render.border_max_x))
    low, high = (int(np.float32(edge) * np.float32(height)) for edge in (render.border_min_y, render.border_max_y))
    return left, low, right - left, high - low


def _write_pass(render_pass: Any, values: np.ndarray) -> None:
    """Fill a render pass with (H, W, channels), top row first; Blender's rows start at the bottom."""
    render_pass.rect.foreach_set(np.ascontiguousarray(values[::-1], np.float32).ravel())


@persistent
def _before_render(*_: Any) -> None:
    """Measure the view transforms of all scenes that a render may ask this engine for; a compositor may ask for any."""
    for scene in list(bpy.data.scenes):
        if scene.render.engine == ENGINE:
            measure(scene)


def register(find_python: Callable[[], str], find_device: Callable[[], str] = lambda: "auto") -> None:
    """find_python, find_device: as in `render.client.RenderClient`."""
    global _environment, _client
    _environment = RenderEnvironment(find_python, find_device)
    _client = RenderClient(_environment.path, lambda: _environment.device)
    bpy.utils.register_class(SplatsEngine)
    bpy.app.handlers.render_pre.append(_before_render)
    for panel in _shared_panels():
        panel.COMPAT_ENGINES.add(ENGINE)


def unregister() -> None:
    for panel in _panels_by_engine():
        panel.COMPAT_ENGINES.discard(ENGINE)
    bpy.app.handlers.render_pre.remove(_before_render)
    bpy.utils.unregister_class(SplatsEngine)
    redraw.stop()
    _client.close()


def _panels_by_engine() -> list[Any]:
    """The panels that list the engines they are for."""
    return [panel for panel in bpy.types.Panel.__subclasses__() if hasattr(panel, "COMPAT_ENGINES")]


def _shared_panels() -> list[Any]:
    return [
        panel
        for panel in _panels_by_engine()
        if "BLENDER_RENDER" in panel.COMPAT_ENGINES or panel.__name__ in SHARED_PANELS
    ]
