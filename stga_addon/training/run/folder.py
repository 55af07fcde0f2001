"""Folder of a training run (docs/formats.md#run-folder): its run.json, lock and smaller files, and
the capture that it was trained on."""

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from ...capture.model import Capture
from ...capture.open import open_capture, with_sequence
from ...capture.takes import first_timesteps, join_takes
from ...capture.transforms import PRINCIPAL_POINTS
from ...errors import StgaError
from ...files import (
    naming,
    read_document,
    read_npz,
    remove_leftovers,
    write_document,
    write_npz,
)
from ...flame.forward import FlameFrame, frame_of
from ...flame.sequence import FRAME_FIELDS, SHIFT_SIZE, TORSO_SHIFT, FlameSequence, motion_of
from ...raster.devices import EXPECTED_DEVICE, GPU, adapter_names, choose_device, is_device
from ...schema import from_json, setting, to_json
from ...worker.lock import hold_folder
from ..effect_catalog import EffectDecision
from ..settings import TrainingSettings
from .identity import RunIdentity, difference, identity_of

FORMAT = "stga-run"
"""Format that run.json names."""
VERSION = 8
"""Version of the format of runs."""
RUN = "run.json"
"""File with settings, identity and source of the run (`Run`)."""
AVATAR = "avatar.npz"
"""File with the trained avatar."""
CHECKPOINT = "checkpoint.npz"
"""File with the state that an interrupted training continues from."""
SELECTION = "selection.npz"
"""File with the triangles that train at each timestep."""
WORLD_FILE = "world.ply"
"""File with the splats of the static background."""
TRACKING = "tracking.npz"
"""File with the motion that was refined during training, and the tracked one."""
RESIDUALS = "residuals.npz"
"""File with the mean error of each triangle."""
MAX_FOLDERS_UP = 2
"""Levels of folders from the folder of a run, or of a .blend file, up to that of its project."""


@dataclass(frozen=True)
class Take:
    """A capture that joined a run later; `start` is added to its timesteps (`join_takes`)."""

    capture: Path
    start: int
    identity: RunIdentity


@dataclass(frozen=True)
class Continuation:
    """How a run continues another one.

    parent        folder of the run that it starts from
    avatar        SHA-256 of that run's avatar file
    first, last   timesteps whose views are trained; views of the others are replayed now and then
    """

    parent: Path
    avatar: str
    first: int
    last: int

    def check(self) -> None:
        """Raise StgaError where there is no timestep from first to last."""
        if self.first > self.last:
            raise StgaError(
                f"continuation: its last timestep {self.last} is before its first, {self.first}"
            )

    def includes(self, timestep: int) -> bool:
        return self.first <= timestep <= self.last


@dataclass(frozen=True)
class Run:
    """What run.json holds.

    capture, flame   absolute paths of the capture and of the FLAME model file
    principal_point  convention of the capture
    effect_plan      what was decided about effects
    device           one of `choose_device` that trains
    identity         None before training begins
    takes            further captures of the same head, whose timesteps follow those of `capture`
                     (`join_takes`)
    continuation     how the run continues another one; None: it began with new splats
    """

    capture: Path
    flame: Path | None
    principal_point: str = setting(choices=PRINCIPAL_POINTS)
    settings: TrainingSettings = setting()
    effect_plan: tuple[EffectDecision, ...] = ()
    device: str = setting("cpu", accepts=is_device, expected=EXPECTED_DEVICE)
    identity: RunIdentity | None = field(default=None, compare=False)
    takes: tuple[Take, ...] = ()
    continuation: Continuation | None = None

    @property
    def digest(self) -> str:
        """Digest of the identity of a run that has begun."""
        assert self.identity is not None
        return self.identity.digest

    def take_at(self, timestep: int) -> int:
        """Which take a timestep is of; 0 is `capture`."""
        return sum(take.start <= timestep for take in self.takes)

    def by_take(self, timesteps: Iterable[int]) -> list[list[int]]:
        """Timesteps of each take that has some."""
        found: dict[int, list[int]] = {}
        for timestep in timesteps:
            found.setdefault(self.take_at(timestep), []).append(timestep)
        return [found[take] for take in sorted(found)]


