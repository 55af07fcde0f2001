"""Runs inside a Blender with a window, started by test_display.py: shows splats in every shading
mode.

`blender --python display_script.py -- FOLDER`: reads FOLDER/avatar.npz, and packages that Blender
lacks from FOLDER/packages; writes pictures of the viewport, their views (views.npz) and what else
was seen (result.json).
"""

import contextlib
import io
import sys
from pathlib import Path

import bpy
import gpu
import numpy as np
from mathutils import Matrix

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).resolve().parents[2])]

import in_window  # noqa: E402
from in_window import in_viewport, seen, viewport  # noqa: E402

FOLDER = Path(in_window.ARGUMENTS[0])
sys.path.append(str(FOLDER / "packages"))

from stga_addon.avatar.file import read_avatar  # noqa: E402
from stga_addon.errors import StgaError  # noqa: E402
from stga_addon.scene import light as lighting  # noqa: E402
from stga_addon.scene.arrays import triangle_mesh  # noqa: E402
from stga_addon.scene.display import splat_nodes  # noqa: E402
from stga_addon.scene.display.splat_nodes import AS_TRAINED, POINTS  # noqa: E402
from stga_addon.scene.display.splat_object import display_mode, set_input, show_avatar  # noqa: E402
from stga_addon.scene.gpu.buffers import read_pixels  # noqa: E402
from stga_addon.scene.gpu.renderer import SplatRenderer  # noqa: E402
from stga_addon.scene.render import engine, viewport_display  # noqa: E402
from stga_addon.scene.render.view_transform import inverse_view  # noqa: E402
from stga_addon.scene.render.viewport_display import display, region_view  # noqa: E402

REGIONS_S = 0.3
"""Between two steps, for regions to get their places."""
seen["pictures"] = {}
views = {}


def no_python():
    raise StgaError("no training Python")


def set_up():
    """The avatar's head, hidden, at a turned and scaled place, and nothing else."""
    for candidate in list(bpy.data.objects):
        bpy.data.objects.remove(candidate)
    avatar = read_avatar(FOLDER / "avatar.npz")
    head = bpy.data.objects.new("head", triangle_mesh("head", avatar.neutral, avatar.faces))
    bpy.context.scene.collection.objects.link(head)
    head.matrix_world = Matrix(
        ((0.0, -1.2, 0.0, 0.01), (1.2, 0.0, 0.0, 0.0), (0.0, 0.0, 1.2, 0.02), (0.0, 0.0, 0.0, 1.0))
    )
    shown = show_avatar(avatar, head)
    head.hide_set(True)
    _, area, _ = viewport()
    space = area.spaces.active
    space.overlay.show_overlays = space.show_gizmo = space.show_region_ui = (
        space.show_region_toolbar
    ) = False
    space.show_region_header = space.show_region_tool_header = False
    space.shading.background_type = "VIEWPORT"
    space.shading.background_color = (0.2, 0.3, 0.4)
    bpy.context.scene.world = None
    view = space.region_3d
    view.view_perspective = "PERSP"
    view.view_distance = 0.6
    view.view_location = (0.0, 0.0, 0.02)
    view.view_rotation = (0.75, 0.6, 0.1, 0.2)
    bpy.context.view_layer.update()
    views["pose"] = np.array(shown.matrix_world, np.float64)
    return shown


def redraw(times=2):
    bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=times)


def picture(name):
    """A screenshot, where the viewport is in it, and its view."""
    redraw()
    in_window.picture(FOLDER / f"{name}.png")
    window, area, region = viewport()
    camera = region_view(area.spaces.active.region_3d, region.width, region.height)[0].camera
    views[name] = np.array(
        [camera.width, camera.height, camera.fl_x, camera.fl_y, camera.cx, camera.cy]
    )
    views[f"{name} pose"] = camera.world_to_camera
    seen["pictures"][name] = region.x, window.height - region.y - region.height
    seen["problem"] = display.problem


