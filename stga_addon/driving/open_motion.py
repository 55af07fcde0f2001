"""The one place where a file becomes the motion of a head: FLAME parameters, captures and ARKit performances."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..capture.open import open_capture
from ..errors import StgaError
from ..export.playback import playback_fps
from ..flame.forward import FlameFrame
from ..flame.model import FlameModel
from ..flame.sequence import FlameSequence, strengthened, transferred_motion
from ..flame.teeth import flame_model
from ..options import option
from .head_map import HeadMap, head_map, person_of
from .names import ARKIT_SHAPES, PARTS
from .performance import (
    EXCHANGEABLE,
    Performance,
    amplified,
    exchanged_sides,
    mirrored,
    relative_to,
    resampled,
    smoothed,
)
from .read_performance import MAX_FPS, MAX_ROWS, MIN_FPS, is_performance, read_performance
from .transfer import (
    NEUTRALS,
    TrainedRange,
    chosen_neutral,
    exchanged_neutral,
    led_back,
    outside,
    quiet_neutral,
    quiet_weights,
)

MAX_FACTOR, MAX_SMOOTHING_S = 100.0, 10.0


def parsed_gain(text: str) -> tuple[str, float]:
    """Name and factor of `jawOpen=0.8`, a key and value of `MotionOptions.gains`. Raises StgaError for other text."""
    name, _, number = text.partition("=")
    if name not in (*PARTS, "head", *ARKIT_SHAPES):
        raise StgaError(f"'{name}' names none of {', '.join((*PARTS, 'head'))} and ARKit's shapes")
    try:
        value = float(number)
    except ValueError:
        value = -1.0
    if not 0 <= value <= MAX_FACTOR:
        raise StgaError(f"'{number}' is not a number from 0 to {MAX_FACTOR:g}")
    return name, value


@dataclass(frozen=True)
class MotionOptions:
    """What is done to a motion on its way to a head; smoothing, mirror, gains and exchange to performances alone.

    strength   of expression, jaw, eyes and neck about the neutral face; of the head's motion about its first pose
    neutral    whose resting face the motion is put on the head's own from (`NEUTRALS`)
    smoothing  standard deviation in seconds
    gains      factor of a part ("face", "jaw", "eyes", "head") or of one shape
    stay_trained  0 to 1; None: how far the motion is outside that range is not asked for
    """

    strength: float = option(
        "of the motion; 1: as recorded, above 1: exaggerated; the head's is scaled about its first pose",
        1.0, 0, MAX_FACTOR,
    )  # fmt: skip
    neutral: str = option(
        "what the motion is taken relative to, so that this head's own face is moved, not the performer's",
        "none", choices=NEUTRALS,
    )  # fmt: skip
    smoothing: float = option(
        "smooth a face performance in time, by this standard deviation",
        0.0, 0, MAX_SMOOTHING_S, flag="--smooth", metavar="SECONDS",
    )  # fmt: skip
    mirror: bool = option("exchange left and right of a face performance", False)
    gains: Mapping[str, float] = option(
        "scale a part of a performance (face, jaw, eyes, head) or one shape, such as jawOpen; may be repeated",
        default_factory=dict, flag="--gain", metavar="NAME=FACTOR", parse=parsed_gain,
    )  # fmt: skip
    stay_trained: float | None = option(
        "lead the motion softly back to the range that the run was trained on, and print how far it was outside; "
        "0: print only, 1 (default): fully",
        None, 0, 1, metavar="SHARE", bare=1.0,
    )  # fmt: skip
    exchange: tuple[str, ...] = option(
        "exchange left and right of one pair alone, which some senders exchange; may be repeated",
        (), choices=EXCHANGEABLE,
    )  # fmt: skip


@dataclass(frozen=True)
class Motion:
    """A motion on one head, and what was found on the way.

    fps      timesteps per second; None where unknown
    lost     rows that the file lacks between its first and last
    outside  part -> (T,) how far each frame was outside the trained range (`transfer.outside`); empty without a range
    """

    sequence: FlameSequence
    fps: float | None
    lost: int = 0
    outside: Mapping[str, np.ndarray] = field(default_factory=dict)


def open_motion(
    path: Path,
    flame: Path | None,
    neutral: np.ndarray,
    faces: np.ndarray,
    options: MotionOptions | None = None,
    trained: TrainedRange | None = None,
    fps: float | None = None,
) -> Motion:
    """The motion of a file on the head whose neutral mesh is `neutral` (V, 3) with triangles `faces` (F, 3).

    path   FLAME parameters (.npz), the folder of a capture tracked with FLAME, or a performance (`read_performance`)
    flame  the model file; None: the one in the capture's folder, or the bundled head for a performance
    fps    rate that a performance is resampled to; None: its own. Timesteps of FLAME motions stay as they are
    Raises StgaError where the file is no motion, or its model has other triangles.
    """
    options = options or MotionOptions()
    chosen_neutral(str(path), options.neutral)
    if is_performance(path):
        model = flame_model(flame)
        if flame is None and len(model.faces) != len(faces):
            raise StgaError(
                f"{path}: needs the FLAME model file (.pkl or .npz) of the head that it moves; give it with --flame"
            )
        _check_faces(path, model, faces)
        return performed(read_performance(path), person_of(model, neutral), str(flame or path), options, trained, fps)
    capture = open_capture(path, flame)
    if capture.flame is None:
        raise StgaError(f"{path}: was not tracked with FLAME, so it has no parameters of expression and pose")
    _check_faces(path, capture.flame.model, faces)
    sequence = transferred_motion(capture.flame, neutral)
    frames, beyond = adapted([sequence.frame(timestep) for timestep in sequence.timesteps], options, trained)
    return Motion(_with_frames(sequence, sequence.timesteps, frames), playback_fps(capture), 0, beyond)


def performed(
    performance: Performance,
    person: FlameSequence,
    name: str,
    options: MotionOptions,
    trained: TrainedRange | None = None,
    fps: float | None = None,
) -> Motion:
    """A performance on a person's head: one timestep per 1/fps seconds, from 0 on. `name` is what errors call it."""
    prepared = prepared_performance(performance, replace(options, strength=1.0), fps)  # `frames_of` applies it
    frames, beyond = frames_of(head_map(person, name), prepared, options, trained)
    timesteps = tuple(range(len(frames)))
    return Motion(_with_frames(person, timesteps, frames), prepared.fps, performance.lost, beyond)


