"""The render engine "STGA Splats": final images, animations and viewports drawn by the training rasteriser.

It draws splats and nothing else; meshes are composited with its alpha and depth. Registering it imports nothing that
draws: that happens with the first image.
"""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any
from weakref import ref

import bpy
import numpy as np

from ...errors import StgaError
from ...raster.render_client import RenderClient
from ..compat import world_nodes
from ..display.colors import linear_to_srgb, srgb_to_linear
from .camera import render_camera, viewport_camera
from .scene_splats import SplatCache, visible_layers
from .viewport import Screen, Sketcher, Wish, painted

ENGINE = "STGA_SPLATS"
FAR_AWAY = 1e10  # metres: what Blender writes into the depth of pixels that show nothing
# Blender's panels that are for some engines only and make sense here, beside those that are for any.
PANELS = ("EEVEE_WORLD_PT_surface", "VIEWLAYER_PT_layer")

_painter = RenderClient(lambda: "")


class SplatsEngine(bpy.types.RenderEngine):  # type: ignore[misc]
    bl_idname = ENGINE
    bl_label = "STGA Splats"
    bl_use_eevee_viewport = True  # Material Preview stays EEVEE's

    # No __init__: its signature differs between Blender's versions. Made when a viewport is first drawn.
    _viewport: "Viewport | None" = None

    def update_render_passes(self, scene: Any = None, renderlayer: Any = None) -> None:
        self.register_pass(scene, renderlayer, "Combined", 4, "RGBA", "COLOR")
        if renderlayer.use_pass_z:
            self.register_pass(scene, renderlayer, "Depth", 1, "Z", "VALUE")

    def render(self, depsgraph: Any) -> None:
        try:
            self._render(depsgraph)
        except StgaError as error:
            self.report({"ERROR"}, str(error))  # what a script catches
            if not bpy.app.background:
                self.error_set(str(error))  # what stands where the image would be

    def _render(self, depsgraph: Any) -> None:
        scene, size = depsgraph.scene, (self.resolution_x, self.resolution_y)
        border = _border(scene.render, *size)
        thing = scene.camera.evaluated_get(depsgraph) if scene.camera else None
        camera = render_camera(thing, depsgraph, *size, border)
        layers = visible_layers(depsgraph, SplatCache())
        self.update_stats("", f"{sum(len(layer.splats) for layer in layers)} splats")
        picture = _painter.compose(layers, camera, with_depth=True)
        result = self.begin_result(0, 0, *border[2:], layer=depsgraph.view_layer.name)
        passes = result.layers[0].passes
        _write(passes["Combined"], combined(picture.rgb, picture.alpha, _behind(scene)))
        if "Depth" in passes:
            assert picture.depth is not None
            shown = picture.alpha >= max(depsgraph.view_layer.pass_alpha_threshold, 1 / 255)
            _write(passes["Depth"], np.where(shown, picture.depth, FAR_AWAY)[..., None])
        self.end_result(result)

    def view_update(self, context: Any, depsgraph: Any) -> None:
        self._seen().update(depsgraph)

    def view_draw(self, context: Any, depsgraph: Any) -> None:
        seen, region = self._seen(), context.region
        seen.draw(context, depsgraph)
        self.update_stats("", seen.sketcher.error)
        if seen.sketcher.picture is not None:
            self.bind_display_space_shader(depsgraph.scene)
            seen.screen.draw(seen.sketcher.picture, region.width, region.height)
            self.unbind_display_space_shader()

    def _seen(self) -> "Viewport":
        if self._viewport is None:
            self._viewport = Viewport(self)
        return self._viewport


class Viewport:
    """What one viewport of the engine remembers."""

    def __init__(self, engine: SplatsEngine) -> None:
        # Weakly, or what is on the GPU would be freed by the garbage collector, in whatever thread that runs.
        self.sketcher = Sketcher(partial(painted, _painter, combined), partial(_redraw, ref(engine)))
        self.screen = Screen()
        self._stock = SplatCache()
        self._layers: list[Any] | None = None

    def update(self, depsgraph: Any) -> None:
        """Something in the scene has changed: pose again, and read again what was edited itself."""
        self._layers = None
        meshes = {update.id.original for update in depsgraph.updates if isinstance(update.id, bpy.types.Mesh)}
        self._stock.forget(meshes)

    def draw(self, context: Any, depsgraph: Any) -> None:
        """Ask for a picture of the view as it is now."""
        region, space = context.region, context.space_data
        if self._layers is None:
            try:
                self._layers = visible_layers(depsgraph, self._stock, space)
            except StgaError as error:
                self.sketcher.error, self.sketcher.picture = str(error), None
                return
        camera = viewport_camera(context.region_data, region.width, region.height)
        self.sketcher.ask(Wish(self._layers, camera, _behind(depsgraph.scene)))