def pictures(shown):
    _, area, _ = viewport()
    space = area.spaces.active
    scene = bpy.context.scene
    for mode in ("SOLID", "WIREFRAME", "MATERIAL"):
        space.shading.type = mode
        picture(mode.lower())
    space.overlay.show_overlays = True
    picture("material with overlays")
    space.shading.type = "SOLID"
    space.overlay.show_overlays = False
    space.region_3d.view_perspective = "ORTHO"
    picture("orthographic")
    space.region_3d.view_perspective = "PERSP"
    scene.view_settings.view_transform = "Filmic"
    picture("filmic")
    scene.view_settings.view_transform = "AgX"
    space.shading.type = "MATERIAL"
    picture("material agx")
    scene.view_settings.view_transform = "Filmic"
    scene.render.engine = engine.ENGINE
    space.shading.type = "RENDERED"
    picture("engine filmic")
    set_input(shown, splat_nodes.DISPLAY, POINTS)
    space.overlay.show_overlays = True
    picture("engine filmic points")
    set_input(shown, splat_nodes.DISPLAY, AS_TRAINED)
    space.overlay.show_overlays = False
    scene.view_settings.view_transform = "Standard"
    picture("engine")
    scene.render.engine = "BLENDER_WORKBENCH"
    space.shading.type = "SOLID"
    shown.hide_set(True)
    picture("hidden")
    shown.hide_set(False)
    quad = bpy.data.meshes.new("quad")
    quad.from_pydata(
        [(-1, -1, 0.02), (1, -1, 0.02), (1, 1, 0.02), (-1, 1, 0.02)], [], [(0, 1, 2, 3)]
    )
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("quad", quad))
    picture("quad")
    parts_of_the_view(area)
    bpy.data.objects.remove(bpy.data.objects["quad"])


def bones_in_front(shown):
    """A bone behind the splats, drawn In Front, with the splats and without."""
    data = bpy.data.armatures.new("rig")
    rig = bpy.data.objects.new("rig", data)
    bpy.context.scene.collection.objects.link(rig)
    rig.show_in_front = True
    bpy.context.view_layer.objects.active = rig
    with in_viewport():
        bpy.ops.object.mode_set(mode="EDIT")
    bone = data.edit_bones.new("bone")
    bone.head = (0.0, 0.0, -0.04)
    bone.tail = (0.0, 0.0, 0.08)
    with in_viewport():
        bpy.ops.object.mode_set(mode="OBJECT")
    overlay = viewport()[1].spaces.active.overlay
    overlay.show_overlays = True
    overlay.show_floor = overlay.show_axis_x = overlay.show_axis_y = overlay.show_cursor = (
        overlay.show_text
    ) = False
    picture("bone and splats")
    shown.hide_set(True)
    picture("bone")
    shown.hide_set(False)
    overlay.show_overlays = False
    bpy.data.objects.remove(rig)


def shadows():
    """The shadow maps of a sun and a lamp as drawn, and these lights in the avatar's space."""
    lamps = []
    for kind, place, energy in (("SUN", (0.4, -0.6, 1.0), 2.0), ("POINT", (0.3, 0.2, 0.4), 5.0)):
        data = bpy.data.lights.new(kind, kind)
        data.energy = energy
        lamps.append(bpy.data.objects.new(kind, data))
        lamps[-1].location = place
        lamps[-1].rotation_euler = (0.4, 0.5, 0.0)
        bpy.context.scene.collection.objects.link(lamps[-1])
    settings = lighting.lighting_settings(bpy.context.scene)
    settings.mode = "scene"
    redraw()
    drawn = display._renderer
    (relit,) = (layer.relit for layer in drawn._layers)
    seen["lights"] = {
        light.kind: [*light.position, *light.direction] for light in relit.lighting.lights
    }
    np.save(FOLDER / "shadows.npy", read_pixels(drawn._relit[0].textures["shadows"], 1)[..., 0])
    settings.mode = "recorded"
    for lamp in lamps:
        bpy.data.objects.remove(lamp)


def parts_of_the_view(area):
    """Local view of the quad alone, and a clipping region of the world's x > 0."""
    quad = bpy.data.objects["quad"]
    for candidate in bpy.context.view_layer.objects:
        candidate.select_set(candidate == quad)
    bpy.context.view_layer.objects.active = quad
    with in_viewport():
        bpy.ops.view3d.localview(frame_selected=False)
    picture("local view")
    with in_viewport():
        bpy.ops.view3d.localview(frame_selected=False)
    quad.hide_set(True)
    view = area.spaces.active.region_3d
    view.clip_planes = [(1.0, 0.0, 0.0, 0.0)] + [(0.0, 0.0, 0.0, 1.0)] * 5
    view.use_clip_planes = True
    picture("clipped")
    view.use_clip_planes = False


def textures():
    """What the display holds on the GPU, besides shaders."""
    renderer = display._renderer
    projected = renderer._projected.values()
    return [*renderer._static_textures.values(), *projected, renderer._color, renderer._depth]


