"""Footage to a capture, solving one again around poses made by hand, and footage to an avatar."""

import math
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import StgaError, shorten
from ..files import read_json, write_json
from ..format import format_duration
from ..options import option
from ..progress import Cancelled, Log, Progress, Report, TimeLeft, Written
from ..schema import usable_path
from ..tracking.folder import (
    KEPT_FOLDER,
    LOCK_FILE,
    REPORT_FILE,
    SHEET_FILE,
    clear,
    is_begun,
    is_flame,
    is_written,
)
from ..tracking.stages import Draw, Stage, stage_spans
from ..training.run.folder import AVATAR, has_run
from ..training.run.report import CURVE
from ..worker.helpers import Helpers
from ..worker.lock import hold_folder
from .train import AFTER_S, Extend, Train, resumed, train_and_finish

if TYPE_CHECKING:
    from ..tracking.footage.model import Footage
    from ..tracking.known_person import KnownPerson
    from ..tracking.opened import TrackingOptions
    from ..tracking.track import TrackingReport

WORLDS = {
    "auto": "the cameras' own where they were exported from a Blender scene, else head",
    "head": "in meters, y up, the head near the origin",
    "keep": "that of the cameras",
}
"""Choice of the world's axes and scale -> what it is."""
SYNC = {
    "none": "the given offsets alone",
    "auto": "by the videos' sound where all have it, else by what moves",
    "sound": "by the videos' sound",
    "motion": "by what moves in them",
}
"""Choice of how several videos are aligned in time -> what it is."""
TAKES = {
    "auto": "found out, and said",
    "around": "a camera that moves around a still head, or photos of one: their cameras are found",
    "talk": "a head that moves in front of a camera",
}
"""Choice of what was filmed -> what it is."""
MATTES = {"auto": "made for frames without a mask", "none": "only those of the footage"}
"""Values of `Track.mattes` beside a folder of masks."""
CAPTURE_FOLDER = "capture"
"""Folder of the capture in the one that `MakeAvatar` writes."""
RUN_FOLDER = "run"
"""Folder of the run beside it."""

INPUTS = "inputs.json"
"""File in the folder of `MakeAvatar`: capture, run, and what was asked for when they began, which
alone continues."""
KINDS = "kinds"
"""Key in that file of what `take_of` found of each take, once it is known."""


def _parsed_mattes(text: str) -> str:
    return text if text in MATTES else os.path.abspath(usable_path(text))


def _parsed_offset(text: str) -> tuple[str, int]:
    name, _, frames = text.rpartition("=")
    if not name or not frames.removeprefix("-").isdecimal() or len(frames) > 9:
        problem = f"expected a camera and a number of frames, as in left=-3, not {shorten(text)}"
        raise StgaError(problem)
    return name, int(frames)


@dataclass(frozen=True)
class Track:
    """Track a head through footage of one or more cameras, and write a capture."""

    footage: Path = option(
        "folder with a folder of images or a video for each camera, or one video", flag="FOOTAGE"
    )
    model: Path | None = option(
        "FLAME (.pkl, .npz), linear model (.npz) or morph targets (.glb) (default: the bundled "
        "head)",
        flag="--model",
        metavar="HEAD",
    )
    out: Path = option("folder of the capture", flag="--out", metavar="CAPTURE")
    cameras: Path | None = option(
        "calibration: COLMAP, Metashape, RealityCapture or transforms.json (default: that in the "
        "footage's folder)",
        None,
        metavar="FILE",
    )
    avatar: Path | None = option(
        "run of the same person's avatar: its head is tracked, in place of --model's, and posed "
        "such that the avatar looks like the images; or a capture of that person, whose head is "
        "tracked",
        None,
        metavar="RUN",
    )
    landmarks: Path | None = option("landmark files of another detector", None, metavar="FOLDER")
    focal: float | None = option(
        "focal length of a single camera without calibration, in pixels (default: as its file "
        "says, or from the head's turns)",
        None,
        above=0,
        metavar="PIXELS",
    )
    start: int = option("first timestep of the footage, counted from 0", 0, 0)
    stop: int | None = option("timestep to stop before (default: all)", None, 1)
    step: int = option("use every nth timestep", 1, 1)
    most: int | None = option(
        "use at most so many of these, evenly spread, of a head that moves (default: all)",
        None,
        1,
        flag="--timesteps",
        metavar="COUNT",
    )
    size: float = option(
        "of the images, as a fraction of the recorded size", 1.0, 0.1, 1.0, metavar="FRACTION"
    )
    offset: Mapping[str, int] | None = option(
        "frames by which a camera's recording is later; may be repeated",
        None,
        metavar="CAMERA=FRAMES",
        parse=_parsed_offset,
    )
    meshes: bool = option("write an OBJ per timestep as well", False)
    world: str = option(
        "the capture's: in meters with the head near the origin, or the cameras' own (default: the "
        "cameras' where they were exported from a Blender scene)",
        "auto",
        choices=WORLDS,
    )
    sync: str = option(
        "find offsets that are not given by the videos' sound, or by what moves; auto: sound where "
        "all have it",
        "none",
        choices=SYNC,
    )
    take: str = option(
        "what a single camera without calibration filmed (default: found out)",
        "auto",
        choices=TAKES,
    )
    mattes: str = option(
        "masks of the person: made where the footage has none (default), only the footage's, or a "
        "folder's",
        "auto",
        is_path=lambda text: text not in MATTES,
        metavar="auto|none|FOLDER",
        parse=_parsed_mattes,
    )

    def check(self) -> None:
        """Raise StgaError where two options contradict each other."""
        if self.avatar is not None and has_run(self.avatar) and (self.model or self.meshes):
            name = "--meshes" if self.model is None else "--model"
            raise StgaError(f"{name}: does not go with --avatar, whose head is tracked")
        known = ("cameras", "landmarks") if self.take == "around" else ("cameras",)
        for name in known if self.take != "auto" else ():
            if getattr(self, name) is not None:
                problem = f"does not go with --{name}, which is of cameras that are known"
                raise StgaError(f"--take {self.take}: {problem}")


