"""A file as the motion of a head: FLAME parameters, captures and ARKit performances."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from os.path import exists
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.meshes import Mesh
from ..capture.model import evenly_spread
from ..capture.open import open_capture
from ..errors import StgaError
from ..export.playback import playback_fps
from ..files import is_file
from ..flame.forward import FlameFrame
from ..flame.parts import flame_model
from ..flame.sequence import FlameSequence, strengthened, transferred_motion
from ..options import When, option
from .clocks import MAX_FPS, MIN_FPS
from .frame_forms import MAX_ROWS
from .head_map import head_map, person_of
from .performance import (
    ARKIT_SHAPES,
    EXCHANGEABLE,
    PARTS,
    Performance,
    amplified,
    exchanged_sides,
    mirrored,
    relative_to,
    resampled,
    smoothed,
)
from .performers import READ_SUFFIXES, is_performance, performer_of, read_performance

PART_FIELDS = {"face": "expr", "jaw": "jaw_pose", "eyes": "eyes_pose"}
"""Part of a face -> field of a frame that holds it."""
# Of frames that count as quiet; compared ones
QUIET_FRACTION = 0.2
"""Fraction of the frames that count as quiet."""
MAX_COMPARED_FRAMES = 1000
"""Frames that are compared to find these."""
NEUTRALS = {
    "none": "as recorded",
    "quiet": "both recordings are at rest in the fifth of their frames that are most alike",
    "first": "both recordings begin at rest",
    "calibrated": "the motion is relative to the performer's resting face already",
}
"""Choice of a neutral face -> what it assumes."""
Parts = dict[str, np.ndarray]
"""Part of a face -> its parameters."""
MIN_WIDTH = {"face": 0.5, "jaw": 0.02, "eyes": 0.1}
"""Least half width of a trained range, in units of coefficients and in radians."""
OUTER_QUANTILE = 0.01
"""Quantile of trained frames that is cut off at both ends: single mistracked ones."""


@dataclass(frozen=True)
class TrainedRange:
    """Middle and half width, per part (`PART_FIELDS`), of what an avatar was trained on; the
    person's quiet face and that of the first frame."""

    middle: Parts
    width: Parts
    quiet: Parts
    first: Parts

    def neutral(self, choice: str) -> Parts:
        """The face of one of `NEUTRALS` but "none", on which a relative motion is put."""
        return self.first if choice == "first" else self.quiet


def _by_part(frames: Sequence[FlameFrame]) -> Parts:
    """Part -> its parameters (T, K) in all frames."""
    fields = PART_FIELDS.items()
    return {part: np.stack([getattr(frame, name) for frame in frames]) for part, name in fields}


def _with_parts(frames: Sequence[FlameFrame], parts: Mapping[str, np.ndarray]) -> list[FlameFrame]:
    """The frames with the parameters of parts (T, K) in place of their own."""
    return [
        replace(frame, **{name: parts[part][row] for part, name in PART_FIELDS.items()})
        for row, frame in enumerate(frames)
    ]


def trained_range(frames: Sequence[FlameFrame]) -> TrainedRange:
    """The range of the frames that an avatar was trained on."""
    middle = {}
    width = {}
    for part, values in _by_part(frames).items():
        low, high = np.quantile(values, [OUTER_QUANTILE, 1 - OUTER_QUANTILE], axis=0)
        middle[part] = (low + high) / 2
        width[part] = np.maximum((high - low) / 2, MIN_WIDTH[part])
    return TrainedRange(middle, width, quiet_neutral(frames), quiet_neutral(frames[:1]))


def quiet_neutral(frames: Sequence[FlameFrame]) -> Parts:
    """Part -> the median of its parameters over the frames most alike: a face returns to rest."""
    parts = _by_part(evenly_spread(frames, MAX_COMPARED_FRAMES))
    face = np.concatenate([parts["face"], parts["jaw"]], axis=1)
    squares = (face**2).sum(axis=1)
    apart = squares[:, None] + squares - 2 * face @ face.T
    count = max(1, round(QUIET_FRACTION * len(face)))
    center = np.sort(apart, axis=1)[:, :count].sum(axis=1).argmin()
    quiet = np.argsort(apart[center], kind="stable")[:count]
    return {part: np.median(values[quiet], axis=0) for part, values in parts.items()}