def adapted(
    frames: list[FlameFrame], options: MotionOptions, trained: TrainedRange | None = None
) -> tuple[list[FlameFrame], dict[str, np.ndarray]]:
    """Frames of another person's FLAME motion with the options' neutral, strength and range; and part -> (T,) how far
    they were outside the trained range before they were led back (`transfer.outside`)."""
    theirs = {"quiet": frames, "first": frames[:1]}.get(options.neutral)
    if theirs is not None:
        frames = exchanged_neutral(frames, quiet_neutral(theirs))
    return _finished(frames, options, trained)


def prepared_performance(performance: Performance, options: MotionOptions, fps: float | None = None) -> Performance:
    """The performance at an even rate, relative to its neutral face, smoothed, amplified, mirrored, at the strength."""
    if fps is not None and not MIN_FPS <= fps <= MAX_FPS:
        raise StgaError(
            f"a performance cannot be resampled to {fps:g} frames per second, expected {MIN_FPS:g} to {MAX_FPS:g}"
        )
    rate = fps or performance.fps
    if performance.times[-1] * rate > MAX_ROWS:
        raise StgaError(f"a performance of {performance.times[-1]:.0f} s at {rate:g} frames per second is too long")
    rest = None
    if options.neutral in ("quiet", "first"):
        weights = quiet_weights(performance) if options.neutral == "quiet" else performance.weights[0]
        rest = replace(performance, weights=weights[None], head=None)
    return at_strength(smoothed(corrected(resampled(performance, fps), options, rest), options.smoothing), options)


def corrected(performance: Performance, options: MotionOptions, rest: Performance | None = None) -> Performance:
    """The performance row by row: with the sender's exchanged pairs put right, relative to the face of `rest` (None: as
    it is), amplified and mirrored."""
    changed = exchanged_sides(performance, options.exchange)
    if rest is not None:
        changed = relative_to(changed, exchanged_sides(rest, options.exchange))
    changed = amplified(changed, options.gains)
    return mirrored(changed) if options.mirror else changed


def at_strength(performance: Performance, options: MotionOptions) -> Performance:
    """Weights and head rotation times the strength, for what has no FLAME parameters, which `frames_of` strengthens."""
    return amplified(performance, dict.fromkeys((*PARTS, "head"), options.strength))


def frames_of(
    found: HeadMap, performance: Performance, options: MotionOptions, trained: TrainedRange | None = None
) -> tuple[list[FlameFrame], dict[str, np.ndarray]]:
    """Frames of a performance, as `corrected`, at the strength on the head of a map; and part -> (T,) how far they were
    outside the trained range before they were led back (`transfer.outside`)."""
    return _finished(found.frames(performance), options, trained)


def _finished(
    frames: list[FlameFrame], options: MotionOptions, trained: TrainedRange | None
) -> tuple[list[FlameFrame], dict[str, np.ndarray]]:
    """The frames on the head's own neutral, where they are relative to the performer's; at the strength, led back, and
    how far they were outside the trained range before that."""
    if options.neutral != "none" and trained is not None:
        frames = exchanged_neutral(frames, None, trained.neutral(options.neutral))
    if options.strength != 1.0:
        frames = strengthened(frames, options.strength)
    if trained is None or options.stay_trained is None:
        return frames, {}
    beyond = outside(frames, trained)
    return (led_back(frames, trained, options.stay_trained) if options.stay_trained else frames), beyond


def _with_frames(person: FlameSequence, timesteps: tuple[int, ...], frames: list[FlameFrame]) -> FlameSequence:
    known = dict(zip(timesteps, frames, strict=True))
    return replace(person, timesteps=timesteps, frame=known.__getitem__)


def _check_faces(path: Path, model: FlameModel, faces: np.ndarray) -> None:
    if not np.array_equal(model.faces, faces):
        raise StgaError(f"{path}: its mesh has other triangles than the one this avatar was trained on")
