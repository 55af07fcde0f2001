"""A run's folder: what it is, who is working in it, and from where it can go on.

run.json        what is trained, with which settings
selection.npz   timestep -> selected triangles
checkpoint.npz  the whole state of training, replaced as a whole
avatar.npz      the best avatar so far, by the held-out views
metrics.jsonl   one line per evaluation
"""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..errors import StgaError
from ..files import read_json, read_npz, replacing, write_json, write_npz
from .settings import Settings, from_json, to_json
from .state import TrainState, state_of, tensors_of

FORMAT, VERSION = "stga-run", 1


@dataclass(frozen=True)
class Run:
    """What run.json holds: absolute paths of the capture and of the FLAME model, and the settings."""

    capture: Path
    flame: Path | None
    principal_point: str
    settings: Settings


@dataclass
class Checkpoint:
    """Where training stands.

    elapsed_s  seconds of training so far, evaluation not counted
    best_psnr  of avatar.npz, dB; −inf before the first evaluation
    losses     of the last global iterations
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
        return Run(
            Path(values["capture"]),
            None if flame is None else Path(flame),
            str(values["principal_point"]),
            from_json(values["settings"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise StgaError(f"{path}: a field is missing or malformed ({error})") from error


def write_selection(folder: Path, selection: dict[int, np.ndarray]) -> None:
    write_npz(folder / "selection.npz", {f"{t:05d}": faces for t, faces in selection.items()}, compressed=True)


def read_selection(folder: Path, faces: int) -> dict[int, np.ndarray]:
    """timestep -> (F,) bool. Raises StgaError where the file does not fit the mesh."""
    path = folder / "selection.npz"
    selection = {}
    for name, mask in read_npz(path).items():
        if not name.isdigit() or mask.dtype != bool or mask.shape != (faces,):
            raise StgaError(f"{path}: '{name}' is {mask.dtype} {mask.shape}, expected bool ({faces},) by timestep")
        selection[int(name)] = mask
    return selection


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Replace the checkpoint as a whole. Gradients are not kept: they are overwritten before they are read."""
    arrays = {k: t.numpy() for k, t in tensors_of(checkpoint.state).items() if not k.startswith("gradients/")}
    values = {k: v for k, v in vars(checkpoint).items() if k != "state"}
    arrays["meta"] = np.frombuffer(json.dumps({"version": VERSION, **values}).encode(), np.uint8)
    write_npz(folder / "checkpoint.npz", arrays)


def read_checkpoint(folder: Path) -> Checkpoint:
    """Raises StgaError where there is none or it is damaged."""
    path = folder / "checkpoint.npz"
    arrays = read_npz(path)
    try:
        meta: dict[str, Any] = json.loads(arrays.pop("meta").tobytes())
        if meta.pop("version") != VERSION:
            raise StgaError(f"{path}: was written by another version")
        tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
        for name in [n for n in tensors if n.startswith("first/")]:
            tensors[name.replace("first/", "gradients/")] = torch.zeros_like(tensors[name])
        if any(tensor.ndim == 0 for tensor in tensors.values()):
            raise StgaError(f"{path}: an array has no rows")
        state = state_of(tensors)
        _check_state(path, state)
        return Checkpoint(state=state, **meta)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise StgaError(f"{path}: a field is missing or malformed ({error})") from error


def _check_state(path: Path, state: TrainState) -> None:
    """Kernels trust shapes and types, so a checkpoint's are checked. Raises StgaError naming the array."""
    n, coefficients = len(state), state.parameters.sh.shape[1]
    tails = {"xyz": (3,), "rotation": (4,), "log_scale": (3,), "opacity": (), "sh": (coefficients, 3)}
    whole = {"steps": torch.int32, "face": torch.int32, "loose": torch.bool}
    for name, tensor in tensors_of(state).items():
        dtype = whole.get(name, torch.float32)
        shape = (n, *tails.get(name.rpartition("/")[2], ()))
        if tensor.dtype != dtype or tuple(tensor.shape) != shape:
            raise StgaError(f"{path}: {name} is {tensor.dtype} {tuple(tensor.shape)}, expected {dtype} {shape}")


def append_metrics(folder: Path, line: dict[str, Any]) -> None:
    try:
        with (folder / "metrics.jsonl").open("a", encoding="utf-8") as out:
            out.write(json.dumps(line) + "\n")
    except OSError as error:
        raise StgaError(f"{folder / 'metrics.jsonl'}: cannot be written ({error.strerror})") from error


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """All complete lines; a last line cut off by a kill is left out."""
    path = folder / "metrics.jsonl"
    lines = []
    for text in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            lines.append(json.loads(text))
        except ValueError:
            break
    return lines


def cut_metrics(folder: Path, iteration: int) -> None:
    """Forget evaluations after `iteration`: a resumed run makes them again."""
    kept = [line for line in read_metrics(folder) if line["iteration"] <= iteration]
    with replacing(folder / "metrics.jsonl") as partial:
        partial.write_text("".join(json.dumps(line) + "\n" for line in kept), encoding="utf-8")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder for one process. Raises StgaError while another, living one does."""
    path = folder / "run.lock"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StgaError(f"{folder}: cannot be written as a folder ({error.strerror or error})") from error
    try:
        if path.exists() and not _alive(path):
            path.unlink(missing_ok=True)
        with path.open("x", encoding="ascii") as out:
            out.write(str(os.getpid()))
    except FileExistsError as error:
        raise StgaError(f"{folder}: another run is working in this folder (process {_owner(path)})") from error
    except OSError as error:
        raise StgaError(f"{folder}: cannot be written ({error.strerror or error})") from error
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def _owner(path: Path) -> int:
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return 0


def _alive(path: Path) -> bool:
    owner = _owner(path)
    if owner in (0, os.getpid()):
        return owner != 0
    try:
        # Signal 0 only asks whether the process exists; Windows has no such question, so there a lock counts.
        if os.name == "posix":
            os.kill(owner, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