def quiet_weights(performance: Performance) -> np.ndarray:
    """(52,) median of the weights over the rows in which their sum is least."""
    order = np.argsort(performance.weights.sum(axis=1), kind="stable")
    quiet = order[: max(1, round(QUIET_FRACTION * len(order)))]
    return np.median(performance.weights[quiet], axis=0)


def exchanged_neutral(
    frames: Sequence[FlameFrame],
    theirs: Mapping[str, np.ndarray | float] | None,
    neutral: Mapping[str, np.ndarray | float] | None = None,
) -> list[FlameFrame]:
    """The frames with this head's neutral in place of the other person's, part by part; None: a
    neutral of zeros.

    Parameters of the parts are subtracted and added, rotations as axis-angle: jaw and eyes turn by
    small angles.
    """
    neutral = neutral or dict.fromkeys(PART_FIELDS, 0.0)
    theirs = theirs or dict.fromkeys(PART_FIELDS, 0.0)
    parts = _by_part(frames).items()
    return _with_parts(
        frames, {part: each + (neutral[part] - theirs[part]) for part, each in parts}
    )


def outside(frames: Sequence[FlameFrame], trained: TrainedRange) -> Parts:
    """Part -> (T,) how far outside the trained range each frame is: 0 inside, 1 where it is twice
    as far from the middle as the range reaches, for the parameter that is farthest."""
    found = {}
    for part, values in _by_part(frames).items():
        reach = np.abs(values - trained.middle[part]) / trained.width[part]
        found[part] = np.maximum(reach.max(axis=1, initial=0) - 1, 0)
    return found


def led_back(
    frames: Sequence[FlameFrame], trained: TrainedRange, strength: float = 1.0
) -> list[FlameFrame]:
    """The frames with parameters beyond the trained range led back to it; strength 0: unchanged, 1:
    fully.

    Inside the range nothing changes; beyond it, a distance of d half widths becomes 1 − exp(−d)
    quarters of one, so that motion goes on softly. Between 0 and 1 the result lies between both.
    """
    changed = {}
    for part, values in _by_part(frames).items():
        middle = trained.middle[part]
        width = trained.width[part]
        offset = (values - middle) / width
        beyond = np.maximum(np.abs(offset) - 1, 0)
        soft = np.sign(offset) * (np.minimum(np.abs(offset), 1) + 0.25 * (1 - np.exp(-beyond)))
        changed[part] = middle + width * ((1 - strength) * offset + strength * soft)
    return _with_parts(frames, changed)


MAX_FACTOR = 100.0
MAX_SMOOTHING_S = 10.0


def parsed_gain(text: str) -> tuple[str, float]:
    """Name and factor of `jawOpen=0.8`, for `MotionOptions.gains`. Raises StgaError."""
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


def _moves_shapes(value: Any) -> bool:
    """Whether a command's motion is of ARKit's shapes on its way to the head."""
    motion = getattr(value, "motion", None)
    if motion is not None:
        return is_performance(motion)
    return getattr(value, "avatar", None) is None or value.output.suffix.lower() != ".npz"


def _reads_file(value: Any) -> bool:
    """Whether a command's motion is a file of a performance."""
    if hasattr(value, "motion"):
        return is_performance(value.motion)
    return value.avatar is None and is_performance(value.source)


ON_AVATAR = When(lambda value: hasattr(value, "motion"), "here, where there is no avatar")
SHAPES = When(_moves_shapes, "on FLAME parameters, only on a face performance")
FILE = When(_reads_file, "but on a file of a face performance")


