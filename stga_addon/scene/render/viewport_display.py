"""GPU display: draws avatars that are *As Trained* in every 3D viewport, over what Blender has
drawn."""

import traceback
from typing import Any

import bpy
import gpu
import numpy as np
from bpy.app.handlers import persistent

from ...errors import StgaError
from .. import tags
from ..cameras import viewport_camera
from ..display import splat_nodes
from ..display.splat_nodes import AS_TRAINED, POINTS
from ..display.splat_object import display_mode, set_input
from ..gpu.buffers import EXACT
from ..gpu.context import is_software
from ..gpu.front_bones import NO_BONES, front_bones
from ..gpu.packing import NEAR_M, View
from ..gpu.renderer import COMPACT, CompositeTarget, SplatRenderer
from ..gpu.trial import WrongPicture
from .scene_splats import SplatCache, native_layers, visible_layers
from .view_transform import keeps_colors, srgb, world_color

ENGINE = "STGA_SPLATS"  # the render engine, which draws all splats in *Rendered* mode
POINTS_INTERVAL_S = 1.0


class GpuDisplay:
    """What the display keeps between redraws of all viewports. problem: one sentence, why nothing
    or something else is shown; failed: this device cannot draw, and points are shown."""

    def __init__(self) -> None:
        self._handlers: list[Any] = []
        self._scene_target: Any = None
        self._renderer: SplatRenderer | None = None
        self.cache = SplatCache()
        self.problem = ""
        self.failed = False

    def start(self) -> None:
        """Draw from now on; without a window there is nothing to draw in."""
        if not self._handlers and not bpy.app.background:
            add = bpy.types.SpaceView3D.draw_handler_add
            self._handlers = [add(self._before, (), "WINDOW", "PRE_VIEW")]
            self._handlers.append(add(self._draw, (), "WINDOW", "POST_VIEW"))

    def stop(self) -> None:
        """Remove the handlers, and free textures and shaders."""
        for handler in self._handlers:
            bpy.types.SpaceView3D.draw_handler_remove(handler, "WINDOW")
        self._handlers = []
        self.forget()

    def forget(self) -> None:
        """Free what belongs to the open file."""
        self._renderer = None
        self._scene_target = None
        self.cache = SplatCache()
        self.problem = self.problem if self.failed else ""

    def _before(self) -> None:
        """Keep the framebuffer of the scene's colors, before that of the overlays is bound."""
        self._scene_target = gpu.state.active_framebuffer_get()

    def _draw(self) -> None:
        try:
            self._draw_region(bpy.context)
            self.problem = ""
        except StgaError as error:
            self.problem = str(error)
        except Exception as error:  # raised again at each redraw otherwise
            self.fail(error)
        finally:
            self._scene_target = None

    def fail(self, error: Exception) -> None:
        """Report once why nothing can be drawn, while that exception is handled, and show points in
        all viewports from then on."""
        reason = str(error)
        if not isinstance(error, WrongPicture):
            traceback.print_exc()
            reason = f"{type(error).__name__}: {error}"
        self.stop()
        self.problem = f"Splats cannot be drawn as trained here ({reason}); points are shown"
        self.failed = True
        print(f"STGA: {self.problem}")
        # while drawing, Blender's data cannot be changed
        bpy.app.timers.register(show_points, persistent=True)

    def _draw_region(self, context: Any) -> None:
        if is_drawn_by_engine(context):
            return
        # and nothing else, although its depth buffer has other displays of splats
        space = context.space_data
        everything = is_engine_view(context)
        layers = visible_layers(
            context.evaluated_depsgraph_get(),
            self.cache,
            space,
            lambda splat_object: everything or display_mode(splat_object) == AS_TRAINED,
        )
        if everything:  # else Blender draws native splats
            layers += native_layers(context.evaluated_depsgraph_get(), self.cache, space)
        if not layers:
            if self._renderer is not None and not any(
                is_displayed_as_trained(candidate) for candidate in bpy.data.objects
            ):
                self._renderer = None  # frees its textures
            return
        if self._renderer is None:
            # half the traffic on a card, but slow in software
            self._renderer = SplatRenderer(EXACT if is_software() else COMPACT, short_keys=True)
        x, y, width, height = gpu.state.viewport_get()
        view, to_depth = region_view(context.region_data, width, height)
        self._renderer.draw(layers, view)
        is_plain = space.shading.type in ("SOLID", "WIREFRAME") or keeps_colors(context.scene)
        bones = front_bones(space, context.region_data, width, height) if is_plain else NO_BONES
        background, has_background = expected_background(context)
        # Whether the depth buffer holds the scene: render engines leave it zero where overlays are
        # off, always in 4.3, at times in 5.2.
        has_depth = space.overlay.show_overlays or space.shading.type in ("SOLID", "WIREFRAME")
        self._renderer.composite(
            CompositeTarget(
                corner=(x, y),
                to_depth=to_depth,
                behind=background,
                test_depth=has_depth and not everything,
                bones=bones,
                scene=self._scene_target,
                has_background=has_background,
            )
        )


