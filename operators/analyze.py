"""Analyzes the capture in a worker: the effects it calls for, with reasons, and the time of each preset."""

import json
from typing import Any, ClassVar

import bpy

from ..stga_addon.requests.results import Analyzed
from ..stga_addon.requests.values import Analyze
from ..stga_addon.training.effects.decisions import parse_choices
from . import background, ids
from .background import BackgroundRequest
from .common import capture_source, head_of, needs_head, reporting, scene_settings


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
        request = _request(head_of(context), scene_settings(context))
        background.start(context, BackgroundRequest(request, _fill, "analysis_error"))
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


def _request(head: Any, settings: Any) -> Analyze:
    capture, flame, principal_point = capture_source(head)
    effects = parse_choices(chosen_effects(settings))
    return Analyze(capture, flame, principal_point, effects, settings.device, timed=True)


def _fill(scene: Any, found: Analyzed) -> None:
    """Fill the scene's table of effects."""
    settings = getattr(scene, ids.SETTINGS)
    settings.preset_timing = json.dumps(dict(found.seconds))
    settings.effects.clear()
    for decision in found.plan:
        row = settings.effects.add()
        row.name = decision.effect
        for name in ("choice", "on", "reason", "cost"):
            setattr(row, name, getattr(decision, name))
