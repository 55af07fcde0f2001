"""Tracking as requests ask for it."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..progress import Cancelled, Progress, Report, Say, TimeLeft
from ..requests.results import Written
from ..requests.values import MATTES, SolveAgain, Track
from ..tracking.correct import correct_capture
from ..tracking.footage.open import open_footage
from ..tracking.footage.sequences import FrameRange
from ..tracking.track import track

STAGES = {
    "Opening the footage": (0.0, 0.0),
    "Head model": (0.0, 0.01),
    "Landmarks": (0.01, 0.06),
    "Focal length": (0.06, 0.07),
    "Fit": (0.07, 0.12),
    "Dense tracking": (0.12, 0.3),
    "Surface": (0.3, 0.34),
    "Refinement": (0.34, 0.51),
    "Mattes": (0.51, 0.64),
    "Torso": (0.64, 0.97),
    "Contact sheet": (0.97, 0.985),
    "Images": (0.985, 0.99),
    "Heads": (0.99, 1.0),
}
"""Stage of `tracking.track` -> the share of the progress that it begins and ends with: about its share of the time on
two processors where one camera recorded a video of 1080p."""
FOCAL_SOURCES = {
    "given": "as given",
    "file": "as the file says",
    "solved": "solved from the turns of the head",
    "usual": "a guess, that of a phone",
}
"""What a person reads of where a focal length is from (`Footage.focal`)."""


def perform_tracking(request: Track, report: Report, say: Say) -> Written:
    """Track the head into a capture. Raises StgaError; cancelled, it leaves what was found so far, from which the same
    request continues."""
    steps = _Steps(report)
    steps.report("Opening the footage", 0, 1)
    frames = FrameRange(request.start, request.stop, request.step, dict(request.offset or {}), request.sync)
    given = None if request.mattes in MATTES else Path(request.mattes)
    footage = open_footage(request.footage, request.cameras, frames, request.focal, mattes=given)
    found = track(
        footage, request.model, request.out, request.landmarks, request.meshes, request.world,
        request.mattes == "auto", steps.report, steps.show,
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
    correct_capture(request.capture, request.model, request.keys, report=_Steps(report).report)
    return Written(request.capture)


class _Steps:
    """A tracking's steps as progress, with the time that is left and how well the head fits."""

    def __init__(self, report: Report) -> None:
        self._report, self._time_left = report, TimeLeft()
        self._now, self._quality = Progress(), dict[str, float]()

    def report(self, stage: str, done: int, total: int) -> None:
        """Raises Cancelled where the report says to stop."""
        begin, end = STAGES.get(stage, (0.0, 0.9))
        share = begin + (end - begin) * done / max(total, 1)
        figures = {"left_s": self._time_left.after(share), **self._quality}
        self._now = Progress(share, stage, f"{done} of {total}" if total > 1 else "", lambda: figures)
        if self._report(self._now):
            raise Cancelled

    def show(self, draw: Callable[[], np.ndarray | None], quality: Mapping[str, float]) -> None:
        self._quality = dict(quality)
        self._report(replace(self._now, picture=draw))