display = GpuDisplay()


def is_displayed_as_trained(candidate: Any) -> bool:
    """Whether the object is one of splats that are displayed as trained."""
    return tags.is_splats(candidate) and display_mode(candidate) == AS_TRAINED


def show_points() -> float | None:
    """Display as points what should be as trained, also what is added or opened later, and show
    that in place of the engine, in Material Preview."""
    for window in bpy.context.window_manager.windows:
        is_engine = window.scene.render.engine == ENGINE
        for area in window.screen.areas if is_engine else ():
            if area.type == "VIEW_3D" and area.spaces.active.shading.type == "RENDERED":
                area.spaces.active.shading.type = "MATERIAL"
    for candidate in bpy.data.objects:
        if candidate.library is None and is_displayed_as_trained(candidate):
            set_input(candidate, splat_nodes.DISPLAY, POINTS)
    return POINTS_INTERVAL_S if display.failed else None


def is_engine_view(context: Any) -> bool:
    """Whether the viewport is the render engine's, *Rendered* mode of STGA Splats."""
    return context.space_data.shading.type == "RENDERED" and context.scene.render.engine == ENGINE


def is_drawn_by_engine(context: Any) -> bool:
    """Whether the render engine draws the splats, below overlays: before the view transform. Where
    that would change colors, the display draws them, after it."""
    return is_engine_view(context) and keeps_colors(context.scene)


def region_view(region: Any, width: int, height: int) -> tuple[View, tuple[float, ...]]:
    """The view of a RegionView3D, and its `CompositeTarget.to_depth`."""
    camera = viewport_camera(region, width, height)
    matrix = np.array(region.window_matrix, np.float64)
    # A view that is not in perspective is drawn from this far behind Blender's camera.
    pose = np.linalg.inv(np.array(region.view_matrix, np.float64))
    back = float((camera.world_to_camera @ pose[:, 3])[2])
    a = matrix[2, 3]
    b = -matrix[2, 2]
    c = matrix[3, 3]
    d = -matrix[3, 2]
    near, far = (back + (a - c * end) / (d * end - b) for end in (-1.0, 1.0))
    planes = np.array(region.clip_planes, np.float64) if region.use_clip_planes else None
    to_depth = (a - b * back, b, c - d * back, d)
    return View(camera, max(NEAR_M, near), far if far > near else np.inf, planes), to_depth


def expected_background(context: Any) -> tuple[tuple[float, ...] | None, bool]:
    """sRGB color that the viewport shows behind everything, None where that is not one color; and
    whether it draws that itself. Splats are blended in sRGB, viewports blend linearly: soft edges
    are right over what is known to be behind them."""
    shading = context.space_data.shading
    scene = context.scene
    theme = context.preferences.themes[0].view_3d.space.gradients
    if shading.type in ("SOLID", "WIREFRAME"):
        source = shading.background_type
    elif shading.use_scene_world_render if shading.type == "RENDERED" else shading.use_scene_world:
        is_plain = keeps_colors(scene) and not scene.render.film_transparent
        color = world_color(scene) if is_plain else None
        return None if color is None else srgb(color), False
    else:
        source = "STUDIO" if shading.studiolight_background_alpha else "THEME"
    if source == "THEME":
        return None if theme.background_type == "RADIAL" else tuple(theme.high_gradient), True
    if source == "VIEWPORT":
        return srgb(shading.background_color), True
    if source == "WORLD":
        return srgb(scene.world.color) if scene.world else (0.0, 0.0, 0.0), True
    return None, True


@persistent
def _forget_file(*_: Any) -> None:
    display.forget()


@persistent
def _scene_changed(_: Any, depsgraph: Any) -> None:
    """Read again what was edited, and what throws shadows onto heads."""
    display.cache.scene_changed(depsgraph)


def _handlers() -> tuple[tuple[Any, Any], ...]:
    called = bpy.app.handlers
    changes = called.depsgraph_update_post, called.frame_change_post
    return (called.load_pre, _forget_file), *((those, _scene_changed) for those in changes)


def register() -> None:
    for called, handler in _handlers():
        called.append(handler)
    display.start()


def unregister() -> None:
    for called, handler in _handlers():
        called.remove(handler)
    display.failed = False
    display.stop()
