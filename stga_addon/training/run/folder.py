"""A run's folder: what it is, who is working in it, and from where it can go on.

run.json        what is trained, with which settings
selection.npz   timestep -> selected triangles
checkpoint.npz  the whole state of training, replaced as a whole
avatar.npz      the best avatar so far, by the held-out views
tracking.npz    where FLAME's parameters are refined, those that avatar.npz was trained with (`tracking`)
metrics.jsonl   one line per evaluation
"""

import json
import math
import re
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
import torch

from ...avatar.embedding import CONVENTIONS
from ...avatar.file import SH_SIZES
from ...avatar.splats import MAX_SH_DEGREE
from ...avatar.strain import STRAINS
from ...errors import StgaError
from ...files import read_json, read_npz, remove_leftovers, replacing, write_json, write_npz
from ...worker.lock import hold_lock, lock_owner
from ..effect_plan import EffectDecision, effect_plan_from_json, effect_plan_to_json
from ..optimize.state import TrainState, state_of, tensors_of
from ..optimize.tracking import RefinementState
from ..settings import SCHEDULES, STRATEGIES, TrainingSettings, from_json, to_json
from .metrics_log import METRICS, read_metrics

FORMAT, VERSION = "stga-run", 1
REFINEMENT = "tracking/"


@dataclass(frozen=True)
class Run:
    """What run.json holds: absolute paths of the capture and of the FLAME model, the settings, and what was decided
    about effects."""

    capture: Path
    flame: Path | None
    principal_point: str
    settings: TrainingSettings
    effect_plan: tuple[EffectDecision, ...] = ()


@dataclass
class Checkpoint:
    """Where training stands.

    elapsed_s  seconds of training so far, evaluation not counted
    best_psnr  of avatar.npz, dB; −inf before the first evaluation
    losses     of the last global iterations
    tracking   where FLAME's parameters are refined
    """

    state: TrainState
    iteration: int
    visit: int
    last_timestep: int | None
    initial_count: int
    elapsed_s: float
    best_psnr: float
    evaluations: int
    losses: list[float]
    tracking: RefinementState | None = None