@dataclass(frozen=True)
class SolveAgain:
    """Solve a tracked capture again around heads that were posed by hand.

    keys    timestep -> parameters (E + 18,) as of `correct_capture`
    """

    capture: Path
    model: Path
    keys: Mapping[int, np.ndarray]


@dataclass(frozen=True)
class MakeAvatar:
    """Make an avatar from footage: track the head, train, and write a report and a .blend file.

    Called again with the same arguments, it continues where it was interrupted.

    track, train    write to CAPTURE_FOLDER and RUN_FOLDER of one folder, `out`; the FLAME model is
                    that of `track`
    takes           footage of further takes of the same person, tracked into captures of their own
                    and trained together. One around a still head, where there is one, is tracked
                    first: the others are with its head
    """

    track: Track
    train: Train
    LATER_FIELDS = ("takes",)
    takes: tuple[Path, ...] = ()

    @property
    def out(self) -> Path:
        return self.track.out.parent

    def check(self) -> None:
        """Raise StgaError where the two do not belong together, or an avatar is there already."""
        if self.track.avatar is not None:
            raise StgaError("avatar: an avatar of its own is made; expected none to track by")
        wanted = self.out / CAPTURE_FOLDER, self.out / CAPTURE_FOLDER, self.out / RUN_FOLDER
        if (self.track.out, self.train.capture, self.train.run) != wanted:
            raise StgaError(
                f"{self.out}: expected a capture in {CAPTURE_FOLDER}, and its run in {RUN_FOLDER}"
            )
        for name in OF_ONE_TAKE if self.takes else ():
            if getattr(self.track, name) != Track.__dataclass_fields__[name].default:
                raise StgaError(f"--{name}: is of one take, but {1 + len(self.takes)} are given")
        if self.takes and self.track.mattes not in MATTES:
            raise StgaError("--mattes: a folder is of one take; expected auto or none")
        named = [os.path.abspath(path) for path in (self.track.footage, *self.takes)]
        for number, path in enumerate(named):
            if path in named[:number]:
                raise StgaError(f"{path}: is given twice; expected each take once")


OF_ONE_TAKE = ("cameras", "landmarks", "focal", "start", "stop", "offset", "sync")
"""Fields of `Track` that are of one take, and have no meaning for several."""
QUICK: Mapping[str, Any] = {"most": 16, "size": 0.5}
"""Fields of `Track` for a first look at an avatar, as soon of a long video as of a short one."""
QUICK_S = 30.0
"""Seconds of training for a quick look."""
WRITER = "tracking is writing this capture"
"""Who holds the lock of a capture that is being tracked."""
MAX_MISFIT = 0.5
"""Median fraction of the head's pixels beyond which the avatar is another person's."""
TRACKING_FRACTION = 0.5
"""Fraction of the progress before an avatar tracks or is trained."""


