"""Conversion between motions of FLAME heads and performances in ARKit's 52 blend shapes."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.model import Capture
from ..capture.open import open_capture
from ..driving.head_map import person_of
from ..driving.inverse import captured_performance, head_angles, write_performance
from ..driving.open_motion import (
    Motion,
    MotionOptions,
    adapted,
    check_motion,
    performed,
    prepared_performance,
)
from ..driving.performance import Performance
from ..driving.performers import performer_of, read_performance
from ..errors import StgaError
from ..export.playback import playback_fps
from ..files import read_json, write_npz
from ..flame.model import EXPRESSION_NAMES, JOINTS
from ..flame.parts import flame_model
from ..flame.quaternions import from_axis_angle, from_matrices, to_axis_angle, to_matrices
from ..flame.sequence import FRAME_FIELDS, FlameSequence, retimed
from ..options import When, like, option
from ..progress import Log, Progress, Report, Written
from ..tracking.folder import (
    AVATAR_MISFIT,
    LOCK_FILE,
    REPORT_FILE,
    clear,
    is_begun,
    is_written,
)
from ..training.run.folder import avatar_version, open_refined, read_run
from ..worker.lock import hold_folder
from .avatar_source import findings, motion_options_field
from .track import MAX_MISFIT, WRITER, Track, track
from .train import Train

SHAPES_SUFFIX = ".csv"
"""Suffix of a performance."""
TRACKING_SUFFIX = ".tracking"
"""Suffix of the folder beside the result in which an avatar tracks."""
CHECK_SUFFIX = ".check"
"""Suffix of that in which it tracks a few timesteps first."""
CHECKED_TIMESTEPS = 8
"""Spread over the footage, which show whether the avatar is the performer's."""


def _writes_parameters(value: Any) -> bool:
    return value.output.suffix.lower() != SHAPES_SUFFIX


def _asks_model(value: Any) -> bool:
    """Whether a FLAME model is opened that no run names."""
    if value.avatar is not None:
        return _writes_parameters(value) and value.head is not None
    return _writes_parameters(value) or performer_of(value.source) is None


@dataclass(frozen=True)
class ConvertMotion:
    """Convert a face performance (ARKit's 52 shapes) to a FLAME motion, or the other way."""

    source: Path = option(
        "a performance (CSV, JSON, text, take folder), a video of a face (with --avatar: footage), "
        "FLAME parameters (.npz), or a capture tracked with FLAME",
        flag="MOTION",
    )
    output: Path = option(
        "ARKit's shapes (.csv) or FLAME parameters (.npz)", flag="--out", metavar="FILE"
    )
    flame: Path | None = like(
        Train,
        "flame",
        help="FLAME model file (default: the bundled head)",
        needs=(When(_asks_model, "on {source} as {output}, for which no model is asked"),),
    )
    head: Path | None = option(
        "capture whose identity a performance moves (default: average)",
        None,
        metavar="CAPTURE",
        needs=(When(_writes_parameters, "without FLAME parameters (.npz) as --out"),),
    )
    avatar: Path | None = option(
        "run of the performer's avatar, which tracks the footage; where that shows somebody else, "
        "the face networks do",
        None,
        metavar="RUN",
    )
    fps: float | None = option("of the result (default: as recorded)", None, above=0)
    options: MotionOptions = motion_options_field()

    @property
    def writes_shapes(self) -> bool:
        return self.output.suffix.lower() == SHAPES_SUFFIX

    def check(self) -> None:
        """Raise StgaError for a file name of another format."""
        if not self.writes_shapes and self.output.suffix.lower() != ".npz":
            raise StgaError(f"{self.output}: expected a name that ends in {SHAPES_SUFFIX} or .npz")


def convert_motion(request: ConvertMotion, report: Report, log: Log) -> Written:
    """Write the motion or the performance. Raises StgaError."""
    report(Progress(stage="Converting"))
    options = request.options
    tracked = None
    if request.avatar is not None:
        tracked = _tracked_by_avatar(request, request.avatar, report, log)
    if tracked is not None:
        performance = _performance_of_head(tracked)
    elif performer_of(request.source) is not None:
        performance = read_performance(request.source, report, options.recorded_fps)
    else:
        check_motion(request.source)
        performance = _shapes_of_motion(request)
        options = replace(options, neutral="none")  # which the parameters were put on already
    lines: tuple[str, ...] = ()
    if request.writes_shapes:
        lines = tuple(f"warning: {sentence}" for sentence in performance.warnings)
        write_performance(request.output, prepared_performance(performance, options, request.fps))
    else:
        if tracked is not None and request.head is None:
            motion = _resampled(tracked, request)
        else:
            person = _person(request)
            motion = performed(performance, person, str(request.flame), options, fps=request.fps)
        write_motion(request.output, motion.sequence)
        count = len(motion.sequence.timesteps)
        written = f"{request.output}: {count} timesteps at {motion.fps:g} frames per second"
        lines = (*findings(motion), written)
    for suffix in (TRACKING_SUFFIX, CHECK_SUFFIX):
        shutil.rmtree(f"{request.output}{suffix}", ignore_errors=True)
    return Written(request.output, lines)


