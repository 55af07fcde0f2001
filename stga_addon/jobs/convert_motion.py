"""Conversion between motions of FLAME heads and performances in ARKit's 52 blend shapes."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..capture.model import Capture
from ..capture.open import open_capture
from ..driving.head_map import person_of
from ..driving.inverse import captured_performance, write_performance
from ..driving.open_motion import MotionOptions, adapted, performed, prepared_performance
from ..driving.performance import Performance
from ..driving.read_performance import is_performance, read_performance
from ..errors import StgaError
from ..export.playback import playback_fps
from ..files import write_npz
from ..flame.model import EXPRESSION_NAMES
from ..flame.sequence import FRAME_FIELDS, FlameSequence
from ..flame.teeth import flame_model
from ..options import like, option
from ..progress import Progress, Report, Say
from ..tracking.footage.sources import is_video
from .avatar_source import findings, motion_options_field
from .results import Written
from .train import Train

SHAPES_SUFFIX = ".csv"


@dataclass(frozen=True)
class ConvertMotion:
    """Convert a face performance (ARKit's 52 shapes) to a FLAME motion, or the other way."""

    source: Path = option(
        "a performance (CSV, JSON, text, take folder), a video of a face, FLAME parameters (.npz), "
        "or a capture tracked with FLAME", flag="MOTION",
    )  # fmt: skip
    output: Path = option(
        "ARKit's shapes (.csv) or FLAME parameters (.npz)", flag="--out", metavar="FILE"
    )
    flame: Path | None = like(Train, "flame", help="FLAME model file (default: the bundled head)")
    head: Path | None = option(
        "capture whose identity a performance moves (default: average)", None, metavar="CAPTURE"
    )
    fps: float | None = option("of the result (default: as recorded)", None, above=0)
    options: MotionOptions = motion_options_field()

    @property
    def writes_shapes(self) -> bool:
        return self.output.suffix.lower() == SHAPES_SUFFIX

    def check(self) -> None:
        """Raise StgaError for a file name of another format, and an option that needs an avatar."""
        if not self.writes_shapes and self.output.suffix.lower() != ".npz":
            raise StgaError(f"{self.output}: expected a name that ends in {SHAPES_SUFFIX} or .npz")
        if self.options.stay_trained is not None:
            raise StgaError("--stay-trained: has no effect here, where there is no avatar")


def convert_motion(request: ConvertMotion, report: Report, say: Say) -> Written:
    """Write the motion or the performance. Raises StgaError."""
    report(Progress(stage="Converting"))
    options = request.options
    if is_video(request.source):
        from ..driving.face_video import watched_performance

        performance = watched_performance(request.source, report)
    elif is_performance(request.source):
        performance = read_performance(request.source)
    else:
        performance = _shapes_of_motion(request)
        options = replace(options, neutral="none")  # which the parameters were put on already
    if request.writes_shapes:
        write_performance(request.output, prepared_performance(performance, options, request.fps))
        return Written(request.output)
    if request.head is None:
        model = flame_model(request.flame)
        person = person_of(model, model.v_template)
    else:
        person = _flame_motion(open_capture(request.head, request.flame), "identity")
    motion = performed(performance, person, str(request.flame), options, fps=request.fps)
    write_motion(request.output, motion.sequence)
    count = len(motion.sequence.timesteps)
    written = f"{request.output}: {count} timesteps at {motion.fps:g} frames per second"
    return Written(request.output, (*findings(motion), written))


def _shapes_of_motion(request: ConvertMotion) -> Performance:
    """ARKit's shapes of a FLAME motion or capture."""
    source, neutral = request.source, request.options.neutral
    if not request.writes_shapes:
        instead = f"--out takes a {SHAPES_SUFFIX} of ARKit's shapes"
        raise StgaError(f"{source}: holds FLAME parameters already; {instead}")
    if request.head is not None:
        raise StgaError(f"--head: has no effect on {source}, which has its own identity")
    capture = open_capture(source, request.flame)
    sequence = _flame_motion(capture, "parameters of expression and pose")
    # of the parameters: what leaks into them are no weights from 0 to 1
    if neutral != "none":
        frames = [sequence.frame(timestep) for timestep in sequence.timesteps]
        frames, _ = adapted(frames, MotionOptions(neutral=neutral))
        known = dict(zip(sequence.timesteps, frames, strict=True))
        sequence = replace(sequence, frame=known.__getitem__)
    return captured_performance(sequence, str(source), playback_fps(capture, numbered=True))


def _flame_motion(capture: Capture, lacking: str) -> FlameSequence:
    if capture.flame is None:
        raise StgaError(f"{capture.root}: was not tracked with FLAME, so it has no {lacking}")
    return capture.flame


def write_motion(path: Path, sequence: FlameSequence) -> None:
    """Write a sequence as FLAME parameters that `read_motion` takes."""
    frames = [sequence.frame(timestep) for timestep in sequence.timesteps]
    arrays = {
        name: np.stack([getattr(frame, name) for frame in frames]).astype(np.float32)
        for name in FRAME_FIELDS
    }
    arrays |= {"shape": sequence.shape, "timesteps": np.array(sequence.timesteps)}
    if sequence.model.expression_names:
        arrays[EXPRESSION_NAMES] = np.array(sequence.model.expression_names)
    write_npz(path, arrays, compressed=True)
