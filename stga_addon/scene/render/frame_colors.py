"""Relit colors of one frame as an attribute of the splats, which EEVEE and Cycles show through the node tree."""

from typing import Any

import bpy
import numpy as np

from ...errors import StgaError
from .. import tags
from ..arrays import flat_floats
from ..display.splat_attributes import RELIT_COLOR, write_attributes
from ..display.splat_object import stored_light
from ..light.settings import lighting_settings
from .scene_splats import SplatCache, visible_layers


def relight_frame(splat_object: Any, scene: Any) -> None:
    """Store the splats' scene-linear colors in the scene's light, at its frame and from its camera.

    Raises StgaError where the lighting is as recorded, or the avatar does not know its light.
    """
    depsgraph = bpy.context.evaluated_depsgraph_get()
    layers = visible_layers(depsgraph, SplatCache(), is_wanted=lambda shown: shown == splat_object)
    if not layers or layers[0].relit is None:
        raise StgaError(f"{splat_object.name}: is lit as recorded; choose Scene or Mix in the panel Lighting")
    if scene.camera is None:
        raise StgaError("The scene has no camera, from which highlights are seen")
    eye = layers[0].eye_in_avatar(np.array(scene.camera.evaluated_get(depsgraph).matrix_world)[:3, 3])
    relit = layers[0].relit
    color = relit.relighter.radiance(relit.mesh, eye, relit.lighting, relit.casters)
    values = flat_floats(np.concatenate([np.maximum(color, 0), np.ones((len(color), 1))], axis=1))
    write_attributes(splat_object.data, {RELIT_COLOR: ("FLOAT_COLOR", "color", values)}, "POINT")
    splat_object.data[tags.RELIT_FRAME] = scene.frame_current
    splat_object.data.update()


def forget_frame(splat_object: Any) -> bool:
    """Show recorded colors again; whether there were others."""
    attribute = splat_object.data.attributes.get(RELIT_COLOR)
    if attribute is not None:
        splat_object.data.attributes.remove(attribute)
        splat_object.data.pop(tags.RELIT_FRAME, None)
        splat_object.data.update()
    return attribute is not None


def light_hint(scene: Any) -> str | None:
    """A sentence where EEVEE and Cycles show splats in another light than the scene's at its frame, else None."""
    settings = lighting_settings(scene)
    if settings is None or settings.mode == "recorded":
        return None
    for shown in scene.objects:
        if tags.CONVENTION not in shown or shown.hide_render or stored_light(shown) is None:
            continue
        frame = shown.data.get(tags.RELIT_FRAME) if RELIT_COLOR in shown.data.attributes else None
        if frame != scene.frame_current:
            now = "colors as recorded" if frame is None else f"the light of frame {frame}"
            return f"EEVEE and Cycles render {now}; Relight Frame gives them the light of this frame"
    return None