def refuse_tracked(request: Track) -> None:
    """Raise StgaError where the folder holds a capture."""
    if is_written(request.out):
        raise StgaError(f"{request.out}: already holds a capture; choose another folder")


def require_tracked(request: SolveAgain) -> None:
    """Raise StgaError where there is no tracked capture to solve again."""
    if not is_written(request.capture):
        raise StgaError(f"{request.capture}: holds no tracked capture to solve again")


def untracked(request: Track) -> Track | Written:
    """The request, or its result where a worker wrote the capture, and ended before it said so."""
    return Written(request.out) if is_written(request.out) else request


def track(request: Track, report: Report, log: Log) -> Written:
    """Track the head into a capture; cancelled, the same request continues. Raises StgaError, also
    while another process writes the capture."""
    with hold_folder(request.out, LOCK_FILE, WRITER):
        if request.avatar is not None and has_run(request.avatar):
            return _track_by_avatar(request, request.avatar, report)
        return _track_head(request, report)


def _track_head(request: Track, report: Report, known: tuple[str, str] | None = None) -> Written:
    """The head of a stranger, or that of the capture which the request names. known: what `take_of`
    found, of several takes."""
    from ..tracking.track import track as track_footage

    steps = _Steps(report)
    model = request.model
    options = _options(request)
    if request.avatar is not None:
        person, model = _captured_person(request.avatar, model)
        options = replace(options, person=person)
    footage, messages = _open(request, steps, known)
    found = track_footage(footage, model, request.out, options, steps.report, steps.show)
    return _written(request.out, found, report, messages)


def _captured_person(path: Path, model: Path | None) -> tuple["KnownPerson", Path | None]:
    """Whose head a capture shows, and the model's file, None of the bundled head. Raises
    StgaError."""
    from ..capture.open import open_capture
    from ..tracking.known_person import captured_person

    if not path.is_dir():
        raise StgaError(f"{path}: is not a folder; expected that of a run or a capture")
    capture = open_capture(path, model)
    return captured_person(capture), model


def _track_by_avatar(request: Track, run: Path, report: Report) -> Written:
    """A run's avatar in place of a head model: it is posed such that it looks like the images."""
    from ..tracking.correct import report_errors
    from ..tracking.track import end_tracking
    from ..tracking.track import track as track_footage
    from ..training.run.recording import avatar_person, track_recording

    steps = _Steps(report, TRACKING_FRACTION)
    out = request.out
    footage, messages = _open(request, steps)
    person, model = avatar_person(run)
    options = replace(_options(request), person=person)
    found = track_footage(footage, model, out, options, steps.report, steps.show)
    keeps_world = footage.keeps(request.world)
    report_avatar = partial(steps.report, Stage.AVATAR)
    with Helpers(folder=out / KEPT_FOLDER) as helpers:
        tracked = track_recording(run, out, helpers, report_avatar, keeps_world)
    found = replace(found, median_px=report_errors(out, model))
    end_tracking(out)
    fraction = float(np.median(tracked.misfit))
    lines = [*messages, f"avatar: does not explain {fraction:.0%} of the head's pixels (median)"]
    if fraction > MAX_MISFIT:
        lines.append("warning: the avatar does not look like the person of this footage")
    return _written(out, found, report, lines)


def _open(
    request: Track, steps: "_Steps", known: tuple[str, str] | None = None
) -> tuple["Footage", tuple[str, ...]]:
    """The footage, and lines on how it was understood. known: as of `_track_head`."""
    from ..tracking.footage.open import open_footage, sized
    from ..tracking.footage.sequences import FrameRange

    steps.report(Stage.OPENING, 0, 1)
    offset = dict(request.offset or {})
    frames = FrameRange(
        request.start, request.stop, request.step, offset, request.sync, request.most
    )
    mattes = None if request.mattes in MATTES else Path(request.mattes)
    opened = partial(
        open_footage, request.footage, request.cameras, focal=request.focal, mattes=mattes
    )
    footage = opened(frames=frames)
    messages: tuple[str, ...] = ()
    if footage.focal == "calibration":
        if request.take == "around":
            raise StgaError(f"--take around: {request.footage} has a calibration already")
    elif request.landmarks is None:
        # a few frames do not tell how the room moves, and are too far apart for cameras
        is_whole = request.most is None or request.take == "talk"
        whole = footage if is_whole else opened(frames=replace(frames, most=None))
        found, messages = _with_found_cameras(whole, request, steps, known)
        is_found = is_whole or found.finds_cameras
        footage = found if is_found else replace(footage, warnings=found.warnings)
    steps.plan(footage)
    return (footage if request.size == 1 else sized(footage, request.size)), messages


