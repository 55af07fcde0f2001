"""Analyzes the capture in a worker: the effects it calls for, with reasons, and the time of each preset."""

import json
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.scene import tags
from . import background, ids
from .background import Command
from .common import head_of, needs_head, reporting, scene_settings


class AnalyzeCapture(bpy.types.Operator):
    """Find out which effects the capture calls for, and how long each preset takes on this machine"""

    bl_idname = ids.ANALYZE_CAPTURE
    bl_label = "Analyze Capture"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        return background.needs_idle(cls, context) and needs_head(cls, context)

    @reporting
    def execute(self, context: Any) -> set[str]:
        arguments = _arguments(head_of(context), scene_settings(context))
        background.start(context, Command(arguments, _fill, "analysis_error"))
        return {"FINISHED"}


class CancelAnalysis(bpy.types.Operator):
    """Stop the analysis; earlier results stay"""

    bl_idname = ids.CANCEL_ANALYSIS
    bl_label = "Cancel Analysis"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        if background.running(context.scene):
            return True
        cls.poll_message_set("Nothing is being analyzed")
        return False

    def execute(self, context: Any) -> set[str]:
        background.cancel(context.scene)
        return {"FINISHED"}


def chosen_effects(settings: Any) -> list[str]:
    """The user's choices of effects, as NAME=on or NAME=off."""
    return [f"{row.name}={row.choice}" for row in settings.effects if row.choice != "auto"]


def _arguments(head: Any, settings: Any) -> list[str]:
    point = head.get(tags.PRINCIPAL_POINT, "vhap")
    arguments = ["info", head[tags.CAPTURE], "--json", "--presets", "--principal-point", point]
    arguments += ["--device", settings.device]
    if head.get(tags.FLAME_MODEL):
        arguments += ["--flame", head[tags.FLAME_MODEL]]
    return arguments + [part for effect in chosen_effects(settings) for part in ("--effect", effect)]


def _fill(scene: Any, output: str) -> None:
    """Fill the scene's table of effects."""
    settings = getattr(scene, ids.SETTINGS)
    try:
        found = json.loads(output)
    except ValueError as error:
        raise StgaError(f"Analysis printed something other than JSON ({error})") from error
    decisions = found["plan"]
    settings.preset_timing = json.dumps({row["preset"]: row["seconds"] for row in found.get("presets", ())})
    settings.effects.clear()
    for decision in decisions:
        row = settings.effects.add()
        row.name = decision["effect"]
        for name in ("choice", "on", "reason", "cost"):
            setattr(row, name, decision[name])
