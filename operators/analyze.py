"""Which effects the capture calls for: asked of a worker, since looking takes seconds, and packages Blender lacks."""

import json
import subprocess
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.scene import tags
from ..stga_addon.worker.launch import start_python
from . import ids
from .common import head_of, needs_head, reporting, scene_settings
from .environment import training_python

INTERVAL_S = 0.3

_asked: dict[int, "subprocess.Popen[str]"] = {}
"""A scene's session id -> the worker that looks at its capture."""


class AnalyzeCapture(bpy.types.Operator):
    """Look at the capture for seconds: which effects it calls for, and why; how long each preset takes here"""

    bl_idname = ids.ANALYZE_CAPTURE
    bl_label = "Plan Effects"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        if context.scene.session_uid in _asked:
            cls.poll_message_set("The capture is being looked at")
            return False
        return needs_head(cls, context)

    @reporting
    def execute(self, context: Any) -> set[str]:
        arguments = _arguments(head_of(context), scene_settings(context))
        process = start_python(
            training_python(context), ["stga_addon", *arguments], stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, encoding="utf-8",
        )  # fmt: skip
        if bpy.app.background:
            _show(context.scene, process)
            if scene_settings(context).analysis_error:
                raise StgaError(scene_settings(context).analysis_error)
            return {"FINISHED"}
        _asked[context.scene.session_uid] = process
        if not bpy.app.timers.is_registered(_tick):
            bpy.app.timers.register(_tick, first_interval=INTERVAL_S, persistent=True)
        return {"FINISHED"}


def is_looking(scene: Any) -> bool:
    """Whether the scene's capture is being looked at."""
    return scene.session_uid in _asked


def stop() -> None:
    """Look at nothing any more."""
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    for process in _asked.values():
        process.kill()
        process.communicate()
    _asked.clear()


def chosen_effects(chosen: Any) -> list[str]:
    """What the person has decided, as NAME=on or NAME=off."""
    return [f"{row.name}={row.choice}" for row in chosen.effects if row.choice != "auto"]


def _arguments(head: Any, chosen: Any) -> list[str]:
    point = head.get(tags.PRINCIPAL_POINT, "vhap")
    arguments = ["info", head[tags.CAPTURE], "--json", "--presets", "--principal-point", point]
    if head.get(tags.FLAME_MODEL):
        arguments += ["--flame", head[tags.FLAME_MODEL]]
    return arguments + [part for effect in chosen_effects(chosen) for part in ("--effect", effect)]


def _tick() -> float | None:
    """Show the plans that have come; what a bpy.app.timers function answers."""
    scenes = {scene.session_uid: scene for scene in bpy.data.scenes}
    for uid in [uid for uid, process in _asked.items() if process.poll() is not None]:
        process = _asked.pop(uid)
        if uid in scenes:
            _show(scenes[uid], process)
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()
    return INTERVAL_S if _asked else None


def _show(scene: Any, process: "subprocess.Popen[str]") -> None:
    """Fill the scene's table with what the worker found; keeps what the person has chosen."""
    chosen = getattr(scene, ids.SETTINGS)
    said, mistakes = process.communicate()
    if process.returncode:
        lines = mistakes.strip().splitlines() or ["the worker ended without a word"]
        chosen.analysis_error = lines[-1].removeprefix("stga: ").removeprefix("--effect ")
        return
    chosen.analysis_error = ""
    chosen.effects.clear()
    found = json.loads(said)
    chosen.preset_timing = json.dumps({row["preset"]: row["seconds"] for row in found.get("presets", ())})
    for decision in found["plan"]:
        row = chosen.effects.add()
        row.name = decision["effect"]
        for name in ("choice", "on", "reason", "cost"):
            setattr(row, name, decision[name])
