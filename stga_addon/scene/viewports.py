"""3D viewports: where they look when a head is imported."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import Any

import bpy
from mathutils import Vector

from .arrays import evaluated_vertices
from .compat import enable_nodes
from .objects import COLLECTIONS, show_kind
from .timeline import set_frames_per_second

DISTANCE = 2.2
"""From the viewport's eye to the head's center, in radii of the sphere around its bounding box."""


def frame_head(head: Any, camera: Any, screens: Iterable[Any]) -> None:
    """Let the 3D viewports look at the head from the side of `camera`, or from the front where it is None.

    They stay free to orbit. A viewport that looks through a camera stays so.
    The dashed lines from cameras and bones to their parent are hidden.
    """
    matrix = head.matrix_world
    corners = [matrix @ Vector(corner) for corner in _bounds(evaluated_vertices(head))]
    center, radius = (corners[0] + corners[1]) / 2, (corners[1] - corners[0]).length / 2
    for space in _viewports(screens):
        space.overlay.show_relationship_lines = False
        region = space.region_3d
        if region.view_perspective == "CAMERA":
            continue
        region.view_perspective = "PERSP"
        # Without a turn, a camera looks along -z with +y up: at the front of FLAME's heads.
        region.view_rotation = (camera or head).matrix_world.to_quaternion()
        region.view_location, region.view_distance = center, DISTANCE * radius


def frame_alone(head: Any, scene: Any, frames_per_second: float) -> None:
    """Prepare a scene with one capture to be opened: bones and cameras hidden, every viewport on the head.

    The world is white, the background of captures without one of their own.
    """
    set_frames_per_second(scene, frames_per_second)
    scene.world = bpy.data.worlds.new("World")
    enable_nodes(scene.world).nodes["Background"].inputs["Color"].default_value = (1, 1, 1, 1)
    for kind in COLLECTIONS:
        show_kind(head.parent, kind, scene.view_layers[0], False)
    frame_head(head, scene.camera, bpy.data.screens)


def open_sidebar(tab: str, screens: Iterable[Any]) -> bool:
    """Open the sidebar of the 3D viewports at a tab; whether they show it.

    Blender knows a sidebar's tabs only once it was drawn: call it again until it returns True.
    """
    is_shown = True
    for screen in screens:
        for area in screen.areas:
            if area.type == "VIEW_3D":
                area.spaces.active.show_region_ui = True
                sidebar = next(region for region in area.regions if region.type == "UI")
                with suppress(AttributeError, TypeError):  # not drawn yet
                    sidebar.active_panel_category = tab
                is_shown &= sidebar.active_panel_category == tab
    return is_shown


def _bounds(vertices: Any) -> tuple[Any, Any]:
    return vertices.min(0), vertices.max(0)


def _viewports(screens: Iterable[Any]) -> Iterator[Any]:
    """The spaces of the 3D viewports on these screens."""
    for screen in screens:
        for area in screen.areas:
            if area.type == "VIEW_3D":
                yield area.spaces.active