def _person(request: ConvertMotion) -> FlameSequence:
    if request.head is not None:
        return open_capture(request.head, request.flame).flame_motion()
    if request.avatar is not None:
        return open_refined(request.avatar).flame_motion()
    model = flame_model(request.flame)
    return person_of(model, model.v_template)


def _tracked_by_avatar(
    request: ConvertMotion, avatar: Path, report: Report, log: Log
) -> Capture | None:
    """The footage tracked by the avatar, in folders beside the result with which a cancelled
    request for the same footage and avatar goes on; None where some of its timesteps look like
    somebody else."""
    from ..tracking.footage.open import open_footage
    from ..tracking.footage.sequences import FrameRange
    from ..tracking.opened import is_of_footage

    count = len(open_footage(request.source).timesteps)
    flame = read_run(avatar).flame
    for suffix, step in ((CHECK_SUFFIX, max(1, count // CHECKED_TIMESTEPS)), (TRACKING_SUFFIX, 1)):
        out = Path(f"{request.output}{suffix}")
        footage = open_footage(request.source, frames=FrameRange(step=step))
        is_other = not is_of_footage(out, footage)
        if is_written(out):
            is_other |= read_json(out / REPORT_FILE)["avatar"] != avatar_version(avatar)
        if is_other and is_begun(out):
            with hold_folder(out, LOCK_FILE, WRITER):
                clear(out)
        if not is_written(out):
            asked = Track(request.source, None, out, avatar=avatar, step=step, take="talk")
            track(asked, report, log)
        misfit = read_json(out / REPORT_FILE)["image_misfit"][AVATAR_MISFIT]
        fraction = float(np.median(list(misfit.values())))
        if fraction > MAX_MISFIT:
            log(
                f"warning: the avatar does not explain {fraction:.0%} of the head's pixels: is it "
                "of another person? The face networks detect the motion"
            )
            return None
    log(f"avatar: does not explain {fraction:.0%} of the head's pixels (median)")
    return open_capture(out, flame)


def _performance_of_head(tracked: Capture) -> Performance:
    """ARKit's shapes of a tracked capture, with the head's turns from its first timestep on."""
    sequence = tracked.flame_motion()
    fps = playback_fps(tracked, numbered=True)
    performance = captured_performance(sequence, str(tracked.root), fps)
    poses = np.stack([sequence.frame(timestep).pose for timestep in sequence.timesteps])
    root, neck = (
        to_matrices(from_axis_angle(poses[:, JOINTS.index(name)])) for name in ("root", "neck")
    )
    turned = root @ neck
    turns = to_axis_angle(from_matrices(turned @ turned[0].T))
    return replace(performance, head=head_angles(turns))


def _resampled(tracked: Capture, request: ConvertMotion) -> Motion:
    """The parameters of a tracked capture, a timestep per 1/fps seconds, with the options."""
    sequence = tracked.flame_motion()
    rate = playback_fps(tracked, numbered=True)
    fps = request.fps or rate
    frames, _ = adapted(retimed(sequence, rate / fps), request.options)
    known = dict(enumerate(frames))
    return Motion(replace(sequence, timesteps=tuple(known), frame=known.__getitem__), fps)


def _shapes_of_motion(request: ConvertMotion) -> Performance:
    """ARKit's shapes of a FLAME motion or capture."""
    source = request.source
    neutral = request.options.neutral
    if not request.writes_shapes:
        raise StgaError(
            f"{source}: holds FLAME parameters already; --out takes a {SHAPES_SUFFIX} of "
            "ARKit's shapes"
        )
    if request.head is not None:
        raise StgaError(f"--head: has no effect on {source}, which has its own identity")
    capture = open_capture(source, request.flame)
    sequence = capture.flame_motion()
    # of the parameters: what leaks into them are no weights from 0 to 1
    if neutral != "none":
        frames = sequence.frames()
        frames, _ = adapted(frames, MotionOptions(neutral=neutral))
        known = dict(zip(sequence.timesteps, frames, strict=True))
        sequence = replace(sequence, frame=known.__getitem__)
    return captured_performance(sequence, str(source), playback_fps(capture, numbered=True))


def write_motion(path: Path, sequence: FlameSequence) -> None:
    """Write a sequence as FLAME parameters that `read_motion` takes."""
    frames = sequence.frames()
    arrays = {
        name: np.stack([getattr(frame, name) for frame in frames]).astype(np.float32)
        for name in FRAME_FIELDS
    }
    arrays |= {"shape": sequence.shape, "timesteps": np.array(sequence.timesteps)}
    if sequence.model.expression_names:
        arrays[EXPRESSION_NAMES] = np.array(sequence.model.expression_names)
    write_npz(path, arrays, compressed=True)
