"""Conversion between motions of FLAME heads and performances in ARKit's 52 blend shapes."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..capture.open import open_capture
from ..driving.head_map import person_of
from ..driving.inverse import captured_performance, write_performance
from ..driving.open_motion import MotionOptions, adapted, performed, prepared_performance
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
    """Convert a face performance (ARKit's 52 shapes) to a FLAME motion, or a motion to a CSV of
    shapes."""

    source: Path = option(
        "a performance (CSV, JSON, text, take folder), a video of a face, FLAME parameters (.npz), or a capture "
        "tracked with FLAME", flag="MOTION",
    )  # fmt: skip
    output: Path = option(
        "ARKit's shapes (.csv) or FLAME parameters (.npz)", flag="--out", metavar="FILE"
    )
    flame: Path | None = like(
        Train, "flame", help="FLAME model file of the head (default: the bundled head)"
    )
    head: Path | None = option(
        "capture whose identity a performance moves (default: average)", None, metavar="CAPTURE"
    )
    fps: float | None = option(
        "frames per second of the result (default: as recorded)", None, above=0
    )
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
    if is_video(request.source):
        from ..driving.face_video import watched_performance

        performance = watched_performance(request.source, report)
    elif is_performance(request.source):
        performance = read_performance(request.source)
    else:
        _write_shapes(request)
        return Written(request.output)
    if request.writes_shapes:
        write_performance(
            request.output, prepared_performance(performance, request.options, request.fps)
        )
        return Written(request.output)
    motion = performed(
        performance, _person(request), str(request.flame), request.options, fps=request.fps
    )
    write_motion(request.output, motion.sequence)
    written = f"{request.output}: {len(motion.sequence.timesteps)} timesteps at {motion.fps:g} frames per second"
    return Written(request.output, (*findings(motion), written))


def _write_shapes(request: ConvertMotion) -> None:
    """The CSV of a FLAME motion or capture."""
    if not request.writes_shapes:
        raise StgaError(
            f"{request.source}: holds FLAME parameters already; --out takes a {SHAPES_SUFFIX} of ARKit's shapes"
        )
    if request.head is not None:
        raise StgaError(f"--head: has no effect on {request.source}, which has its own identity")
    capture = open_capture(request.source, request.flame)
    if capture.flame is None:
        raise StgaError(
            f"{request.source}: was not tracked with FLAME, so it has no parameters of expression and pose"
        )
    sequence = capture.flame
    # of the parameters: what leaks into them are no weights from 0 to 1
    if request.options.neutral != "none":
        frames, _ = adapted(
            [sequence.frame(timestep) for timestep in sequence.timesteps],
            MotionOptions(neutral=request.options.neutral),
        )
        known = dict(zip(sequence.timesteps, frames, strict=True))
        sequence = replace(sequence, frame=known.__getitem__)
    performance = captured_performance(
        sequence, str(request.source), playback_fps(capture, numbered=True)
    )
    options = replace(request.options, neutral="none")
    write_performance(request.output, prepared_performance(performance, options, request.fps))


def _person(request: ConvertMotion) -> FlameSequence:
    """The head of --head, or the model's average one."""
    if request.head is not None:
        capture = open_capture(request.head, request.flame)
        if capture.flame is None:
            raise StgaError(f"{request.head}: was not tracked with FLAME, so it has no identity")
        return capture.flame
    model = flame_model(request.flame)
    return person_of(model, model.v_template)


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
