"""Scene settings that change how splats look, each as one sentence."""

import bpy


def view_transform_hint(scene: bpy.types.Scene) -> str | None:
    """One sentence where the scene's view transform changes the colours that the splats were trained in."""
    if scene.view_settings.view_transform == "Standard":
        return None
    return f"View transform {scene.view_settings.view_transform} changes the splats' colours: choose Standard."


TRANSPARENT_BOUNCES = 64
"""Layers of overlapping splats that Cycles has to look through; its default of 8 leaves black holes."""


def transparent_bounces_hint(scene: bpy.types.Scene) -> str | None:
    """One sentence where Cycles renders the scene and gives up before it has seen all splats of a pixel."""
    cycles = getattr(scene, "cycles", None)
    if scene.render.engine != "CYCLES" or cycles is None or cycles.transparent_max_bounces >= TRANSPARENT_BOUNCES:
        return None
    return f"Cycles sees {cycles.transparent_max_bounces} layers of splats: {TRANSPARENT_BOUNCES} are needed."
