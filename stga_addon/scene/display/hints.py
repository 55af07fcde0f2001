"""Scene settings that change how EEVEE and Cycles show splats."""

import bpy

TRANSPARENT_BOUNCES = 64
"""Layers of overlapping splats that Cycles has to see through; behind its default of 8 is black."""


def view_transform_hint(scene: bpy.types.Scene) -> str | None:
    """A sentence where the view transform changes the colors of splats that EEVEE and Cycles render, else None."""
    if scene.view_settings.view_transform == "Standard":
        return None
    return f"View transform {scene.view_settings.view_transform} changes the splats' colors; choose Standard"


def shows_nodes(scene: bpy.types.Scene) -> bool:
    """Whether the scene is rendered by EEVEE or Cycles, which show what geometry nodes make of splats."""
    return scene.render.engine == "CYCLES" or scene.render.engine.startswith("BLENDER_EEVEE")


def use_transparent_bounces(scene: bpy.types.Scene) -> None:
    """Let Cycles, where its add-on is enabled, see through overlapping splats without ending rays between them at
    random; limits that are higher stay."""
    cycles = getattr(scene, "cycles", None)
    for limit in ("transparent_max_bounces", "min_transparent_bounces") if cycles else ():
        setattr(cycles, limit, max(getattr(cycles, limit), TRANSPARENT_BOUNCES))
