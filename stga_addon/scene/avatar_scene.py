"""A capture's head, its cameras and its avatar in an empty scene."""

from pathlib import Path
from typing import Any

from ..avatar.file import Avatar
from ..capture.model import Capture
from ..export.ply import read_ply
from ..training.run.folder import WORLD_FILE
from . import tags
from .blend_file import current_scene
from .cameras import central, configure_scene, import_cameras
from .display.splat_object import hide_object, show_avatar, show_world_splats
from .objects import capture_root
from .rig.head import import_head
from .timeline import go_to_frame
from .viewports import frame_alone

WORLD_NAME = "World splats"


def set_up_head(capture: Capture) -> Any:
    """Bring the capture's head and cameras into the open file's empty scene; returns the head. Raises StgaError."""
    head = import_head(capture)
    model = capture.flame_file
    head[tags.FLAME_MODEL] = "" if model is None else str(model.resolve())  # so that Train works in the saved file
    cameras = import_cameras(capture, capture_root(capture.root))
    configure_scene(current_scene(), capture, central(cameras))
    return head


def show_on_head(avatar: Avatar, head: Any, link: str, fps: float) -> Any:
    """Show the avatar in place of the mesh, with every viewport on it; returns the splats.

    link: the avatar's file, relative to the .blend file; fps: frames per second at which the scene plays.
    """
    shown = show_avatar(avatar, head)
    shown[tags.AVATAR] = link
    hide_object(head, current_scene())
    go_to_frame(head[tags.TIMESTEPS][0])
    frame_alone(head, current_scene(), fps)
    return shown


def show_world(avatar_file: Path, head: Any) -> Any:
    """Show the splats of the world that lie beside an avatar file, where the head's capture stands: hidden until they
    are wanted. Returns them; None where there are none, or the scene has them already. Raises StgaError."""
    path = avatar_file.with_name(WORLD_FILE).resolve()
    if not path.is_file() or any(thing.get(tags.WORLD) == str(path) for thing in current_scene().objects):
        return None
    world = show_world_splats(read_ply(path), WORLD_NAME)
    world.parent = head.parent
    world.matrix_parent_inverse = head.matrix_parent_inverse
    world[tags.WORLD] = str(path)
    for layer in current_scene().view_layers:
        layer.update()  # which an object that was just made is not in yet
    hide_object(world, current_scene())
    return world