@dataclass(frozen=True)
class MotionOptions:
    """What is done to a motion on its way to a head; smoothing (seconds), mirror, gains and
    exchange to performances alone. stay_trained None: how far the motion is outside that range is
    not asked for."""

    LATER_FIELDS = ("recorded_fps",)

    strength: float = option(
        "of the motion; 1: as recorded, above 1: exaggerated; the head's is scaled about its first "
        "pose",
        1.0,
        0,
        MAX_FACTOR,
    )
    neutral: str = option(
        "what the motion is taken relative to, so that this head's own face is moved, not the "
        "performer's",
        "none",
        choices=NEUTRALS,
    )
    smoothing: float = option(
        "smooth a face performance in time, by this standard deviation",
        0.0,
        0,
        MAX_SMOOTHING_S,
        flag="--smooth",
        metavar="SECONDS",
        needs=(SHAPES,),
    )
    mirror: bool = option("exchange left and right of a face performance", False, needs=(SHAPES,))
    gains: Mapping[str, float] = option(
        "scale a part of a performance (face, jaw, eyes, head) or one shape, such as jawOpen; may "
        "be repeated",
        default_factory=dict,
        flag="--gain",
        metavar="NAME=FACTOR",
        parse=parsed_gain,
        needs=(SHAPES,),
    )
    stay_trained: float | None = option(
        "lead the motion softly back to the range that the run was trained on, and print how far "
        "it was outside; 0: print only, 1 (default): fully",
        None,
        0,
        1,
        metavar="FRACTION",
        bare=1.0,
        needs=(ON_AVATAR,),
    )
    exchange: tuple[str, ...] = option(
        "exchange left and right of one pair alone, which some senders exchange; may be repeated",
        (),
        choices=EXCHANGEABLE,
        needs=(SHAPES,),
    )
    recorded_fps: float | None = option(
        "frames per second of a face performance whose file has no times",
        None,
        MIN_FPS,
        MAX_FPS,
        needs=(FILE,),
    )


@dataclass(frozen=True)
class Motion:
    """A motion on one head, and what was found on the way.

    fps      timesteps per second; None where unknown
    lost     rows that the file lacks between its first and last
    outside  part -> (T,) how far each frame was outside the trained range (`outside`);
             empty without a range
    warnings  one sentence each: what was guessed
    """

    sequence: FlameSequence
    fps: float | None
    lost: int = 0
    outside: Mapping[str, np.ndarray] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


def check_motion(path: Path) -> None:
    """Raise StgaError where a path is neither a performance nor FLAME parameters by its name."""
    if not exists(path):
        raise StgaError(f"{path}: does not exist")
    known = (*READ_SUFFIXES, ".npz")
    if is_file(path) and path.suffix.lower() not in known:
        expected = f"{', '.join(known)}, the folder of a take or of a capture"
        recorded = performer_of(path)
        advice = f"; stga drive makes a motion of {recorded.kind}" if recorded else ""
        raise StgaError(f"{path}: is no motion; expected {expected}{advice}")


def open_motion(
    path: Path,
    flame: Path | None,
    head: Mesh,
    options: MotionOptions | None = None,
    trained: TrainedRange | None = None,
    fps: float | None = None,
) -> Motion:
    """The motion of a file on the head of this neutral mesh.

    path   FLAME parameters (.npz), the folder of a capture tracked with FLAME, or a performance
           (`read_performance`)
    flame  the model file; None: the one in the capture's folder, or the bundled head for a
           performance
    fps    rate that a performance is resampled to; None: its own. Timesteps of FLAME motions stay
           as they are
    Raises StgaError where the file is no motion, or its model has other triangles.
    """
    check_motion(path)
    neutral, faces = head
    options = options or MotionOptions()
    if is_performance(path):
        model = flame_model(flame)
        if flame is None and len(model.faces) != len(faces):
            problem = "needs the FLAME model file (.pkl or .npz) of the head that it moves"
            raise StgaError(f"{path}: {problem}; give it with --flame")
        check_faces(path, model.faces, faces)
        person = person_of(model, neutral)
        name = str(flame or path)
        performance = read_performance(path, recorded_fps=options.recorded_fps)
        return performed(performance, person, name, options, trained, fps)
    capture = open_capture(path, flame)
    recorded = capture.flame_motion()
    check_faces(path, recorded.model.faces, faces)
    sequence = transferred_motion(recorded, neutral)
    transferred = sequence.frames()
    frames, beyond = adapted(transferred, options, trained)
    moved = _with_frames(sequence, sequence.timesteps, frames)
    return Motion(moved, playback_fps(capture), 0, beyond, recorded.warnings)


