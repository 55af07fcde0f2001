"""How a scene lights its avatars: properties of a scene, saved with the .blend file."""
# mypy: disable-error-code="valid-type"

from collections.abc import Callable
from typing import Any

import bpy

from ...light.values import SKIN_ROUGHNESS

PROPERTY = "stga_lighting"
"""The scene's `LightingSettings`."""


MODE_CHANGED: list[Callable[[Any], None]] = []
"""What is called with a scene whose mode was chosen."""


def _mode_changed(settings: Any, context: Any) -> None:
    for call in MODE_CHANGED:
        call(settings.id_data)


class LightingSettings(bpy.types.PropertyGroup):  # type: ignore[misc]
    """Settings of the panel *Lighting*, one group for each scene."""

    mode: bpy.props.EnumProperty(
        name="Lighting",
        description="Which light avatars show",
        items=(
            ("recorded", "As Recorded", "The light of the capture: colors as trained"),
            ("scene", "Scene", "The scene's lights and world"),
            ("mix", "Mix", "Between both"),
        ),
        update=_mode_changed,
    )
    mix: bpy.props.FloatProperty(
        name="Mix", description="Share of the scene's light",
        default=0.5, min=0.0, max=1.0, subtype="FACTOR",
    )  # fmt: skip
    exposure: bpy.props.FloatProperty(
        name="Exposure", soft_min=-4.0, soft_max=4.0,
        description="Stops by which relit avatars are brighter: the absolute level of a capture's "
        "light is not known",
    )  # fmt: skip
    white: bpy.props.FloatVectorProperty(
        name="White", subtype="COLOR", size=3, default=(1.0, 1.0, 1.0), min=0.0, max=1.0,
        description="What should be white or gray on the avatar; its tint is taken away. Pick it "
        "with the eyedropper from the avatar as recorded",
    )  # fmt: skip
    roughness: bpy.props.FloatProperty(
        name="Roughness", description="Of highlights on skin",
        default=SKIN_ROUGHNESS, min=0.05, max=1.0,
    )  # fmt: skip
    specular: bpy.props.FloatProperty(
        name="Highlights", description="Factor of highlights; 0: none",
        default=1.0, min=0.0, soft_max=2.0,
    )  # fmt: skip
    shadows: bpy.props.BoolProperty(
        name="Shadows", description="Lights are blocked by the head and by other objects",
        default=True,
    )  # fmt: skip
    world: bpy.props.BoolProperty(
        name="World", description="The scene's world lights avatars, too", default=True
    )
    lights: bpy.props.PointerProperty(
        name="Lights", type=bpy.types.Collection,
        description="Only the lights of this collection light avatars; empty: all",
    )  # fmt: skip


def lighting_settings(scene: Any) -> Any:
    """The scene's `LightingSettings`; None where the add-on is not registered."""
    return getattr(scene, PROPERTY, None)


def current_settings(depsgraph: Any) -> Any:
    """The `LightingSettings` at the depsgraph's frame; None where the add-on is not registered.

    Those of a viewport are in the scene itself: a change of them does not evaluate it anew.
    """
    is_viewport = depsgraph.mode == "VIEWPORT"
    return lighting_settings(depsgraph.scene if is_viewport else depsgraph.scene_eval)


def settings_values(scene: Any) -> tuple[Any, ...]:
    """The values of the scene's `LightingSettings`, to compare."""
    settings = lighting_settings(scene)
    if settings is None:
        return ()
    others = [name for name in LightingSettings.__annotations__ if name != "white"]
    return tuple(settings.white), *(getattr(settings, name) for name in others)


def register() -> None:
    bpy.utils.register_class(LightingSettings)
    setattr(bpy.types.Scene, PROPERTY, bpy.props.PointerProperty(type=LightingSettings))


def unregister() -> None:
    delattr(bpy.types.Scene, PROPERTY)
    bpy.utils.unregister_class(LightingSettings)