def write_run(folder: Path, run: Run) -> None:
    values = to_json(run)
    write_document(folder / RUN, FORMAT, VERSION, values)


def has_run(folder: Path) -> bool:
    return (folder / RUN).exists()


def read_run(folder: Path) -> Run:
    """The run, with the paths of a project that was moved as a whole. Raises StgaError where the
    folder holds no run, a damaged one or one of another version."""
    if not has_run(folder):
        raise StgaError(f"{folder}: holds no run ({RUN} is missing)")
    path = folder / RUN
    with naming(path, "read"):
        state = path.stat()
    run = _remembered(path, state.st_ino, state.st_mtime_ns, state.st_size)
    found = partial(_moved_with, folder.absolute())
    takes = tuple(replace(take, capture=found(take.capture)) for take in run.takes)
    further = run.continuation
    if further is not None:
        further = replace(further, parent=found(further.parent))
    flame = None if run.flame is None else found(run.flame)
    capture = found(run.capture)
    return replace(run, capture=capture, flame=flame, takes=takes, continuation=further)


def _moved_with(run: Path, path: Path) -> Path:
    """A path that a run stores: where nothing is there, what has its name and as many of its
    folders' as possible beside the run, or above that."""
    places = (
        above.joinpath(*path.parts[first:])
        for first in range(1, 0 if os.path.exists(path) else len(path.parts))
        for above in run.parents[: MAX_FOLDERS_UP + 1]
    )
    return next((each for each in places if each != run and os.path.exists(each)), path)


@lru_cache(maxsize=8)
def _remembered(path: Path, *state: int) -> Run:
    """The run of a file in this state: a training asks at each evaluation whether the folder is
    still its own."""
    found: Run = from_json(Run, read_document(path, "run", FORMAT, VERSION), path)
    return found


def next_folder(run: Path) -> Path:
    """The first of RUN_2, RUN_3, … that does not exist; after RUN_2 comes RUN_3."""
    run = run.resolve()
    match = re.fullmatch(r"(.+?)_(\d{1,6})", run.name, re.ASCII)
    name, number = (match[1], int(match[2])) if match else (run.name, 1)
    while True:
        number += 1
        folder = run.with_name(f"{name}_{number}")
        if not folder.exists():
            return folder