def _redraw(engine: "ref[SplatsEngine]") -> None:
    living = engine()
    if living is not None:
        with suppress(ReferenceError):  # the viewport was closed meanwhile
            living.tag_redraw()


def combined(rgb: np.ndarray, alpha: np.ndarray, world: tuple[float, ...] | None) -> np.ndarray:
    """(H, W, 4) scene-linear RGBA, premultiplied, of display values `rgb` (3, H, W) on nothing and alpha (H, W).

    Splats are blended in display values. So what lies behind them is added before the conversion: `world`, scene-linear
    (3,). Where it is None the picture stays transparent, and the colour is converted as if it covered its pixel.
    """
    picture = np.empty((*alpha.shape, 4), np.float32)
    if world is None:
        straight = rgb.transpose(1, 2, 0) / np.maximum(alpha, np.finfo(np.float32).tiny)[..., None]
        picture[..., :3], picture[..., 3] = srgb_to_linear(straight) * alpha[..., None], alpha
    else:
        behind = linear_to_srgb(np.clip(np.array(world, np.float32), 0, 1))
        color = rgb.transpose(1, 2, 0) + (1 - alpha)[..., None] * behind
        picture[..., :3], picture[..., 3] = srgb_to_linear(np.clip(color, 0, 1)), 1
    return picture


def _behind(scene: Any) -> tuple[float, ...] | None:
    """Scene-linear colour behind the splats, None where the film is transparent.

    That of the world's Background node where it is plain, the world's own elsewhere, black without a world.
    """
    world = scene.world
    if scene.render.film_transparent:
        return None
    if world is None:
        return 0.0, 0.0, 0.0
    tree = world_nodes(world)
    output = tree.get_output_node("ALL") if tree else None
    links = output.inputs["Surface"].links if output else ()
    if links and links[0].from_node.type == "BACKGROUND":
        color, strength = (links[0].from_node.inputs[name] for name in ("Color", "Strength"))
        if not color.is_linked and not strength.is_linked:
            return tuple(channel * strength.default_value for channel in color.default_value[:3])
    return tuple(world.color)


def _border(render: Any, width: int, height: int) -> tuple[int, int, int, int]:
    """x, y, width and height in pixels of what is rendered, from the bottom left, cut as Blender cuts it."""
    if not render.use_border:
        return 0, 0, width, height
    left, right = (int(np.float32(edge) * np.float32(width)) for edge in (render.border_min_x, render.border_max_x))
    low, high = (int(np.float32(edge) * np.float32(height)) for edge in (render.border_min_y, render.border_max_y))
    return left, low, right - left, high - low


def _write(target: Any, values: np.ndarray) -> None:
    """Fill a render pass with (H, W, channels), top row first; Blender counts rows from the bottom."""
    target.rect.foreach_set(np.ascontiguousarray(values[::-1], np.float32).ravel())


def register(find_python: Callable[[], str]) -> None:
    """find_python as in `raster.painter.RenderClient`."""
    global _painter
    _painter = RenderClient(find_python)
    bpy.utils.register_class(SplatsEngine)
    for panel in _shared_panels():
        panel.COMPAT_ENGINES.add(ENGINE)


def unregister() -> None:
    for panel in bpy.types.Panel.__subclasses__():
        getattr(panel, "COMPAT_ENGINES", set()).discard(ENGINE)
    bpy.utils.unregister_class(SplatsEngine)
    _painter.close()


def _shared_panels() -> list[Any]:
    panels = [panel for panel in bpy.types.Panel.__subclasses__() if hasattr(panel, "COMPAT_ENGINES")]
    return [panel for panel in panels if "BLENDER_RENDER" in panel.COMPAT_ENGINES or panel.__name__ in PANELS]