def freed(held):
    """Whether nobody else holds any of the textures: Blender frees one with its Python object."""
    return all(sys.getrefcount(held[index]) == 2 for index in range(len(held)))


def pictures_per_redraw():
    """How often one redraw of the only viewport draws: more often where a handler stayed."""
    count = 0
    draw = SplatRenderer.draw

    def counted(*arguments):
        nonlocal count
        count += 1
        draw(*arguments)

    SplatRenderer.draw = counted  # type: ignore[method-assign]
    redraw(1)
    SplatRenderer.draw = draw  # type: ignore[method-assign]
    return count


def memory(shown):
    """Textures while the display is off, while its object is gone, and after undo."""
    seen["drawn"] = [pictures_per_redraw()]
    held = textures()
    seen["freed"] = {"while drawn": freed(held)}
    set_input(shown, splat_nodes.DISPLAY, POINTS)
    redraw()
    seen["freed"]["off"] = freed(held)
    set_input(shown, splat_nodes.DISPLAY, AS_TRAINED)
    redraw()
    held = textures()
    name = shown.name
    with bpy.context.temp_override(window=viewport()[0]):
        bpy.ops.ed.undo_push(message="shown")
        bpy.data.objects.remove(shown)
        bpy.ops.ed.undo_push(message="removed")
        redraw()
        seen["freed"]["removed"] = freed(held)
        bpy.ops.ed.undo()
    seen["undone"] = name in bpy.data.objects
    seen["drawn"].append(pictures_per_redraw())
    picture("after undo")


def failure():
    """An error while drawing: reported once, the handler removed, points shown."""

    def broken(*_):
        raise MemoryError("out of memory")

    display._renderer.draw = broken
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        redraw(4)
    seen["reports"] = output.getvalue().count("out of memory; points") + output.getvalue().count(
        "MemoryError: out"
    )
    seen["failed"] = display.failed, not display._handlers, display.problem


def after_failure():
    """Off and on again; returns the textures that are held before another file is opened."""
    shown = bpy.data.objects["head splats"]
    viewport_display.unregister()
    viewport_display.register()
    set_input(shown, splat_nodes.DISPLAY, AS_TRAINED)
    seen["drawn"].append(pictures_per_redraw())
    held = textures()
    viewport_display.unregister()
    seen["freed"]["disabled"] = freed(held)
    seen["unregistered"] = not display._handlers, display._renderer is None
    seen["drawn without"] = pictures_per_redraw()
    viewport_display.register()
    redraw()
    held = textures()
    bpy.ops.wm.read_homefile(use_empty=True)
    seen["freed"]["loaded"] = freed(held)


def after_load():
    seen["after load"] = bool(display._handlers), display._renderer is None, display.problem
    set_up()
    seen["drawn"].append(pictures_per_redraw())


def start_render():
    """F12 in AgX in its own thread, whose view transform the main thread measures."""
    scene = bpy.context.scene
    scene.render.engine = engine.ENGINE
    scene.view_settings.view_transform = "AgX"
    scene.render.resolution_x = scene.render.resolution_y = 64
    scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(scene.camera)
    bpy.context.preferences.view.render_display_type = "NONE"
    bpy.app.handlers.render_complete.append(
        lambda *_: seen.update(rendered=inverse_view(scene) is not None)
    )
    with in_viewport():
        bpy.ops.render.render("INVOKE_DEFAULT")


def steps():
    with in_viewport():  # without a title bar: pixels of the window are those of the screenshot
        bpy.ops.wm.window_fullscreen_toggle()
    yield REGIONS_S
    viewport_display.register()
    engine.register(no_python)
    lighting.register()
    shown = set_up()
    yield REGIONS_S
    pictures(shown)
    bones_in_front(shown)
    shadows()
    memory(shown)
    with in_viewport():
        bpy.ops.screen.region_quadview()
    yield REGIONS_S
    picture("four views")
    with in_viewport():
        bpy.ops.screen.region_quadview()
    yield REGIONS_S
    failure()
    yield lambda: display_mode(bpy.data.objects["head splats"]) == POINTS
    after_failure()
    yield REGIONS_S
    after_load()
    yield REGIONS_S
    start_render()
    yield lambda: "rendered" in seen
    np.savez(FOLDER / "views.npz", **views)
    seen["device"] = gpu.platform.backend_type_get()


in_window.play(steps(), FOLDER / "result.json")
