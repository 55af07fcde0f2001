"""Scene settings that change how splats look, each reported in one sentence."""

import bpy

TRANSPARENT_BOUNCES = 64
"""Layers of overlapping splats that Cycles has to see through; its default of 8 leaves black holes."""


def view_transform_hint(scene: bpy.types.Scene) -> str | None:
    """A sentence where the view transform changes the colors of splats that EEVEE and Cycles render, else None."""
    if scene.view_settings.view_transform == "Standard":
        return None
    return f"View transform {scene.view_settings.view_transform} changes the splats' colors; choose Standard"


def transparent_bounces_hint(scene: bpy.types.Scene) -> str | None:
    """A sentence where Cycles renders the scene with too few transparent bounces for splats, else None."""
    cycles = getattr(scene, "cycles", None)  # None where the Cycles add-on is disabled
    if scene.render.engine != "CYCLES" or cycles is None:
        return None
    if cycles.transparent_max_bounces < TRANSPARENT_BOUNCES:
        return (
            f"Cycles sees through {cycles.transparent_max_bounces} layers of splats; {TRANSPARENT_BOUNCES} are needed"
        )
    if cycles.min_transparent_bounces < TRANSPARENT_BOUNCES:
        return "Cycles ends rays between splats at random, which is seen as noise"
    return None


def use_transparent_bounces(scene: bpy.types.Scene) -> None:
    """Let Cycles see through overlapping splats, without ending rays between them at random."""
    cycles = scene.cycles
    cycles.transparent_max_bounces = max(cycles.transparent_max_bounces, TRANSPARENT_BOUNCES)
    cycles.min_transparent_bounces = max(cycles.min_transparent_bounces, TRANSPARENT_BOUNCES)
