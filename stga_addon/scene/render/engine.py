"""The render engine "STGA Splats": images and viewports of splats exactly as trained, with alpha
and depth for compositing. The GPU draws them, or, where it cannot, the training rasterizer."""

import traceback
from collections.abc import Callable
from functools import cached_property, partial
from typing import Any

import bpy
import gpu
import numpy as np
from bpy.app.handlers import persistent

from ...capture.camera import Camera
from ...errors import StgaError
from ...raster.posed_splats import ComposedImage, with_holdouts
from ...raster.splat_shader import MIN_ALPHA
from ...render.client import RenderClient, missing_packages
from ..cameras import Eye, render_camera
from ..gpu.context import has_gpu_context, is_software
from ..gpu.packing import NEAR_M, View, in_range
from ..gpu.renderer import CompositeTarget, SplatRenderer
from ..layers import SceneLayer
from ..light import settings_values
from ..objects import Warn, after_render, log_warning
from . import lens, motion_vectors
from .film_set import shows_set, update_set
from .lens import Sample
from .scene_splats import SplatCache, all_layers
from .view_transform import combined, inverse_view, measure, needs_inverse, scene_background, srgb
from .viewport_display import ENGINE, display, is_drawn_by_engine, region_view


class EngineViewport:
    """What one viewport of the engine keeps between redraws; its engine alone owns it, so that the
    main thread frees its textures. error: one sentence, why splats are not shown, or empty."""

    def __init__(self) -> None:
        self.error = ""
        self._renderer: SplatRenderer | None = None
        self._cache = SplatCache()
        self._layers: list[SceneLayer] | None = None
        self._lighting: tuple[Any, ...] = ()

    def update(self, depsgraph: Any) -> None:
        """The scene has changed: pose the splats again, and read edited meshes again."""
        self._layers = None
        self._cache.scene_changed(depsgraph)

    def draw(self, context: Any, depsgraph: Any) -> None:
        """Draw the current view; where the GPU cannot, all viewports show points from then on."""
        if display.failed:
            return
        try:
            self._draw(context, depsgraph)
        except StgaError as error:
            self.error = str(error)
        except Exception as error:  # of many kinds, by device and version
            self._renderer = None
            display.fail(error)

    def _draw(self, context: Any, depsgraph: Any) -> None:
        color = scene_background(depsgraph.scene)
        if color is not None:
            gpu.state.active_framebuffer_get().clear(color=(*color, 1.0))
        if not is_drawn_by_engine(context):
            return
        lighting = settings_values(depsgraph.scene)
        if self._layers is None or lighting != self._lighting:
            self._lighting = lighting
            self._layers = None
            self._layers = all_layers(depsgraph, self._cache, context.space_data)
        self.error = ""
        if self._layers:
            self._renderer = self._renderer or SplatRenderer()
            x, y, width, height = gpu.state.viewport_get()
            view, to_depth = region_view(context.region_data, width, height)
            self._renderer.draw(self._layers, view)
            behind = None if color is None else srgb(color)
            self._renderer.composite(CompositeTarget((x, y), to_depth, behind))


BACKGROUND_DEPTH = 1e10  # meters: what Blender's engines write where a pixel shows nothing
SHARED_PANELS = ("EEVEE_WORLD_PT_surface", "VIEWLAYER_PT_layer")  # for some engines, and this one

_rasterizer = RenderClient(lambda: "")


