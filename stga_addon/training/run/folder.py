"""Folder of a training run: run.json, and the lock of the process that trains.

run.json        what is trained, with which settings
selection.npz   timestep -> selected triangles
checkpoint.npz  the whole state of training
avatar.npz      the sharpest avatar so far, by the evaluation views; without them, or continuing a run, the latest
strain_range.npz  strain that colors and positions follow; only where they do, and the tracking is not refined
tracking.npz    refined FLAME parameters, those that avatar.npz was trained with
metrics.jsonl   one line per evaluation
residuals.npz   of a finished run: error of the avatar on each triangle
"""

import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ...capture.transforms import PRINCIPAL_POINTS
from ...errors import StgaError, shorten
from ...files import read_json, remove_leftovers, write_json
from ...render.device import is_device
from ...worker.lock import hold_lock, lock_owner
from ..effects.decisions import EffectDecision, effect_plan_from_json, effect_plan_to_json
from ..settings import TrainingSettings, from_json, to_json
from .identity import Identity, identity_from_json

FORMAT, VERSION = "stga-run", 3
CHECKPOINT, SELECTION = "checkpoint.npz", "selection.npz"


@dataclass(frozen=True)
class Take:
    """A capture that joined a run after its first one; `start` is added to its timesteps (`join_takes`)."""

    capture: Path
    start: int
    identity: Identity


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
    device: str = "cpu"
    identity: Identity | None = field(default=None, compare=False)
    takes: tuple[Take, ...] = ()
    continuation: Continuation | None = None


def write_run(folder: Path, run: Run) -> None:
    write_json(
        folder / "run.json",
        {
            "format": FORMAT,
            "version": VERSION,
            "capture": str(run.capture),
            "flame": None if run.flame is None else str(run.flame),
            "principal_point": run.principal_point,
            "device": run.device,
            "settings": to_json(run.settings),
            "effect_plan": effect_plan_to_json(run.effect_plan),
            "identity": None if run.identity is None else asdict(run.identity),
            "takes": [{**asdict(take), "capture": str(take.capture)} for take in run.takes],
            "continuation": _continuation_to_json(run.continuation),
        },
    )


def read_run(folder: Path) -> Run:
    """Raises StgaError where the folder holds no run, a damaged one or one of another version."""
    path = folder / "run.json"
    if not path.exists():
        raise StgaError(f"{folder}: holds no run (run.json is missing)")
    values = read_json(path)
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise StgaError(f"{path}: is not a run of this add-on (format is not '{FORMAT}')")
    if values.get("version") != VERSION:
        found = shorten(values.get("version"))
        raise StgaError(f"{path}: has run format version {found}, this add-on reads {VERSION}")
    try:
        flame, device, principal_point = values["flame"], values["device"], values["principal_point"]
        if principal_point not in PRINCIPAL_POINTS:
            raise ValueError(f"principal_point is {shorten(principal_point)}")
        if not is_device(device):
            raise ValueError(f"device is {shorten(device)}")
        return Run(
            Path(values["capture"]),
            None if flame is None else Path(flame),
            principal_point,
            from_json(values["settings"]),
            effect_plan_from_json(values["effect_plan"]),
            device,
            identity_from_json(values["identity"]),
            tuple(_take_from_json(take) for take in values["takes"]),
            _continuation_from_json(values["continuation"]),
        )
    except StgaError as error:
        raise StgaError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise StgaError(f"{path}: a field is missing or malformed ({error!s:.200})") from error


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


def _take_from_json(values: Any) -> Take:
    identity = identity_from_json(values["identity"])
    if identity is None or type(values["start"]) is not int:
        raise ValueError(f"takes holds {shorten(values)}")
    return Take(Path(values["capture"]), values["start"], identity)


def _continuation_to_json(continuation: Continuation | None) -> dict[str, Any] | None:
    return None if continuation is None else {**vars(continuation), "parent": str(continuation.parent)}


def _continuation_from_json(values: Any) -> Continuation | None:
    if values is None:
        return None
    continuation = Continuation(**{**values, "parent": Path(values["parent"])})
    span = continuation.first, continuation.last
    if not isinstance(continuation.avatar, str) or not all(type(n) is int for n in span) or span[0] > span[1]:
        raise ValueError(f"continuation is {shorten(values)}")
    return continuation


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