def _with_found_cameras(
    footage: "Footage", request: Track, steps: "_Steps", known: tuple[str, str] | None
) -> tuple["Footage", tuple[str, ...]]:
    """As `around.with_found_cameras`; what is refused leaves nothing."""
    from ..tracking.around import with_found_cameras
    from ..tracking.stages import Workers

    out = request.out
    is_new = not is_begun(out)
    try:
        with Helpers(folder=out / KEPT_FOLDER) as helpers:
            workers = Workers(helpers, steps.report, steps.show)
            return with_found_cameras(footage, out, request.take, workers, known)
    except StgaError:
        if is_new and is_begun(out):
            clear(out)
        raise


def _options(request: Track) -> "TrackingOptions":
    from ..tracking.opened import TrackingOptions

    makes_mattes = request.mattes == "auto"
    return TrackingOptions(request.landmarks, request.meshes, request.world, makes_mattes)


def _written(
    out: Path, found: "TrackingReport", report: Report, messages: Sequence[str] = ()
) -> Written:
    lines = [f"warning: {warning}" for warning in found.warnings]
    if found.focal_length is not None:
        lines.append(f"focal length: {found.focal_length.description}")
    if found.torso is not None:
        lines.append(f"torso: {found.torso.description}")
    error = f"{found.median_px:.2f} px (median)"
    report(Progress(1.0, "Tracked", f"Reprojection error {error}"))
    lines += [*messages, f"reprojection error: {error}; by camera and timestep in tracking.json"]
    return Written(out, (*lines, f"capture: {out}"))


def solve_again(request: SolveAgain, report: Report, log: Log) -> Written:
    """Solve the capture again around the keys. Raises StgaError as `track` does."""
    from ..tracking.correct import correct_capture

    with hold_folder(request.capture, LOCK_FILE, WRITER):
        correct_capture(request.capture, request.model, request.keys, report=_Steps(report).report)
    return Written(request.capture)


class _Steps:
    """A tracking's steps as progress, with the time that is left and how well the head fits."""

    def __init__(self, report: Report, tracking_fraction: float = 1.0) -> None:
        self._report = report
        self._time_left = TimeLeft()
        self._fraction = tracking_fraction
        self._before = 0  # 1 where cameras are found before the head is tracked
        self._spans: Mapping[Stage, tuple[float, float]] = {}
        self._now = Progress()
        self._quality = dict[str, float]()

    def plan(self, footage: "Footage") -> None:
        """Let each stage have as much of the progress as it takes of the time."""
        absent = [Stage.ONLY_DENSE]
        if len(footage.cameras) == 1:
            absent = [Stage.DENSE, Stage.SURFACE, Stage.REFINEMENT]
        if footage.focal != "usual":
            absent.append(Stage.FOCAL_LENGTH)
        images = sum(len(camera.timesteps) for camera in footage.cameras)
        self._spans = stage_spans(images, absent)

    def report(self, stage: Stage, done: int, total: int) -> None:
        """Raises Cancelled when the report stops it."""
        begin, end = self._spans.get(stage, (stage.begin, stage.end))
        self._before = max(self._before, -math.floor(begin))
        at = begin + (end - begin) * done / max(total, 1)
        fraction = (at + self._before) / (1 / self._fraction + self._before)
        figures = {"left_s": self._time_left.after(fraction), **self._quality}
        detail = f"{done} of {total}" if total > 1 else ""
        self._now = Progress(fraction, stage.title, detail, lambda: figures)
        if self._report(self._now):
            raise Cancelled

    def show(self, draw: Draw, quality: Mapping[str, float]) -> None:
        self._quality = dict(quality)
        self._report(replace(self._now, picture=draw))


# From footage to an avatar