@contextmanager
def claimed_folder(run: Path) -> Iterator[Path]:
    """Make and yield `next_folder`, which no other process gets; removed where it stays empty.
    Raises StgaError where none can be made."""
    is_made = False
    while not is_made:
        folder = next_folder(run)
        with naming(folder), suppress(FileExistsError):  # another process was faster
            folder.mkdir()
            is_made = True
    try:
        yield folder
    finally:
        with suppress(OSError):  # it holds the run
            folder.rmdir()


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder for one process, and clear away what a killed one left half written. Raises
    StgaError while another process holds it."""
    with hold_folder(folder, "run.lock", "run is working in this folder"):
        remove_leftovers(folder)
        yield


@dataclass(frozen=True)
class OpenedRun:
    """A run and its capture. `run` has the paths of `capture` and FLAME model that were opened.

    takes  the captures that `capture` is joined from
    """

    run: Run
    capture: Capture
    takes: tuple[Capture, ...]


def open_run(
    folder: Path,
    capture: Path | None = None,
    flame: Path | None = None,
    principal_point: str | None = None,
) -> OpenedRun:
    """Open the run in `folder`; the other arguments stand in for what it was trained with.

    A capture or a FLAME model may have moved, but not changed; tracked meshes may be refined.
    Raises StgaError in one sentence where the folder holds no run or anything differs from what it
    was trained with.
    """
    run = read_run(folder)
    if principal_point not in (None, run.principal_point):
        raise StgaError(
            f"{folder}: was trained with principal point '{run.principal_point}', not "
            f"'{principal_point}'"
        )
    flame = run.flame if flame is None else flame.resolve()
    first = open_capture(run.capture if capture is None else capture, flame, run.principal_point)
    run = replace(run, capture=first.root, flame=flame)
    takes = [first]
    for take in run.takes:
        takes.append(open_capture(take.capture, run.flame, run.principal_point))
        given = identity_of(takes[-1], run.principal_point, run.settings)
        changed = difference(take.identity, given)
        if changed is not None:
            raise StgaError(
                f"{folder}: was extended with {take.capture} ({take.identity.summary}), but it "
                f"now {changed}"
            )
    opened = join_takes(takes)
    check_identity(folder, run, opened)
    if run.continuation is not None:  # it was trained on the meshes that the run before has refined
        opened = with_refined_tracking(opened, folder, fitted=False)
    return OpenedRun(run, opened, tuple(takes))


def named_takes(every: Sequence[Capture], first: int, run: Run) -> tuple[Take, ...]:
    """As a run keeps them, those of all of its captures from the `first` on."""
    starts = first_timesteps(every)
    return tuple(
        Take(take.root, start, identity_of(take, run.principal_point, run.settings))
        for take, start in list(zip(every, starts, strict=True))[first:]
    )


def avatar_version(run: Path) -> list[str]:
    """A run's avatar, and when it was written; of a run that has one."""
    file = (run / AVATAR).resolve()
    return [str(file), str(file.stat().st_mtime_ns)]


def open_refined(folder: Path, capture: Path | None = None, flame: Path | None = None) -> Capture:
    """A run's capture with the parameters that it refined. Errors as of `open_run`."""
    if not folder.is_dir():
        raise StgaError(f"{folder}: is not a folder; expected that of a run")
    return with_refined_tracking(open_run(folder, capture, flame).capture, folder)


def check_identity(folder: Path, run: Run, capture: Capture) -> RunIdentity:
    """The identity of `run` on `capture`, as the folder's files carry it.

    Raises StgaError where the folder holds a run that was begun with another one; the sentence
    names both sides.
    """
    given = identity_of(capture, run.principal_point, run.settings)
    if not has_run(folder):
        return given
    stored = read_run(folder)
    trained = stored.identity
    if trained is None or trained == given:  # None: the run was prepared, but has not begun
        return given
    changed = difference(trained, given)
    if trained.principal_point != given.principal_point:
        point = given.principal_point
        was = f"trained with principal point '{trained.principal_point}', not '{point}'"
    elif "" not in (trained.flame, given.flame) and trained.flame != given.flame:
        was = f"trained with FLAME model {stored.flame}, but {run.flame} has other content"
    elif changed is not None:
        where = "it now" if capture.root == stored.capture else f"{capture.root} ({given.summary})"
        was = f"trained on {stored.capture} ({trained.summary}), but {where} {changed}"
    else:
        was = "begun with other settings; restore them in run.json, or"
        raise StgaError(f"{folder}: was {was} train into another folder")
    raise StgaError(f"{folder}: was {was}; train into another folder")


def device_of(run: Run, requested: str = "auto") -> tuple[str, str]:
    """The device to continue a run on, and why: its own, or the first GPU where this machine lacks
    that one, unless `requested` names another (`choose_device`). Raises StgaError where it does not
    work or cannot train this run."""
    trained_on = run.device
    has_adapter = False
    with suppress(StgaError):  # where there is no GPU at all
        named = trained_on.removeprefix(GPU)
        has_adapter = trained_on.startswith(GPU) and named in adapter_names()
    if not has_adapter:
        trained_on = trained_on.partition(":")[0]
    try:
        device, reason = choose_device(trained_on if requested == "auto" else requested)
    except StgaError as error:
        if requested != "auto":
            raise
        raise StgaError(
            f"this run was trained on {trained_on}: {error}; give --device cpu to continue on "
            "the CPU"
        ) from error
    if run.settings.tracking and device != "cpu":
        raise StgaError(
            f"--device {requested}: this run refines the tracking, which works on the CPU only"
        )
    return device, reason


