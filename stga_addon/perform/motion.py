"""The motion that a request names, on its avatar."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..avatar.file import Avatar
from ..capture.flame_capture import sequence_capture
from ..capture.model import Capture
from ..driving.open_motion import Motion, TrainedRange, open_motion, trained_range
from ..errors import StgaError
from ..progress import Say
from ..requests.values import Export, Render
from ..training.run.folder import read_run


def open_avatar_motion(request: Render | Export, avatar: Avatar, say: Say) -> Motion:
    """The request's motion on its avatar; says how far it is outside the trained range, where that is asked for.

    Raises StgaError.
    """
    assert request.motion is not None
    source, options = request.source, request.motion_options
    run = read_run(source) if source.is_dir() else None
    flame = request.flame or (run.flame if run is not None else None)
    trained = None if run is None else _trained(source, request, say)
    if options.stay_trained is not None and trained is None:
        raise StgaError(f"--stay-trained: {source} is no run with a FLAME capture, whose motion would be the range")
    motion = open_motion(request.motion, flame, avatar.neutral, avatar.faces, options, trained, request.fps)
    for line in findings(motion):
        say(line)
    return motion


def motion_capture(request: Export, motion: Motion, own: Capture | None) -> Capture:
    """The motion as a capture, seen by the cameras of the run's own one."""
    assert request.motion is not None
    views = {} if own is None else own.views
    return replace(sequence_capture(request.motion, motion.sequence, request.flame, views), fps=motion.fps)


def findings(motion: Motion) -> list[str]:
    """What to say about a motion: rows that were lost, and how far it goes beyond what was trained."""
    lines = [f"{motion.lost} rows are missing and were interpolated"] if motion.lost else []
    for part, beyond in motion.outside.items():
        if beyond.any():
            share_outside = 100 * float(np.mean(beyond > 0))
            lines.append(
                f"{part}: {share_outside:.0f} % of the frames are outside the trained range, by up to "
                f"{beyond.max():.1f} of its half width (frame {int(beyond.argmax())})"
            )
    return lines


def _trained(folder: Path, request: Render | Export, say: Say) -> TrainedRange | None:
    """What the run's capture holds, where the options ask for it; None where it was not tracked with FLAME."""
    from ..training.run.open_run import open_run

    options = request.motion_options
    if options.neutral == "none" and options.stay_trained is None:
        return None
    try:
        own = open_run(folder, flame=request.flame).capture.flame
    except StgaError as error:
        if options.stay_trained is not None:
            raise
        say(f"{error}; the motion is put on the head without expression, not on its quiet face")
        return None
    return None if own is None else trained_range([own.frame(timestep) for timestep in own.timesteps])