def make_avatar(request: MakeAvatar, report: Report, log: Log) -> Written:
    """Track unless that is done, then train or continue. Raises StgaError for other inputs."""
    capture = request.track.out
    run = request.train.run

    def report_tracking(progress: Progress) -> bool:
        fraction = TRACKING_FRACTION * progress.fraction
        stage = f"Tracking: {progress.stage}"
        figures = {"left_s": math.nan, **progress.figures()}
        figures["left_s"] += (request.train.settings.seconds or 0.0) + AFTER_S
        return report(replace(progress, fraction=fraction, stage=stage, figures=lambda: figures))

    def report_training(progress: Progress) -> bool:
        fraction = TRACKING_FRACTION + (1 - TRACKING_FRACTION) * progress.fraction
        return report(replace(progress, fraction=fraction))

    begin = perf_counter()
    check_inputs(request.track, request.takes)
    captures = _track_takes(request, report_tracking, log)
    tracked = perf_counter()
    flame = request.track.model if is_flame(capture) else None
    new = replace(request.train, flame=flame, takes=tuple(captures[1:]))
    trained = train_and_finish(resumed(new), report_training, log)
    tracking = tracked - begin
    training = perf_counter() - tracked
    lines = [""]
    for folder in captures:
        lines += _tracking_lines(folder)
    files = [folder / name for folder in captures for name in (SHEET_FILE, REPORT_FILE)]
    lines += [
        f"report: {', '.join(str(path) for path in (*files, run / CURVE) if path.exists())}",
        *trained.lines,
        f"time: tracking {format_duration(tracking)}, training {format_duration(training)}, "
        f"in all {format_duration(tracking + training)}",
    ]
    return Written(run / AVATAR, tuple(lines))


def _tracking_lines(capture: Path) -> list[str]:
    """What the report of a tracking says. Raises StgaError where it is malformed."""
    values = read_json(capture / REPORT_FILE)
    try:
        errors = values["reprojection_px"]
        timesteps = {timestep for by_timestep in errors.values() for timestep in by_timestep}
        timesteps |= set(map(str, values["interpolated"]))
        lines = [f"warning: {warning}" for warning in values["warnings"]]
        lines.append(f"footage: cameras {len(errors)}, timesteps {len(timesteps)}")
        median = f"{values['median_reprojection_px']:.2f} px (median)"
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise StgaError(
            f"{capture / REPORT_FILE}: is not the report of a tracking ({error!s:.100})"
        ) from error
    return [*lines, f"tracking: reprojection error {median}"]


def _track_takes(request: MakeAvatar, report: Report, log: Log) -> list[Path]:
    """The captures of all takes, that of CAPTURE_FOLDER first; those that are not there are
    tracked."""
    out = request.out
    is_new = not out.exists()
    if not (out / INPUTS).exists():
        write_json(out / INPUTS, _inputs(request.track, request.takes))
    try:
        tracks = _planned(request, report, log)
        for number, (take, known) in enumerate(tracks):

            def report_take(progress: Progress, before: int = number) -> bool:
                fraction = (before + progress.fraction) / len(tracks)
                return report(replace(progress, fraction=fraction))

            if not is_written(take.out):
                with hold_folder(take.out, LOCK_FILE, WRITER):
                    for line in _track_head(take, report_take, known).lines:
                        log(line)
    except (StgaError, OSError):
        # nothing was tracked yet, so that the inputs may be mended
        if not any(path.name != INPUTS for path in out.iterdir()):
            (out / INPUTS).unlink()
            if is_new:
                out.rmdir()
        raise
    return sorted((take.out for take, _ in tracks), key=lambda path: path != request.track.out)


def _planned(
    request: MakeAvatar, report: Report, log: Log
) -> list[tuple[Track, tuple[str, str] | None]]:
    """The takes in the order in which they are tracked, with what `take_of` found: one around a
    still head first, the others with its head. The first talk is in CAPTURE_FOLDER: it is what the
    avatar plays."""
    track = request.track
    if not request.takes:
        return [(track, None)]
    footage = [track.footage, *request.takes]
    found = _kinds(request, report, log)
    kinds = [kind for kind, _ in found]
    played = kinds.index("talk") if "talk" in kinds else 0
    person = kinds.index("around") if "around" in kinds else 0
    folders = [f"{CAPTURE_FOLDER}_{number + 1}" for number in range(1, len(footage))]
    folders.insert(played, CAPTURE_FOLDER)
    outs = [request.out / name for name in folders]
    order = [person, *(number for number in range(len(footage)) if number != person)]
    tracks = [
        replace(
            track,
            footage=footage[number],
            out=outs[number],
            avatar=None if number == person else outs[person],
            take="talk" if kinds[number] == "talk" else track.take,
        )
        for number in order
    ]
    return [(take, found[number]) for take, number in zip(tracks, order, strict=True)]


