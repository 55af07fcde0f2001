"""Stages of a tracking, and their progress reports."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from ..worker.helpers import Helpers


class Stage(Enum):
    """What a tracking does, in order.

    title       what it is called
    begin, end  of the progress: about its part of the time on two processors where one camera
                recorded a long video of 1080p (`stage_spans` knows of shorter ones); what precedes
                it, where cameras are to be found, begins at -1, and what follows the capture at 1
    """

    OPENING = ("Opening the footage", 0.0, 0.0)
    FRAMES = ("Choosing frames", -1.0, -0.9)
    FEATURES = ("Features of images", -0.9, -0.5)
    MATCHES = ("Matches between images", -0.5, -0.1)
    CAMERAS = ("Cameras of images", -0.1, 0.0)
    HEAD_MODEL = ("Head model", 0.0, 0.035)
    LANDMARKS = ("Landmarks", 0.035, 0.115)
    FOCAL_LENGTH = ("Focal length", 0.115, 0.12)
    FIT = ("Fit", 0.12, 0.225)
    DENSE = ("Dense tracking", 0.225, 0.33)

    SURFACE = ("Surface", 0.33, 0.355)

    REFINEMENT = ("Refinement", 0.355, 0.465)

    ONLY_DENSE = ("Dense tracking", 0.225, 0.465)
    """Instead of surface and refinement where one camera does not show the surface."""
    MATTES = ("Mattes", 0.465, 0.695)

    TORSO = ("Torso", 0.695, 0.83)
    CLOTH = ("Cloth", 0.83, 0.96)
    CONTACT_SHEET = ("Contact sheet", 0.96, 0.975)
    IMAGES = ("Images", 0.975, 0.98)
    HEADS = ("Heads", 0.98, 1.0)

    AVATAR = ("Avatar", 1.0, 2.0)
    """A known person's avatar is posed in the capture."""
    CORRECTION = ("Solve", 0.0, 0.9)
    """Correction of a capture around heads that were posed by hand."""

    def __init__(self, title: str, begin: float, end: float) -> None:
        self.title = title
        self.begin = begin
        self.end = end


FIXED_S = {
    Stage.HEAD_MODEL: 1.0,
    Stage.FOCAL_LENGTH: 25.0,
    Stage.FIT: 9.0,
    Stage.DENSE: 8.0,
    Stage.REFINEMENT: 8.0,
    Stage.ONLY_DENSE: 17.0,
    Stage.TORSO: 12.0,
    Stage.CLOTH: 2.0,
    Stage.CONTACT_SHEET: 3.0,
}
"""About the seconds of a stage, however few images there are; of ten of 360p, measured."""
IMAGE_S = 1.0
"""About the seconds of all other work on an image, which stages share as the progress of a long
video."""


def stage_spans(images: int, absent: Collection[Stage]) -> dict[Stage, tuple[float, float]]:
    """Begin and end in the progress of the stages that lead to a capture, but those that are not
    needed, for so many images."""
    times = dict[Stage, float]()
    for stage in Stage:
        if stage.begin >= 0 and stage.end <= 1 and stage not in (*absent, Stage.CORRECTION):
            fraction = stage.end - stage.begin
            times[stage] = FIXED_S.get(stage, 0.0) + IMAGE_S * images * fraction
    total = sum(times.values())
    spans = {}
    begin = 0.0
    for stage, seconds in times.items():
        spans[stage] = (begin, begin + seconds / total)
        begin = begin + seconds / total
    return spans


ReportStage = Callable[[Stage, int, int], None]
"""Stage, steps done and steps in all. May raise to cancel: whole cameras stay on disk, and are not
detected again."""
Draw = Callable[[], Mapping[str, np.ndarray] | None]
"""Draws a picture (`Progress.picture`) for those who watch; None: there is nothing to draw."""
Show = Callable[[Draw, Mapping[str, float]], None]
"""Called with what draws a picture, and with figures of how well the head fits
(`format.describe_figures`)."""


def unreported(stage: Stage, done: int, total: int) -> None:
    """A `ReportStage` that discards reports."""


def unseen(draw: Draw, figures: Mapping[str, float]) -> None:
    """A `Show` that discards pictures."""


@dataclass(frozen=True)
class Workers:
    """Helpers that work on the stages of a tracking, and callbacks for its progress and
    pictures."""

    helpers: Helpers
    report: ReportStage = unreported
    show: Show = unseen

    def map(
        self,
        work: Callable[..., Any],
        parts: Sequence[tuple],
        at: tuple[Stage, int, int],
        keep: bool = False,
    ) -> list[Any]:
        """The results of `Helpers.map`, whose steps are reported; at: a stage, its steps before
        these, and in all."""
        stage, before, total = at
        return self.helpers.map(work, parts, lambda n: self.report(stage, before + n, total), keep)
