"""Analyzes the capture in a worker: the effects it calls for, with reasons, and the time of each preset."""

import json
import subprocess
import traceback
from threading import Thread
from typing import Any, ClassVar

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.scene import tags
from ..stga_addon.worker.launch import start_python
from . import ids, monitor
from .common import head_of, needs_head, reporting, scene_settings
from .environment import training_python

CHECK_INTERVAL_S = 0.3


class _Analysis:
    """A worker whose output a thread reads: a full pipe would block it for ever."""

    def __init__(self, python: str, arguments: list[str]) -> None:
        self._process = start_python(
            python, arguments, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, encoding="utf-8", errors="replace",
        )  # fmt: skip
        self._output = ("", "")
        self._thread = Thread(target=self._read, name="stga analysis", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        self._output = self._process.communicate()

    @property
    def is_running(self) -> bool:
        return self._thread.is_alive()

    def result(self) -> dict[str, Any]:
        """Wait for the worker; what it found. Raises StgaError with its error message where it failed."""
        self._thread.join()
        output, errors = self._output
        code = self._process.returncode
        if code:
            lines = errors.strip().splitlines() or [f"Analysis exited unexpectedly (exit code {code})"]
            raise StgaError(lines[-1].removeprefix("stga: ").removeprefix("--effect "))
        try:
            found: dict[str, Any] = json.loads(output)
        except ValueError as error:
            raise StgaError(f"Analysis printed something other than JSON ({error})") from error
        return found

    def cancel(self) -> None:
        self._process.kill()
        self._thread.join()


_analyses: dict[int, _Analysis] = {}
"""Session id of a scene -> the analysis of its capture."""


class AnalyzeCapture(bpy.types.Operator):
    """Find out which effects the capture calls for, and how long each preset takes on this machine"""

    bl_idname = ids.ANALYZE_CAPTURE
    bl_label = "Analyze Capture"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        if is_analyzing(context.scene):
            cls.poll_message_set("The capture is being analyzed")
            return False
        return needs_head(cls, context)

    @reporting
    def execute(self, context: Any) -> set[str]:
        arguments = ["stga_addon", *_arguments(head_of(context), scene_settings(context))]
        analysis = _Analysis(training_python(context), arguments)
        if not monitor.has_timer():
            _show(context.scene, analysis)
            if scene_settings(context).analysis_error:
                raise StgaError(scene_settings(context).analysis_error)
            return {"FINISHED"}
        _analyses[context.scene.session_uid] = analysis
        if not bpy.app.timers.is_registered(tick):
            bpy.app.timers.register(tick, first_interval=CHECK_INTERVAL_S, persistent=True)
        return {"FINISHED"}


class CancelAnalysis(bpy.types.Operator):
    """Stop analyzing the capture; earlier results stay"""

    bl_idname = ids.CANCEL_ANALYSIS
    bl_label = "Cancel Analysis"
    bl_options: ClassVar[set[str]] = {"REGISTER"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        if is_analyzing(context.scene):
            return True
        cls.poll_message_set("No capture is being analyzed")
        return False

    def execute(self, context: Any) -> set[str]:
        _analyses.pop(context.scene.session_uid).cancel()
        return {"FINISHED"}


def is_analyzing(scene: Any) -> bool:
    """Whether the scene's capture is being analyzed."""
    return scene.session_uid in _analyses


def stop() -> None:
    """Cancel every analysis."""
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)
    for analysis in _analyses.values():
        analysis.cancel()
    _analyses.clear()


def chosen_effects(settings: Any) -> list[str]:
    """The user's choices of effects, as NAME=on or NAME=off."""
    return [f"{row.name}={row.choice}" for row in settings.effects if row.choice != "auto"]


def tick() -> float | None:
    """Show the analyses that have finished; seconds until the next call, as bpy.app.timers expects."""
    scenes = {scene.session_uid: scene for scene in bpy.data.scenes}
    for uid in [uid for uid, analysis in _analyses.items() if not analysis.is_running]:
        analysis = _analyses.pop(uid)
        if uid in scenes:
            _show(scenes[uid], analysis)
    monitor.redraw()
    return CHECK_INTERVAL_S if _analyses else None


def _arguments(head: Any, settings: Any) -> list[str]:
    point = head.get(tags.PRINCIPAL_POINT, "vhap")
    arguments = ["info", head[tags.CAPTURE], "--json", "--presets", "--principal-point", point]
    arguments += ["--device", settings.device]
    if head.get(tags.FLAME_MODEL):
        arguments += ["--flame", head[tags.FLAME_MODEL]]
    return arguments + [part for effect in chosen_effects(settings) for part in ("--effect", effect)]


def _show(scene: Any, analysis: _Analysis) -> None:
    """Fill the scene's table of effects, or say what failed; earlier results stay then."""
    settings = getattr(scene, ids.SETTINGS)
    try:
        _fill(settings, analysis.result())
        settings.analysis_error = ""
    except StgaError as error:
        settings.analysis_error = str(error)
    except Exception as error:  # it must not end the timer
        traceback.print_exc()
        settings.analysis_error = f"Unexpected error ({type(error).__name__}: {error}); see the console"


def _fill(settings: Any, found: dict[str, Any]) -> None:
    decisions = found["plan"]
    settings.preset_timing = json.dumps({row["preset"]: row["seconds"] for row in found.get("presets", ())})
    settings.effects.clear()
    for decision in decisions:
        row = settings.effects.add()
        row.name = decision["effect"]
        for name in ("choice", "on", "reason", "cost"):
            setattr(row, name, decision[name])
