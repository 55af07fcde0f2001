"""Analysis of a capture before it is trained."""

from ..capture.open import open_capture
from ..format import format_duration
from ..progress import Progress, Report, Say
from ..render.device import choose_device
from ..requests.results import Analyzed
from ..requests.values import Analyze, TimePresets
from ..training.effects.plan import plan_effects
from ..training.settings import make_settings


def analyze(request: Analyze, report: Report, say: Say) -> Analyzed:
    """Decide the effects of a training on the capture, and time the presets where that is asked for. Raises
    StgaError; a capture without training views calls for nothing."""
    report(Progress(stage="Analyzing the capture"))
    capture = open_capture(request.capture, request.flame, request.principal_point)
    if not capture.views.get("train"):
        return Analyzed((), {})
    device, _ = choose_device(request.device)
    _, plan = plan_effects(capture, make_settings(iterations=1, effects=dict(request.effects or {})), device)
    if not request.timed:
        return Analyzed(plan, {})
    from ..training.preset_timing import time_presets  # imports Numba, which deciding effects does without

    report(Progress(0.5, "Timing the presets"))
    return Analyzed(plan, {timing.preset: timing.seconds for timing in time_presets(capture, device=device)})


def time_each_preset(request: TimePresets, report: Report, say: Say) -> Analyzed:
    """Time the presets; says what each is for. Raises StgaError."""
    from ..training.preset_timing import time_presets

    capture = open_capture(request.capture, request.flame, request.principal_point)
    device, why = choose_device(request.device)
    say(why)
    timings = time_presets(capture, device=device)
    for timing in timings:
        time = f"about {format_duration(timing.seconds):<10}"
        say(f"{timing.preset:<9} {timing.iterations:6d} iterations  {time}  {timing.purpose}")
    return Analyzed((), {timing.preset: timing.seconds for timing in timings})