class SplatsEngine(bpy.types.RenderEngine):  # type: ignore[misc]
    bl_idname = ENGINE
    bl_label = "STGA Splats"
    bl_use_eevee_viewport = True  # Material Preview stays EEVEE's
    bl_use_gpu_context = has_gpu_context()

    @cached_property  # no __init__: its signature differs between Blender's versions
    def _viewport(self) -> EngineViewport:
        return EngineViewport()

    def update_render_passes(self, scene: Any = None, renderlayer: Any = None) -> None:
        self.register_pass(scene, renderlayer, "Combined", 4, "RGBA", "COLOR")
        if renderlayer.use_pass_z:
            self.register_pass(scene, renderlayer, "Depth", 1, "Z", "VALUE")
        if renderlayer.use_pass_vector:
            self.register_pass(scene, renderlayer, "Vector", 4, "XYZW", "VECTOR")

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
        self._warn_of_view_transform(scene)
        with_set = shows_set(scene)
        background = None if with_set else scene_background(scene)
        inverse = inverse_view(scene)
        cache = SplatCache()
        renderers = list[SplatRenderer]()  # freed here, in the thread of its GPU context
        frame = scene.frame_current + scene.frame_subframe
        offset = 0.0
        color = fraction = distance = np.zeros((), np.float32)
        passes = dict[str, np.ndarray]()
        asks_depth = depsgraph.view_layer.use_pass_z
        samples = lens.samples(scene, view_camera(scene, view_name))
        try:
            for taken, sample in enumerate(samples):
                if sample.offset != offset:
                    offset = sample.offset
                    self._go_to(frame + offset)
                    cache.frame_changed()
                layers = all_layers(depsgraph, cache)
                view = self._view(depsgraph, border, view_name, sample)
                draw = partial(self._image, view=view, renderers=renderers, with_depth=asks_depth)
                image = with_holdouts(layers, draw)
                hidden = np.zeros_like(image.alpha) if image.hidden is None else image.hidden
                color = color + combined(image.rgb, image.alpha, background, inverse, hidden)
                if asks_depth:
                    visible = image.alpha - hidden
                    fraction = fraction + visible
                    distance = distance + np.where(visible > 0, visible * image.depth, 0)
                self.update_stats("", f"{sum(len(layer.splats) for layer in layers)} splats")
                self.update_progress((taken + 1) / len(samples))
                if self.test_break():
                    break
            if depsgraph.view_layer.use_pass_vector:
                offset = -1.0
                place = partial(self._view, depsgraph, border, view_name, lens.SHARP)
                passes["Vector"] = self._motion(depsgraph, frame, place, cache, renderers)
        finally:
            if offset:
                self._go_to(frame)
        count = taken + 1
        passes["Combined"] = color / count if count > 1 else color
        if asks_depth:
            chosen = 0.0 if with_set else depsgraph.view_layer.pass_alpha_threshold
            covered = fraction / count >= max(chosen, MIN_ALPHA)
            depth = np.where(covered, distance / np.maximum(fraction, MIN_ALPHA), BACKGROUND_DEPTH)
            passes["Depth"] = depth[..., None]
        return passes

    def _motion(
        self,
        depsgraph: Any,
        frame: float,
        view_now: Callable[[], View],
        cache: SplatCache,
        renderers: list[SplatRenderer],
    ) -> np.ndarray:
        """(H, W, 4) pixels, right and up: previous minus current place, current minus next.
        view_now: of the frame that the scene is at."""
        places = []
        for offset in (-1.0, 1.0, 0.0):
            self._go_to(frame + offset)
            cache.frame_changed()
            layers = all_layers(depsgraph, cache)
            view = view_now()
            places.append(motion_vectors.pixel_centers(layers, view))
        before, after, now = places
        found = []
        for other in (before, after):
            painted, scale = motion_vectors.painted(layers, motion_vectors.moved(now, other))
            image = self._image(painted, view, renderers)
            found.append(motion_vectors.read_motion(image, scale, MIN_ALPHA))
        return np.concatenate([found[0], -found[1]], axis=2)

    def _go_to(self, frame: float) -> None:
        whole = int(np.floor(frame))
        self.frame_set(whole, frame - whole)

    def _warn_of_view_transform(self, scene: Any) -> None:
        if inverse_view(scene) is None and needs_inverse(scene):
            problem = "The view transform could not be measured in time and changes colors"
            self.report({"WARNING"}, f"{problem}; render again, or choose Standard")

    def _view(
        self, depsgraph: Any, border: tuple[int, int, int, int], view_name: str, sample: Sample
    ) -> View:
        """View of the scene's camera, of one of its eyes, or of the camera of a multiview's view,
        from a point of its aperture."""
        scene = depsgraph.scene
        eye = None
        camera = view_camera(scene, view_name)
        if camera is not None and view_name:
            self.active_view_set(view_name)
            pose = np.array(self.camera_model_matrix(camera), np.float64)
            eye = Eye(pose, self.camera_shift_x(camera))
        evaluated = camera.evaluated_get(depsgraph) if camera is not None else None
        size = self.resolution_x, self.resolution_y
        view = camera_view(render_camera(evaluated, depsgraph, *size, border, eye), evaluated)
        return lens.view_from(view, evaluated, sample.point)

    def _image(
        self,
        layers: list[SceneLayer],
        view: View,
        renderers: list[SplatRenderer],
        with_depth: bool = False,
    ) -> ComposedImage:
        """The layers' splats as a view shows them, drawn by Blender's GPU module if it is faster
        and does not fail, else by the rasterizer. with_depth: whether the rasterizer finds depths
        too, which the GPU module always does; renderers: as of `draw_image`."""
        image = None
        if not is_rasterizer_faster():
            image = draw_image(layers, view, partial(self.report, {"WARNING"}), renderers)
        if image is None:
            posed = [in_range(layer.posed(view.camera.position), view) for layer in layers]
            image = _rasterizer.compose(posed, view.camera, with_depth)
            if _rasterizer.failure:
                self.report({"WARNING"}, _rasterizer.failure)
        return image

    def view_update(self, context: Any, depsgraph: Any) -> None:
        self._viewport.update(depsgraph)

    def view_draw(self, context: Any, depsgraph: Any) -> None:
        self._viewport.draw(context, depsgraph)
        self.update_stats("", display.problem if display.failed else self._viewport.error)


