"""Folder of a training run: run.json, and the lock of the process that trains.

run.json        what is trained, with which settings
selection.npz   timestep -> selected triangles
checkpoint.npz  the whole state of training
avatar.npz      the sharpest avatar so far, by the evaluation views; without them, or continuing a run, the latest
strain_range.npz  strain that colors and positions follow; only where they do, and the tracking is not refined
tracking.npz    refined FLAME parameters, those that avatar.npz was trained with
metrics.jsonl   one line per evaluation
residuals.npz   of a finished run: error of the avatar on each triangle
world.ply       what stands still behind the person, in world space; only where the effect `world` is on
"""

import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from ...capture.transforms import PRINCIPAL_POINTS
from ...errors import StgaError, shorten
from ...files import read_json, remove_leftovers, write_json
from ...render.device import EXPECTED_DEVICE, is_device
from ...schema import complaint, from_json, setting, to_json
from ...worker.lock import hold_lock, lock_owner
from ..effect_decisions import EffectDecision
from ..settings import TrainingSettings
from .identity import LATER_SETTINGS, RunIdentity

FORMAT, VERSION = "stga-run", 5
OLDEST_VERSION = 4
"""Read as well: LATER_SETTINGS are all that it lacks."""
RUN, AVATAR, CHECKPOINT, SELECTION = "run.json", "avatar.npz", "checkpoint.npz", "selection.npz"
WORLD_FILE = "world.ply"


@dataclass(frozen=True)
class Take:
    """A capture that joined a run after its first one; `start` is added to its timesteps (`join_takes`)."""

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
            raise StgaError(f"continuation: its last timestep {self.last} is before its first, {self.first}")

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
    takes            further captures of the same head, whose timesteps follow those of `capture` (`join_takes`)
    continuation     how the run continues another one; None: it began with new splats
    """

    capture: Path
    flame: Path | None
    principal_point: str
    settings: TrainingSettings
    effect_plan: tuple[EffectDecision, ...] = ()
    device: str = setting("cpu", accepts=is_device, expected=EXPECTED_DEVICE)
    identity: RunIdentity | None = field(default=None, compare=False)
    takes: tuple[Take, ...] = ()
    continuation: Continuation | None = None

    def check(self) -> None:
        """Raise StgaError for a convention of principal points that is none."""
        if self.principal_point not in PRINCIPAL_POINTS:
            expected = f"one of {', '.join(PRINCIPAL_POINTS)}"
            raise StgaError(complaint("principal_point", expected, self.principal_point))


def write_run(folder: Path, run: Run) -> None:
    write_json(folder / RUN, {"format": FORMAT, "version": VERSION, **to_json(run)})


def has_run(folder: Path) -> bool:
    return (folder / RUN).exists()


def read_run(folder: Path) -> Run:
    """Raises StgaError where the folder holds no run, a damaged one or one of another version."""
    path = folder / RUN
    if not path.exists():
        raise StgaError(f"{folder}: holds no run ({RUN} is missing)")
    values = read_json(path)
    if not isinstance(values, dict) or values.pop("format", None) != FORMAT:
        raise StgaError(f"{path}: is not a run of this add-on (format is not '{FORMAT}')")
    version = values.pop("version", None)
    if version not in (OLDEST_VERSION, VERSION):
        reads = f"{OLDEST_VERSION} and {VERSION}"
        raise StgaError(f"{path}: has run format version {shorten(version)}, this add-on reads {reads}")
    if version == OLDEST_VERSION and isinstance(values.get("settings"), dict):
        values["settings"].update({name: getattr(TrainingSettings, name) for name in LATER_SETTINGS})
    try:
        run: Run = from_json(Run, values)
    except StgaError as error:
        raise StgaError(f"{path}: {error}") from error
    return run


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
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder for one process, and clear away what a killed one left half written.

    Raises StgaError while another process holds the folder.
    """
    path = folder / "run.lock"
    with ExitStack() as lock:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock.enter_context(hold_lock(path))
        except BlockingIOError as error:
            raise StgaError(f"{folder}: another run is working in this folder (process {lock_owner(path)})") from error
        except OSError as error:
            raise StgaError(f"{folder}: cannot be written ({error.strerror or error})") from error
        remove_leftovers(folder)
        yield
