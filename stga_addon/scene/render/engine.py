"""The render engine "STGA Splats": final images, animations and viewports that show splats exactly
as trained.

The GPU draws them, or, where it cannot, the training rasterizer. It renders splats and nothing
else; meshes are composited by its alpha and depth. Registering it imports no rasterizer: that
happens with the first image.
"""

import logging
import traceback
from collections.abc import Callable
from typing import Any

import bpy
import numpy as np
from bpy.app.handlers import persistent

from ...capture.camera import Camera
from ...errors import StgaError
from ...raster.posed_splats import ComposedImage
from ..cameras import render_camera
from ..gpu.context import has_gpu_context
from ..gpu.packing import View
from ..gpu.renderer import SplatRenderer
from ..gpu.shaders import MIN_ALPHA
from ..layers import SceneLayer
from .engine_viewport import EngineViewport, Rasterizer, redraw_when_rendered, stop_redraws
from .scene_splats import SplatCache, visible_layers
from .view_transform import combined, inverse_view, measure, needs_inverse, scene_background
from .viewport_display import ENGINE

BACKGROUND_DEPTH = 1e10  # meters: what Blender's engines write where a pixel shows nothing
VIEW_TRANSFORM_UNKNOWN = "The view transform could not be measured in time and changes the splats' colors; render again, or choose Standard"

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
            passes, message = (
                {},
                f"Unexpected error ({type(error).__name__}: {error}); see the console",
            )
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
            _rasterizer.update()
            image = _rasterizer.client.compose(
                [layer.posed(camera.position) for layer in layers], camera, with_depth=True
            )
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

    def _write_result(self, depsgraph: Any, passes: dict[str, np.ndarray]) -> None:
        """Hand the passes that the view layer has to Blender; those not given stay empty."""
        size = _border(depsgraph.scene.render, self.resolution_x, self.resolution_y)[2:]
        result = self.begin_result(0, 0, *size, layer=depsgraph.view_layer.name)
        for render_pass in result.layers[0].passes:
            if render_pass.name in passes:
                from_bottom = np.ascontiguousarray(passes[render_pass.name][::-1], np.float32)
                render_pass.rect.foreach_set(from_bottom.ravel())
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
    """A final image drawn by the GPU; None where this Blender has no GPU context, or not the
    memory."""
    if not has_gpu_context():
        return None
    try:
        renderer = SplatRenderer()
        renderer.draw(layers, View(camera))
        return renderer.read(with_depth=True)
    except Exception as error:  # of many kinds, by device and version
        logging.getLogger(__name__).info(
            "GPU rendering is not available (%s); the rasterizer renders", error
        )
        return None


def _border(render: Any, width: int, height: int) -> tuple[int, int, int, int]:
    """x, y, width and height in pixels of the render region, from the bottom left, rounded as
    Blender does."""
    if not render.use_border:
        return 0, 0, width, height
    left, right = (
        int(np.float32(edge) * np.float32(width))
        for edge in (render.border_min_x, render.border_max_x)
    )
    low, high = (
        int(np.float32(edge) * np.float32(height))
        for edge in (render.border_min_y, render.border_max_y)
    )
    return left, low, right - left, high - low


@persistent
def _before_render(*_: Any) -> None:
    """Measure the view transforms of all scenes that a render may ask this engine for; a compositor
    may ask for any."""
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