def write_tracking(
    folder: Path, sequence: FlameSequence, refined: np.ndarray, tracked: np.ndarray
) -> None:
    """Write `RefinedTracking.parameters` (T, P + 3), and those tracked (T, P), of a sequence."""
    frame = frame_of(refined[:, :-SHIFT_SIZE].T)
    arrays = {name: getattr(frame, name).T for name in FRAME_FIELDS}
    arrays["shape"] = sequence.shape
    if sequence.static_offset is not None:
        arrays["static_offset"] = sequence.static_offset
    arrays["timesteps"] = np.array(sequence.timesteps)
    arrays["tracked"] = tracked
    arrays[TORSO_SHIFT] = refined[:, -SHIFT_SIZE:]
    write_npz(folder / TRACKING, arrays, compressed=True)


def read_tracking(folder: Path, sequence: FlameSequence) -> np.ndarray:
    """(T, P + 3) that `write_tracking` wrote for the sequence. Raises StgaError if damaged."""
    path = folder / TRACKING
    arrays = read_npz(path)
    motion = motion_of(path, arrays, sequence.model)
    shift = arrays.get(TORSO_SHIFT)
    if motion.timesteps != sequence.timesteps or shift is None:
        raise StgaError(f"{path}: expected {TORSO_SHIFT} and the timesteps of the run's capture")
    parameters = [motion.frame(timestep).parameters for timestep in motion.timesteps]
    return np.concatenate([np.stack(parameters), shift], axis=1)


def with_refined_tracking(capture: Capture, folder: Path, fitted: bool = True) -> Capture:
    """The capture with the parameters that the run in `folder` refined, in the timesteps whose
    tracked parameters are those that the run started from: another capture stays unchanged. Raises
    StgaError if the run's file is damaged.

    fitted: also in timesteps without training views, whose heads the avatar has fitted to the very
    images that it is measured by.
    """
    path = folder / TRACKING
    sequence = capture.flame
    if sequence is None or not path.exists():
        return capture
    arrays = read_npz(path)
    motion = motion_of(path, arrays, sequence.model)
    count = len(motion.timesteps)
    tracked = arrays.get("tracked", np.zeros(0))
    if len(tracked) != count:
        raise StgaError(
            f"{path}: tracked has shape {tracked.shape}, expected {count} timesteps first"
        )
    before = dict(zip(motion.timesteps, tracked, strict=True))
    if not fitted:
        trained = {view.timestep for view in capture.views.get("train", ())}
        before = {timestep: values for timestep, values in before.items() if timestep in trained}

    def frame(timestep: int) -> FlameFrame:
        found = sequence.frame(timestep)
        if timestep not in before or not np.array_equal(found.parameters, before[timestep]):
            return found
        refined = motion.frame(timestep)
        offsets = [
            frame.dynamic_offset for frame in (found, refined) if frame.dynamic_offset is not None
        ]
        return replace(refined, dynamic_offset=np.sum(offsets, axis=0) if offsets else None)

    return with_sequence(capture, replace(sequence, frame=frame))


def write_residuals(folder: Path, mean: np.ndarray) -> None:
    """Write mean (F,): mean absolute error (0…1) by triangle, NaN where that is unknown."""
    write_npz(folder / RESIDUALS, {"residual": mean.astype(np.float32)}, compressed=True)


def read_residuals(folder: Path, faces: int) -> np.ndarray:
    """(F,) float32. Raises StgaError where there is no such file, or of another mesh."""
    path = folder / RESIDUALS
    found = read_npz(path).get("residual", np.zeros(0))
    if found.dtype != np.float32 or found.shape != (faces,):
        raise StgaError(
            f"{path}: expected 'residual', float32 {(faces,)}, found {found.dtype} {found.shape}"
        )
    return found
