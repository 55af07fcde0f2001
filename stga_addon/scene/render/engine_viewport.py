"""A viewport of the render engine: drawn by the GPU, or, where that fails, an image of the rasterizer."""

import traceback
from functools import partial
from typing import Any

import bpy
import gpu
import numpy as np

from ...capture.camera import Camera
from ...errors import StgaError
from ...raster.posed_splats import PosedSplats
from ...render.client import RenderClient
from ..gpu.renderer import SplatRenderer
from ..layers import SceneLayer
from ..light.settings import settings_values
from .camera import viewport_camera
from .composite import combined, scene_background, srgb_background
from .rasterizer import Rasterizer
from .scene_splats import SplatCache, visible_layers
from .viewport import RenderRequest, ViewportImage, ViewportRenderer
from .viewport_display import is_drawn_by_engine, region_view


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
        """The scene has changed: pose the splats again, and read meshes again that were edited themselves."""
        self._layers = None
        self._cache.light.casters.forget()
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
        self._pose(camera)
        if not self.renderer.is_busy():
            self._rasterizer.update()
        return self.renderer.request(RenderRequest(self._posed, camera, scene_background(depsgraph.scene)))

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

    def _pose(self, camera: Camera) -> None:
        """Pose the layers for the rasterizer; again for another camera where highlights depend on it."""
        assert self._layers is not None
        seen_from = camera.position.tobytes() if any(layer.relit for layer in self._layers) else b"anywhere"
        if seen_from != self._posed_for:
            self._posed, self._posed_for = [layer.posed(camera.position) for layer in self._layers], seen_from

    def _draw(self, context: Any, depsgraph: Any) -> None:
        color = scene_background(depsgraph.scene)
        if color is not None:
            gpu.state.active_framebuffer_get().clear(color=(*color, 1.0))
        if not is_drawn_by_engine(context) or not self._update_layers(context, depsgraph) or not self._layers:
            return
        self._gpu = self._gpu or SplatRenderer()
        x, y, width, height = gpu.state.viewport_get()
        view, to_depth = region_view(context.region_data, width, height)
        self._gpu.draw(self._layers, view)
        self._gpu.composite((x, y), to_depth, srgb_background(depsgraph.scene))


def _render_request(client: RenderClient, request: RenderRequest, scale: float) -> np.ndarray:
    """(H, W, 4) float32 scene-linear RGBA, bottom row first; runs in the viewport's render thread."""
    image = client.compose(request.layers, request.camera.scaled(scale))
    return np.ascontiguousarray(combined(image.rgb, image.alpha, request.background)[::-1])