def camera_view(camera: Camera, evaluated: Any) -> View:
    """A camera's view within the clip distances of an evaluated camera object."""
    data = evaluated.data
    return View(camera, max(NEAR_M, data.clip_start), data.clip_end)


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


_reported: set[str] = set()
"""Why the GPU cannot draw, each sentence once in this process."""


def is_rasterizer_faster() -> bool:
    """Whether this Python has the CPU's rasterizer, and it is faster than Blender's graphics: where
    the CPU computes these as well, it takes a third of their time."""
    return has_gpu_context() and is_software() and not missing_packages()


def draw_image(
    layers: list[SceneLayer],
    view: View,
    warn: Warn = log_warning,
    renderers: list[SplatRenderer] | None = None,
) -> ComposedImage | None:
    """A final image drawn by the GPU; None where Blender has no context of it, or the GPU fails,
    which is reported once. renderers: where one is kept for the next image."""
    if not has_gpu_context():
        return None
    kept = [] if renderers is None else renderers
    try:
        if not kept:
            kept.append(SplatRenderer())
        kept[0].draw(layers, view)
        return kept[0].read()
    except Exception as error:  # of many kinds, by device and version
        reason = f"Splats are not drawn by Blender's GPU module ({error})"
        if reason not in _reported:
            _reported.add(reason)
            warn(reason)
        return None


@persistent
def _before_render(*_: Any) -> None:
    """Measure the view transforms of all scenes of this engine, and bring their sets up to date: a
    compositor may render any."""
    for scene in [scene for scene in bpy.data.scenes if scene.render.engine == ENGINE]:
        measure(scene)
        update_set(scene)


def register(
    find_python: Callable[[], str], find_device: Callable[[], str] = lambda: "auto"
) -> None:
    """find_python, find_device: as in `RenderClient`."""
    global _rasterizer, _is_wanted

    def device() -> str:
        chosen = find_device()
        # to look for another GPU takes longer than an image
        return "cpu" if chosen == "auto" and is_rasterizer_faster() else chosen

    _rasterizer = RenderClient(find_python, device)
    _is_wanted = True
    after_render(_settle)
    bpy.app.handlers.render_pre.append(_before_render)
    for panel in _panels_by_engine():
        if "BLENDER_RENDER" in panel.COMPAT_ENGINES or panel.__name__ in SHARED_PANELS:
            panel.COMPAT_ENGINES.add(ENGINE)


def unregister() -> None:
    global _is_wanted
    for panel in _panels_by_engine():
        panel.COMPAT_ENGINES.discard(ENGINE)
    bpy.app.handlers.render_pre.remove(_before_render)
    _is_wanted = False
    after_render(_settle)


_is_wanted = False


def _settle() -> None:
    """Register the engine, or end it, as was last asked for. Not while Blender renders: it hangs
    for ever where the engine of a render is unregistered, or replaced by that of an update."""
    if _is_wanted and not SplatsEngine.is_registered:
        bpy.utils.register_class(SplatsEngine)
    elif not _is_wanted:
        if SplatsEngine.is_registered:  # else an update has replaced it
            bpy.utils.unregister_class(SplatsEngine)
        _rasterizer.close()


def _panels_by_engine() -> list[Any]:
    """The panels that list the engines they are for."""
    return [panel for panel in bpy.types.Panel.__subclasses__() if hasattr(panel, "COMPAT_ENGINES")]
