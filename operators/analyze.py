"""Analyzes the capture in a worker: the effects it calls for, with reasons, and the time of each
preset."""

from typing import Any, ClassVar

import bpy

from ..stga_addon.jobs.analyze import Analyze
from ..stga_addon.jobs.table import Kind
from ..stga_addon.training.effect_catalog import parse_choice
from . import ids
from .common import capture_source, head_of, needs_head, reporting, scene_settings
from .request import needs_idle, start
from .training_python import training_python


class AnalyzeCapture(bpy.types.Operator):
    """Find out which effects the capture calls for, and how long each preset takes on this
    machine"""

    bl_idname = ids.ANALYZE_CAPTURE
    bl_label = "Analyze Capture"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_idle(cls, context, Kind.ANALYSIS) and needs_head(cls, context)

    @reporting
    def execute(self, context: Any) -> set[str]:
        start(
            context.scene,
            _request(head_of(context), scene_settings(context)),
            training_python(context),
        )
        return {"FINISHED"}


def chosen_effects(settings: Any) -> list[str]:
    """The user's choices of effects, as NAME=on or NAME=off."""
    return [f"{row.name}={row.choice}" for row in settings.effects if row.choice != "auto"]


def _request(head: Any, settings: Any) -> Analyze:
    capture, flame, principal_point = capture_source(head)
    effects = dict(map(parse_choice, chosen_effects(settings)))
    return Analyze(capture, flame, principal_point, effects, settings.device, timed=True)