def performed(
    performance: Performance,
    person: FlameSequence,
    name: str,
    options: MotionOptions,
    trained: TrainedRange | None = None,
    fps: float | None = None,
) -> Motion:
    """A performance on a person's head, a timestep per 1/fps seconds; `name` is for errors."""
    # `finished` applies it
    prepared = prepared_performance(performance, replace(options, strength=1.0), fps)
    frames, beyond = finished(head_map(person, name).frames(prepared), options, trained)
    timesteps = tuple(range(len(frames)))
    moved = _with_frames(person, timesteps, frames)
    return Motion(moved, prepared.fps, performance.lost, beyond, performance.warnings)


def adapted(
    frames: list[FlameFrame], options: MotionOptions, trained: TrainedRange | None = None
) -> tuple[list[FlameFrame], Parts]:
    """Frames of another's FLAME motion with the options' neutral, strength and range; and how far
    they were `outside`."""
    theirs = {"quiet": frames, "first": frames[:1]}.get(options.neutral)
    if theirs is not None:
        frames = exchanged_neutral(frames, quiet_neutral(theirs))
    return finished(frames, options, trained)


def prepared_performance(
    performance: Performance, options: MotionOptions, fps: float | None
) -> Performance:
    """Evenly sampled, relative to its neutral, smoothed, `corrected`, at the strength."""
    if fps is not None and not MIN_FPS <= fps <= MAX_FPS:
        raise StgaError(
            f"a performance cannot be resampled to {fps:g} frames per second, expected "
            f"{MIN_FPS:g} to {MAX_FPS:g}"
        )
    rate = fps or performance.fps
    if performance.times[-1] * rate > MAX_ROWS:
        raise StgaError(
            f"a performance of {performance.times[-1]:.0f} s at {rate:g} frames per second is "
            "too long"
        )
    weights = performance.weights[0]
    rest = None
    if options.neutral == "quiet":
        weights = quiet_weights(performance)
    if options.neutral in ("quiet", "first"):
        rest = replace(performance, weights=weights[None], head=np.zeros(3))
    changed = corrected(resampled(performance, fps), options, rest)
    return at_strength(smoothed(changed, options.smoothing), options)


def corrected(
    performance: Performance, options: MotionOptions, rest: Performance | None = None
) -> Performance:
    """With exchanged pairs put right, relative to the face of `rest`, amplified and mirrored."""
    changed = exchanged_sides(performance, options.exchange)
    if rest is not None:
        changed = relative_to(changed, exchanged_sides(rest, options.exchange))
    changed = amplified(changed, options.gains)
    return mirrored(changed) if options.mirror else changed


def at_strength(performance: Performance, options: MotionOptions) -> Performance:
    """Weights and head rotation times the strength, for what has no FLAME parameters."""
    return amplified(performance, dict.fromkeys((*PARTS, "head"), options.strength))


def finished(
    frames: list[FlameFrame], options: MotionOptions, trained: TrainedRange | None
) -> tuple[list[FlameFrame], Parts]:
    """The frames on the head's neutral, at the strength, led back; how far they were outside."""
    if options.neutral != "none" and trained is not None:
        frames = exchanged_neutral(frames, None, trained.neutral(options.neutral))
    if options.strength != 1.0:
        frames = strengthened(frames, options.strength)
    if trained is None or options.stay_trained is None:
        return frames, {}
    beyond = outside(frames, trained)
    if options.stay_trained:
        frames = led_back(frames, trained, options.stay_trained)
    return frames, beyond


def _with_frames(
    person: FlameSequence, timesteps: tuple[int, ...], frames: list[FlameFrame]
) -> FlameSequence:
    known = dict(zip(timesteps, frames, strict=True))
    return replace(person, timesteps=timesteps, frame=known.__getitem__)


def check_faces(path: Path, found: np.ndarray, faces: np.ndarray) -> None:
    """Raise StgaError where the triangles of a file are not the avatar's."""
    if not np.array_equal(found, faces):
        raise StgaError(
            f"{path}: its mesh has other triangles than the one this avatar was trained on"
        )