def _kinds(request: MakeAvatar, report: Report, log: Log) -> list[tuple[str, str]]:
    """What each take is, "around" or "talk": found out once and kept, or as given for the first, of
    which the others are none. With the reason, "" where it was given."""
    from ..tracking.around import take_of
    from ..tracking.footage.open import open_footage
    from ..tracking.stages import Workers

    track = request.track
    stored = read_inputs(request.out)
    footage = [track.footage, *request.takes]
    with suppress(TypeError, ValueError):  # none yet, or as earlier versions kept them
        known = [(str(kind), str(why)) for kind, why in stored.get(KINDS, ())]
        if len(known) == len(footage) and {kind for kind, _ in known} <= {*TAKES}:
            return known
    opened = [open_footage(path) for path in footage]
    if track.take != "auto":
        kinds = [(track.take, ""), *(("talk", "") for _ in request.takes)]
    else:
        kinds = []
        steps = _Steps(report)
        with Helpers() as helpers:
            for take, path in zip(opened, footage, strict=True):
                kind, why = take_of(take, Workers(helpers, steps.report, steps.show))
                kinds.append((kind, why))
                what = "around a still head" if kind == "around" else "a head that moves"
                log(f"take: {path.name}: {what} ({why})")
    write_json(request.out / INPUTS, {**stored, KINDS: kinds})
    return kinds


def check_inputs(track: Track, takes: Sequence[Path]) -> None:
    """Raise StgaError where the folder began with other inputs, or holds something else."""
    out = track.out.parent
    inputs = _inputs(track, takes)
    if (out / INPUTS).exists():
        stored = {"take": "auto", "takes": [], **read_inputs(out)}
        for name, value in inputs.items():
            before = stored.get(name)
            if before != value:
                raise StgaError(f"{name}: {out} began with {shorten(before)}; give another --out")
    elif is_written(track.out) or (out / RUN_FOLDER).exists():
        raise StgaError(f"{out}: holds something else ({INPUTS} is missing); give another --out")


def read_inputs(out: Path) -> dict[str, Any]:
    """Raises StgaError where inputs.json is missing or malformed."""
    values = read_json(out / INPUTS)
    if not isinstance(values, dict) or not isinstance(values.get("model", 0), str | None):
        raise StgaError(f"{out / INPUTS}: has no model; expected what `stga avatar` wrote")
    return values


def _inputs(track: Track, takes: Sequence[Path] = ()) -> dict[str, Any]:
    """What decides how it is tracked, as JSON: `Track` without its folder, and the footage of
    further takes; absolute paths."""
    values = {**vars(track), "offset": dict(sorted((track.offset or {}).items()))}
    del values["out"]
    values = {n: os.path.abspath(v) if isinstance(v, Path) else v for n, v in values.items()}
    return {**values, "takes": [os.path.abspath(take) for take in takes]}


# Further takes of an avatar


def extend(request: Extend, report: Report, log: Log) -> Written:
    """Extend a run. Takes that are footage are tracked by its avatar first, into captures beside
    the new run; those that are there already are used. Raises StgaError."""
    captures = list[Path]()
    for path in request.captures:
        captures.append(path)
        if is_footage(path):
            out = captures[-1] = request.run.with_name(f"{request.run.name}_{path.stem}")
            log(f"take: {path.name} is tracked by the avatar of {request.parent} into {out}")
            if not is_written(out):
                asked = Track(footage=path, model=None, out=out, avatar=request.parent)
                for line in track(asked, partial(_report_half, report, 0.0), log).lines:
                    log(line)
    if captures == list(request.captures):
        return train_and_finish(request, report, log)
    report_half = partial(_report_half, report, TRACKING_FRACTION)
    return train_and_finish(replace(request, captures=tuple(captures)), report_half, log)


def _report_half(report: Report, begin: float, progress: Progress) -> bool:
    """Report a half of the progress."""
    return report(replace(progress, fraction=begin + TRACKING_FRACTION * progress.fraction))


def is_footage(path: Path) -> bool:
    """Whether a path is that of a video or of one camera's images, and not of a capture."""
    from ..capture.transforms import transforms_files
    from ..tracking.footage.calibrations import find_calibration
    from ..tracking.footage.sources import find_sources, is_video

    if path.is_file():
        return is_video(path)
    is_capture = bool(transforms_files(path)) or (path / "meshes").is_dir()
    if not path.is_dir() or is_capture or find_calibration(path)[0] is not None:
        return False
    sources = find_sources(path)
    return bool(sources.videos or sources.folders)
