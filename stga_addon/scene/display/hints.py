"""Scene settings that change how splats look, each reported in one sentence."""

import bpy

TRANSPARENT_BOUNCES = 64
"""Layers of overlapping splats that Cycles has to see through; its default of 8 leaves black holes."""


def view_transform_hint(scene: bpy.types.Scene) -> str | None:
    """A sentence where the view transform changes the colors that the splats were trained in, else None."""
    if scene.view_settings.view_transform == "Standard":
        return None
    return f"View transform {scene.view_settings.view_transform} changes the splats' colors; choose Standard"


def transparent_bounces_hint(scene: bpy.types.Scene) -> str | None:
    """A sentence where Cycles renders the scene with too few transparent bounces for splats, else None."""
    cycles = getattr(scene, "cycles", None)  # None where the Cycles add-on is disabled
    if scene.render.engine != "CYCLES" or cycles is None or cycles.transparent_max_bounces >= TRANSPARENT_BOUNCES:
        return None
    return f"Cycles sees through {cycles.transparent_max_bounces} layers of splats; {TRANSPARENT_BOUNCES} are needed"
