"""What the panel's steps remember between clicks; saved with the .blend."""

import bpy

from ..operators import ids
from ..operators.common import register_classes, unregister_classes
from ..operators.train import strategy_property
from ..stga_addon.scene.compat import PATH_OPTIONS


class Settings(bpy.types.PropertyGroup):
    """One per scene; operators read what the scene works on, the panel hands the rest to them as arguments."""

    # Pointers without a poll function: with one, Blender 4.2 crashes on exit once the group is unregistered.

    head: bpy.props.PointerProperty(
        name="Head", description="The imported head that the steps work on", type=bpy.types.Object
    )
    splats: bpy.props.PointerProperty(
        name="Splats", description="The splats whose display is set here", type=bpy.types.Object
    )
    run_folder: bpy.props.StringProperty(
        name="Run Folder",
        description="Where training writes the avatar and its checkpoints",
        subtype="DIR_PATH",
        options=PATH_OPTIONS,
        default="//stga_run",
    )
    minutes: bpy.props.FloatProperty(name="Minutes", description="Wall time of training", default=5.0, min=0.01)
    strategy: strategy_property()
    resume: bpy.props.BoolProperty(name="Resume", description="Continue the run in the folder instead of a new one")
    avatar: bpy.props.StringProperty(
        name="Avatar", description="Trained avatar file (.npz)", subtype="FILE_PATH", options=PATH_OPTIONS
    )


def register() -> None:
    register_classes((Settings,))
    setattr(bpy.types.Scene, ids.SETTINGS, bpy.props.PointerProperty(type=Settings))


def unregister() -> None:
    delattr(bpy.types.Scene, ids.SETTINGS)
    unregister_classes((Settings,))
