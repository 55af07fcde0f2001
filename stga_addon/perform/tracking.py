"""Tracking as requests ask for it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..progress import Cancelled, Progress, Report, Say
from ..requests.results import Written
from ..requests.values import MATTES, SolveAgain, Track
from ..tracking.correct import correct_capture
from ..tracking.footage.open import open_footage
from ..tracking.footage.sequences import FrameRange
from ..tracking.track import track

STAGES = {
    "Opening the footage": (0.0, 0.0),
    "Head model": (0.0, 0.05),
    "Landmarks": (0.05, 0.6),
    "Focal length": (0.6, 0.61),
    "Fit": (0.61, 0.65),
    "Dense tracking": (0.65, 0.72),
    "Surface": (0.72, 0.79),
    "Refinement": (0.79, 0.85),
    "Mattes": (0.85, 0.89),
    "Torso": (0.89, 0.91),
    "Contact sheet": (0.91, 0.92),
    "Images": (0.92, 0.97),
    "Heads": (0.97, 1.0),
}
"""Stage of `tracking.track` -> the share of the progress that it begins and ends with."""
FOCAL_SOURCES = {
    "given": "as given",
    "file": "as the file says",
    "solved": "solved from the turns of the head",
    "usual": "a guess, that of a phone",
}
"""What a person reads of where a focal length is from (`Footage.focal`)."""


def perform_tracking(request: Track, report: Report, say: Say) -> Written:
    """Track the head into a capture. Raises StgaError; cancelled, it leaves the landmarks of whole cameras, with which
    the same request continues."""
    now = Progress()

    def keep(progress: Progress) -> bool:
        nonlocal now
        now = progress
        return report(progress)

    def show(draw: Callable[[], np.ndarray | None]) -> None:
        report(replace(now, picture=draw))

    steps = _steps(keep)
    steps("Opening the footage", 0, 1)
    frames = FrameRange(request.start, request.stop, request.step, dict(request.offset or {}), request.sync)
    given = None if request.mattes in MATTES else Path(request.mattes)
    footage = open_footage(request.footage, request.cameras, frames, request.focal, mattes=given)
    found = track(
        footage, request.model, request.out, request.landmarks, request.meshes, request.world,
        request.mattes == "auto", steps, show,
    )  # fmt: skip
    error = f"Reprojection error {found.median_px:.1f} px (median)"
    report(Progress(1.0, "Tracked", error))
    lines = [
        *(f"warning: {warning}" for warning in found.warnings),
        f"reprojection error: {found.median_px:.2f} px (median); by camera and timestep in tracking.json",
        *([] if found.focal_px is None else [f"focal length: {found.focal_px:.0f} px, {FOCAL_SOURCES[found.focal]}"]),
        *([] if found.torso is None else [f"torso: {found.torso.description}"]),
        f"capture: {request.out}",
    ]
    return Written(request.out, tuple(lines))


def solve_again(request: SolveAgain, report: Report, say: Say) -> Written:
    """Solve the capture again around the keys. Raises StgaError."""
    correct_capture(request.capture, request.model, request.keys, report=_steps(report))
    return Written(request.capture)


def _steps(report: Report) -> Callable[[str, int, int], None]:
    """A report of steps done in a stage; raises Cancelled where the report says to stop."""

    def report_steps(stage: str, done: int, total: int) -> None:
        begin, end = STAGES.get(stage, (0.0, 0.9))
        share = begin + (end - begin) * done / max(total, 1)
        if report(Progress(share, stage, f"{done} of {total}" if total > 1 else "")):
            raise Cancelled

    return report_steps
