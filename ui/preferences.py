"""What holds for every .blend file of this user."""

from typing import Any

import bpy

from ..operators.common import register_classes, unregister_classes
from ..stga_addon.scene.compat import PATH_OPTIONS


class Preferences(bpy.types.AddonPreferences):
    bl_idname = __package__.rpartition(".")[0]

    flame_model: bpy.props.StringProperty(
        name="FLAME Model",
        description="Your own FLAME model file (.pkl or .npz), from flame.is.tue.mpg.de; "
        "needed for captures tracked with FLAME, and never part of this add-on",
        subtype="FILE_PATH",
        options=PATH_OPTIONS,
    )

    def draw(self, context: Any) -> None:
        self.layout.prop(self, "flame_model")


def register() -> None:
    register_classes((Preferences,))


def unregister() -> None:
    unregister_classes((Preferences,))
