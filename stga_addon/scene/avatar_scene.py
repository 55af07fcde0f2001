"""A capture's head, cameras and avatar in a scene, and the viewports that look at them."""

from collections.abc import Iterable
from contextlib import suppress
from math import radians
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

from ..avatar.file import Avatar
from ..capture.model import Capture
from ..export.splat_files import read_splats
from ..training.run.folder import WORLD_FILE
from . import tags
from .arrays import evaluated_vertices
from .cameras import central, configure_scene, import_cameras
from .compat import enable_nodes
from .display.splat_object import hide_in_layers, hide_object, show_avatar, show_world_splats
from .objects import (
    COLLECTIONS,
    capture_root,
    go_to_frame,
    mover_of,
    set_frames_per_second,
    show_kind,
)
from .rig.head import import_head
from .rig.poses import bring_presets

DISTANCE = 2.2
"""Distance from the viewport's eye to the head's center, in radii of the sphere around its bounding
box."""

GAP_M = 0.1
"""Distance between neighboring heads."""


def frame_head(head: Any, camera: Any, screens: Iterable[Any]) -> None:
    """Turn 3D viewports to the head, in the direction of `camera` or, if None, from the front;
    viewports through a camera stay. All hide the dashed lines to parents."""
    matrix = head.matrix_world
    vertices = evaluated_vertices(head)
    low = matrix @ Vector(vertices.min(0))
    high = matrix @ Vector(vertices.max(0))
    center = (low + high) / 2
    radius = (high - low).length / 2
    for area in viewports(screens):
        space = area.spaces.active
        space.overlay.show_relationship_lines = False
        region = space.region_3d
        if region.view_perspective == "CAMERA":
            continue
        region.view_perspective = "PERSP"
        # Unrotated, a camera looks along -z with +y up: at the front of FLAME's heads.
        region.view_rotation = (camera or head).matrix_world.to_quaternion()
        region.view_location = center
        region.view_distance = DISTANCE * radius


def place_tracked(scene: Any, capture: Path, mesh: Any, before: Any) -> None:
    """Show the mesh of a head that is being tracked, in place of the one before; viewports look at
    the first one."""
    if before is not None:
        old = before.data
        before.data = mesh
        bpy.data.meshes.remove(old)
        return
    head = bpy.data.objects.new(mesh.name, mesh)
    tags.mark(head, tags.TRACKED_HEAD, capture)
    head.rotation_euler = (radians(90), 0, 0)
    scene.collection.objects.link(head)
    hide_default_cube(scene)
    windows = bpy.context.window_manager.windows
    frame_head(head, None, [each.screen for each in windows if each.scene == scene])


def hide_default_cube(scene: Any) -> None:
    """Hide the cube where it is as it came with Blender: 2 m wide, it would enclose a head."""
    cube = scene.objects.get("Cube")
    if cube is None or cube.library or cube.type != "MESH":
        return
    is_moved = cube.modifiers or cube.animation_data or not cube.matrix_world.is_identity
    is_whole = len(cube.data.vertices) == 8 and tuple(cube.dimensions) == (2.0, 2.0, 2.0)
    if is_whole and not is_moved:
        hide_in_layers(cube, scene)
        cube.hide_render = True


def place_beside(head: Any, others: Iterable[Any]) -> None:
    """Move a head with its capture to the right of others, as +X is in Blender's front view."""

    def sides(thing: Any) -> Any:
        world = np.array(thing.matrix_world)
        return evaluated_vertices(thing) @ world[0, :3] + world[0, 3]

    bpy.context.view_layer.update()
    gap = max(sides(each).max() for each in others) - sides(head).min() + GAP_M
    mover_of(head).location.x += gap
    bpy.context.view_layer.update()


def open_sidebar(tab: str, screens: Iterable[Any]) -> bool:
    """Open the viewports' sidebar at a tab; whether they show it: Blender knows a sidebar's tabs
    only once it was drawn, so call it until it returns True."""
    is_open = True
    for area in viewports(screens):
        area.spaces.active.show_region_ui = True
        sidebar = next(region for region in area.regions if region.type == "UI")
        with suppress(AttributeError, TypeError):  # not drawn yet
            sidebar.active_panel_category = tab
        is_open &= sidebar.active_panel_category == tab
    return is_open


def window_screens() -> list[Any]:
    """The screens of all windows."""
    return [window.screen for window in bpy.context.window_manager.windows]


def viewports(screens: Iterable[Any]) -> list[Any]:
    """3D viewports of the screens, as areas."""
    return [area for screen in screens for area in screen.areas if area.type == "VIEW_3D"]


WORLD_NAME = "World splats"


def set_up_head(capture: Capture) -> Any:
    """Import the capture's head and cameras into the empty scene; the head. Raises StgaError."""
    head = import_head(capture)
    bring_presets(head)
    model = capture.flame_file
    # so that Train works in the saved file
    head[tags.FLAME_MODEL] = "" if model is None else str(model.resolve())
    cameras = import_cameras(capture, capture_root(capture.root))
    configure_scene(bpy.context.scene, capture, central(cameras))
    return head


def show_on_head(avatar: Avatar, head: Any, link: str, fps: float) -> Any:
    """Show the avatar in place of the mesh, with every viewport on it and a white world; bones and
    cameras are hidden. Returns the splats. link: the avatar's file, relative to the .blend file."""
    splats = show_avatar(avatar, head)
    scene = bpy.context.scene
    head[tags.AVATAR] = link
    hide_object(head, scene)
    go_to_frame(head[tags.TIMESTEPS][0])
    set_frames_per_second(scene, fps)
    scene.world = bpy.data.worlds.new("World")
    enable_nodes(scene.world).nodes["Background"].inputs["Color"].default_value = (1, 1, 1, 1)
    for kind in COLLECTIONS:
        show_kind(head.parent, kind, scene.view_layers[0], False)
    frame_head(head, scene.camera, bpy.data.screens)
    return splats


def show_world(avatar_file: Path, head: Any, scene: Any = None) -> Any:
    """Show the splats of the world beside an avatar file, where the head stands, hidden until they
    are wanted, in a scene (None: the context's). Returns them; None where there are none, or the
    scene has them. Raises StgaError."""
    path = avatar_file.with_name(WORLD_FILE).resolve()
    scene = scene or bpy.context.scene
    worlds = [thing for thing in scene.objects if tags.WORLD in thing]
    if not path.is_file() or any(each[tags.WORLD] == str(path) for each in worlds):
        return None
    world = show_world_splats(read_splats(path), WORLD_NAME, scene)
    world.parent = head.parent
    world.matrix_parent_inverse = head.matrix_parent_inverse
    world[tags.WORLD] = str(path)
    world.hide_render = True
    for layer in scene.view_layers:
        layer.update()  # which an object that was just made is not in yet
    hide_in_layers(world, scene)
    return world
