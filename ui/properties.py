"""What the panel's steps remember between clicks; saved with the .blend."""

from typing import Any

import bpy

from ..operators import ids
from ..operators.common import register_classes, unregister_classes
from ..stga_addon.scene import tags
from ..stga_addon.scene.compat import PATH_OPTIONS


def _is_head(self: Any, thing: Any) -> bool:
    return thing.get(tags.KIND) == tags.HEAD


def _is_splats(self: Any, thing: Any) -> bool:
    return thing.get(tags.KIND) == tags.SPLATS


class Settings(bpy.types.PropertyGroup):
    """One per scene; operators read what the scene works on, the panel hands the rest to them as arguments."""

    head: bpy.props.PointerProperty(
        name="Head", description="The imported head that the steps work on", type=bpy.types.Object, poll=_is_head
    )
    splats: bpy.props.PointerProperty(
        name="Splats", description="The splats whose display is set here", type=bpy.types.Object, poll=_is_splats
    )
    run_folder: bpy.props.StringProperty(
        name="Run Folder",
        description="Where training writes the avatar and its checkpoints",
        subtype="DIR_PATH",
        options=PATH_OPTIONS,
        default="//stga_run",
    )
    minutes: bpy.props.FloatProperty(name="Minutes", description="Wall time of training", default=5.0, min=0.01)
    avatar: bpy.props.StringProperty(
        name="Avatar", description="Trained avatar file (.npz)", subtype="FILE_PATH", options=PATH_OPTIONS
    )


def register() -> None:
    register_classes((Settings,))
    setattr(bpy.types.Scene, ids.SETTINGS, bpy.props.PointerProperty(type=Settings))


def unregister() -> None:
    delattr(bpy.types.Scene, ids.SETTINGS)
    unregister_classes((Settings,))