def write_run(folder: Path, run: Run) -> None:
    write_json(
        folder / "run.json",
        {
            "format": FORMAT,
            "version": VERSION,
            "capture": str(run.capture),
            "flame": None if run.flame is None else str(run.flame),
            "principal_point": run.principal_point,
            "settings": to_json(run.settings),
            "effect_plan": effect_plan_to_json(run.effect_plan),
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
        raise StgaError(f"{path}: was written by run format {values.get('version')!r}, this version reads {VERSION}")
    try:
        flame = values["flame"]
        settings = from_json(values["settings"])
        _check_settings(settings)
        plan = effect_plan_from_json(values.get("effect_plan", []))
        model = None if flame is None else Path(flame)
        return Run(Path(values["capture"]), model, str(values["principal_point"]), settings, plan)
    except (KeyError, TypeError, ValueError) as error:
        raise StgaError(f"{path}: a field is missing or malformed ({error})") from error


def _check_settings(settings: TrainingSettings) -> None:
    """Raise ValueError for a number that training could not work with, or that would fill the memory."""
    budget = settings.iterations if settings.seconds is None else settings.seconds
    if budget is None or not 0 < budget < math.inf or (settings.seconds is None) == (settings.iterations is None):
        raise ValueError(f"budget of {settings.seconds} seconds and {settings.iterations} iterations")
    for name, allowed in _CHOICES.items():
        if getattr(settings, name) not in allowed:
            raise ValueError(f"{name} is {getattr(settings, name)!r}")
    for name, (low, high) in _RANGES.items():
        value = getattr(settings, name)
        numbers = value if isinstance(value, tuple) else (value,)
        if value is not None and not all(low <= number <= high for number in numbers):
            raise ValueError(f"{name} is {value!r}, expected {low} to {high}")
    if len(settings.density_span) != 2 or len(settings.background) != 3:
        raise ValueError("density_span or background has another length")
    for row in settings.exposure:
        if len(row) != 7 or not all(map(math.isfinite, row)) or min(row[1:4]) <= 0:
            raise ValueError(f"exposure has the row {row!r}")


_CHOICES: dict[str, Collection[str]] = {"strategy": STRATEGIES, "schedule": SCHEDULES, "convention": CONVENTIONS}
_RANGES: dict[str, tuple[float, float]] = {
    "seed": (0, math.inf),
    "lattice": (0, 16),
    "sh_degree": (0, MAX_SH_DEGREE),
    "views_per_visit": (0, math.inf),
    "global_interval": (1, math.inf),
    "density_interval": (0, math.inf),
    "stray_reset_interval": (0, math.inf),
    "ema_share": (0, 1),
    "stray_reset_share": (0, 1),
    "growth": (0, 100),
    "warm_up_share": (0, 1),
    "ssim_weight": (0, 1),
    "sh_steps": (0, math.inf),
    "density_span": (0, math.inf),
    "background": (0, 1),
    "scale": (0.05, 1),
    "coarse_share": (0, 1),
    "target_psnr": (0, 200),
}


def write_selection(folder: Path, selection: dict[int, np.ndarray]) -> None:
    write_npz(folder / "selection.npz", {f"{t:05d}": faces for t, faces in selection.items()}, compressed=True)


def read_selection(folder: Path, faces: int) -> dict[int, np.ndarray]:
    """timestep -> (F,) bool. Raises StgaError where the file does not fit the mesh."""
    path = folder / "selection.npz"
    selection = {}
    for name, mask in read_npz(path, max_compression=faces // 100 + 16).items():  # an entry of a zip has some 200 bytes
        if not re.fullmatch(r"\d{1,18}", name, re.ASCII) or mask.dtype != bool or mask.shape != (faces,):
            raise StgaError(f"{path}: '{name}' is {mask.dtype} {mask.shape}, expected bool ({faces},) by timestep")
        selection[int(name)] = mask
    return selection


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Replace the checkpoint as a whole. Gradients are not kept: they are overwritten before they are read."""
    arrays = {k: t.numpy() for k, t in tensors_of(checkpoint.state).items() if not k.startswith("gradients/")}
    if checkpoint.tracking is not None:
        arrays.update({REFINEMENT + name: array for name, array in vars(checkpoint.tracking).items()})
    values = {k: v for k, v in vars(checkpoint).items() if k not in ("state", "tracking")}
    arrays["meta"] = np.frombuffer(json.dumps({"version": VERSION, **values}).encode(), np.uint8)
    write_npz(folder / "checkpoint.npz", arrays)


def read_checkpoint(folder: Path) -> Checkpoint:
    """Raises StgaError where there is none or it is damaged."""
    path = folder / "checkpoint.npz"
    arrays = read_npz(path)
    try:
        meta = _meta(arrays.pop("meta"))
        if meta.pop("version") != VERSION:
            raise StgaError(f"{path}: was written by another version")
        refinement = _refinement(path, arrays)
        tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
        for name in [n for n in tensors if n.startswith("first/")]:
            tensors[name.replace("first/", "gradients/")] = torch.zeros_like(tensors[name])
        if any(tensor.ndim == 0 for tensor in tensors.values()):
            raise StgaError(f"{path}: an array has no rows")
        state = state_of(tensors)
        _check_state(path, state)
        return Checkpoint(state=state, tracking=refinement, **meta)
    except (KeyError, IndexError, TypeError, ValueError, RecursionError) as error:
        raise StgaError(f"{path}: a field is missing or malformed ({error})") from error


def _meta(packed: np.ndarray) -> dict[str, Any]:
    """Everything of a checkpoint that is no array. Raises ValueError for what training could not go on with."""
    meta = json.loads(packed.tobytes())
    if not isinstance(meta, dict):
        raise ValueError("meta is no object")
    counts = [meta.get(name) for name in ("iteration", "visit", "initial_count", "evaluations")]
    last = meta.get("last_timestep")
    if any(type(count) is not int or not -1 <= count < 1 << 62 for count in counts) or type(last) not in (
        int,
        NoneType,
    ):
        raise ValueError(f"meta counts {counts}, last timestep {last!r}")
    numbers = [meta.get("elapsed_s"), meta.get("best_psnr"), *meta.get("losses", [None])]
    if any(type(number) not in (int, float) or math.isnan(number) for number in numbers):
        raise ValueError("meta holds a time, a quality or a loss that is no number")
    return meta


def _check_state(path: Path, state: TrainState) -> None:
    """Kernels trust shapes and types, so a checkpoint's are checked. Raises StgaError naming the array."""
    n, coefficients = len(state), state.parameters.sh.shape[1]
    if coefficients not in SH_SIZES:
        raise StgaError(f"{path}: parameters/sh has {coefficients} coefficients, expected one of {SH_SIZES}")
    strains = STRAINS if state.parameters.strain_color.shape[1] else 0
    tails = {"xyz": (3,), "rotation": (4,), "log_scale": (3,), "sh": (coefficients, 3), "strain_color": (strains, 3)}
    whole = {"steps": torch.int32, "face": torch.int32, "unbound": torch.bool}
    for name, tensor in tensors_of(state).items():
        dtype = whole.get(name, torch.float32)
        shape = (n, *tails.get(name.rpartition("/")[2], ()))
        if tensor.dtype != dtype or tuple(tensor.shape) != shape:
            raise StgaError(f"{path}: {name} is {tensor.dtype} {tuple(tensor.shape)}, expected {dtype} {shape}")
        if dtype == torch.float32 and not tensor.isfinite().all():
            raise StgaError(f"{path}: {name} holds a value that is not finite")


def _refinement(path: Path, arrays: dict[str, np.ndarray]) -> RefinementState | None:
    """Taken out of a checkpoint's arrays, None where there is none. Raises StgaError naming an array that is wrong."""
    names = [name for name in arrays if name.startswith(REFINEMENT)]
    if not names:
        return None
    found = RefinementState(**{name.removeprefix(REFINEMENT): arrays.pop(name) for name in names})
    whole = found.change.shape
    if len(whole) != 2:
        raise StgaError(f"{path}: {REFINEMENT}change has shape {whole}, expected (timesteps, numbers)")
    shapes = {"change": whole, "first": whole, "second": whole[1:], "steps": whole[:1]}
    for name, array in vars(found).items():
        dtype = np.dtype(np.int64 if name == "steps" else np.float64)
        if array.dtype != dtype or array.shape != shapes[name]:
            expected = f"{dtype} {shapes[name]}"
            raise StgaError(f"{path}: {REFINEMENT}{name} is {array.dtype} {array.shape}, expected {expected}")
        if not np.isfinite(array).all():
            raise StgaError(f"{path}: {REFINEMENT}{name} holds a value that is not finite")
    return found


def append_metrics(folder: Path, line: dict[str, Any]) -> None:
    try:
        with (folder / METRICS).open("a", encoding="utf-8") as out:
            out.write(json.dumps(line) + "\n")
    except OSError as error:
        raise StgaError(f"{folder / 'metrics.jsonl'}: cannot be written ({error.strerror})") from error


def cut_metrics(folder: Path, iteration: int) -> None:
    """Forget evaluations after `iteration`: a resumed run makes them again."""
    kept = [line for line in read_metrics(folder) if line["iteration"] <= iteration]
    with replacing(folder / METRICS) as partial:
        partial.write_text("".join(json.dumps(line) + "\n" for line in kept), encoding="utf-8")


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
