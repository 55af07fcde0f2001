"""Analysis of a capture before it is trained."""

from ..capture.open import open_capture
from ..progress import Progress, Report, Say
from ..render.device import choose_device
from ..requests.results import Analyzed
from ..requests.values import Analyze
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
    from ..report.preset_timing import time_presets  # imports Numba, which deciding effects does without

    report(Progress(0.5, "Timing the presets"))
    return Analyzed(plan, {timing.preset: timing.seconds for timing in time_presets(capture, device=device)})
