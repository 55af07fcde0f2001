"""Checkpoints of a training run and the selection that it trains, as files in its folder."""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...avatar.file import check_array
from ...avatar.offsets import OFFSETS
from ...avatar.splats import ARRAYS
from ...errors import StgaError, shorten
from ...files import read_npz, write_npz
from ..optimize.state import OffsetState, TrainState, arrays_of, state_of
from .folder import CHECKPOINT, SELECTION

VERSION = 3
TRACKING, IDENTITY = "tracking/parameters", "identity"
MAX_COUNT = 1 << 53
"""Largest iteration or timestep that a checkpoint may hold."""
OTHER_RUN = (
    "belongs to another run than run.json beside it; remove it, or train into another folder"
)


@dataclass
class Checkpoint:
    """State of training between two iterations.

    elapsed_s  seconds of training so far, evaluation not counted
    best_difference  of avatar.npz (`Quality.detail_difference`); ∞ before the first evaluation
    losses     of the last global iterations
    identity   digest of the run's identity
    tracking   (T, P + 3) float64 `RefinedTracking.parameters`; None where they are not refined
    rounds     in which they were
    """

    state: TrainState
    iteration: int
    visit: int
    last_timestep: int | None
    initial_count: int
    elapsed_s: float
    best_difference: float
    evaluations: int
    losses: list[float]
    tracking: np.ndarray | None = None
    rounds: int = 0
    identity: str = ""


def write_selection(folder: Path, selection: Mapping[int, np.ndarray], identity: str) -> None:
    """Write timestep -> (F,) bool of the run with this digest of its identity."""
    arrays = {f"{timestep:05d}": faces for timestep, faces in selection.items()}
    write_npz(folder / SELECTION, {**arrays, IDENTITY: _packed(identity)}, compressed=True)


def read_selection(folder: Path, faces: int, identity: str | None = None) -> dict[int, np.ndarray]:
    """timestep -> (F,) bool. Raises StgaError where the file does not fit the mesh, or has not this
    `identity`."""
    path = folder / SELECTION
    arrays = read_npz(path)
    stored = arrays.pop(IDENTITY, None)
    if identity is not None and (stored is None or stored.tobytes() != identity.encode()):
        raise StgaError(f"{path}: {OTHER_RUN}")
    selection = {}
    for name, mask in arrays.items():
        if (
            not re.fullmatch(r"\d{1,18}", name, re.ASCII)
            or mask.dtype != bool
            or mask.shape != (faces,)
        ):
            raise StgaError(
                f"{path}: '{name}' is {mask.dtype} {mask.shape}, expected bool ({faces},) by timestep"
            )
        selection[int(name)] = mask
    return selection


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Replace the checkpoint as a whole. Gradients are not kept: they are overwritten before they
    are read."""
    arrays = {
        k: array
        for k, array in arrays_of(checkpoint.state).items()
        if not k.startswith("gradients/")
    }
    for effect, offset in checkpoint.state.driven_offsets.items():
        arrays.update({f"{effect}/{name}": array for name, array in vars(offset).items()})
    if checkpoint.tracking is not None:
        arrays[TRACKING] = checkpoint.tracking
    values = {k: v for k, v in vars(checkpoint).items() if k not in ("state", "tracking")}
    arrays["meta"] = _packed(json.dumps({"version": VERSION, **values}))
    write_npz(folder / CHECKPOINT, arrays)


def read_checkpoint(folder: Path) -> Checkpoint:
    """Raises StgaError where there is none, or it is damaged."""
    path = folder / CHECKPOINT
    arrays = read_npz(path)
    try:
        meta = _meta(arrays.pop("meta"))
        if meta.pop("version") != VERSION:
            raise StgaError(f"{path}: was written by another version")
        tracking = arrays.pop(TRACKING, None)
        if tracking is not None:
            timesteps, parameters = tracking.shape
            check_array(path, TRACKING, tracking, "float64", (timesteps, parameters))
        elif _taken(arrays, "tracking/"):
            raise StgaError(
                f"{path}: refines the tracking as version 0.2.0 did; train into another folder"
            )
        offsets = {
            name: offset for name in OFFSETS if (offset := _offset(path, arrays, name)) is not None
        }
        if any(array.ndim == 0 for array in arrays.values()):
            raise StgaError(f"{path}: an array has no rows")
        for name in [n for n in arrays if n.startswith("first/")]:
            arrays[name.replace("first/", "gradients/")] = np.zeros_like(arrays[name])
        state = state_of({name: np.ascontiguousarray(array) for name, array in arrays.items()})
        _check_state(path, state)
        state.driven_offsets = offsets
        return Checkpoint(state=state, tracking=tracking, **meta)
    except (KeyError, IndexError, TypeError, ValueError, RecursionError) as error:
        raise StgaError(f"{path}: a field is missing or malformed ({error!s:.200})") from error


def _packed(text: str) -> np.ndarray:
    return np.frombuffer(text.encode(), np.uint8)


def _meta(packed: np.ndarray) -> dict[str, Any]:
    """Everything of a checkpoint that is no array. Raises ValueError for what training cannot
    continue with."""
    meta = json.loads(packed.tobytes())
    if not isinstance(meta, dict):
        raise ValueError("meta is no object")
    meta.setdefault("rounds", 0)
    lowest = {"iteration": 0, "visit": -1, "initial_count": 0, "evaluations": 0, "rounds": 0}
    for name, low in lowest.items():
        if type(meta.get(name)) is not int or not low <= meta[name] < MAX_COUNT:
            raise ValueError(
                f"{name} is {shorten(meta.get(name))}, expected a whole number from {low} up"
            )
    last, losses = meta.get("last_timestep"), meta.get("losses")
    if last is not None and (type(last) is not int or not 0 <= last < MAX_COUNT):
        raise ValueError(f"last_timestep is {shorten(last)}, expected a timestep")
    if not _is_number(meta.get("elapsed_s")) or not 0 <= meta["elapsed_s"] < math.inf:
        raise ValueError(
            f"elapsed_s is {shorten(meta.get('elapsed_s'))}, expected seconds from 0 up"
        )
    if not _is_number(meta.get("best_difference")) or math.isnan(meta["best_difference"]):
        raise ValueError(
            f"best_difference is {shorten(meta.get('best_difference'))}, expected a number"
        )
    if not isinstance(losses, list) or not all(
        _is_number(loss) and not math.isnan(loss) for loss in losses
    ):
        raise ValueError("losses is no list of numbers")
    if not isinstance(meta.get("identity"), str):
        raise ValueError("identity is no text")
    return meta


def _is_number(value: Any) -> bool:
    return isinstance(value, float) or (type(value) is int and abs(value) < MAX_COUNT)


def _check_state(path: Path, state: TrainState) -> None:
    """Kernels trust shapes and types, so a checkpoint's are checked. Raises StgaError naming the
    array."""
    n, tails = len(state), {}
    for field, kind in ARRAYS.items():
        size = getattr(state.parameters, field).shape[1] if kind.sizes else 0
        if kind.sizes and size not in kind.sizes:
            raise StgaError(
                f"{path}: parameters/{field} has {size} coefficients, expected one of {kind.sizes}"
            )
        tails[field] = kind.shape_at(size)
    whole = {"steps": "int32", "face": "int32", "unbound": "bool"}
    for name, array in arrays_of(state).items():
        check_array(
            path,
            name,
            array,
            whole.get(name, "float32"),
            (n, *tails.get(name.rpartition("/")[2], ())),
        )


def _offset(path: Path, arrays: dict[str, np.ndarray], name: str) -> OffsetState | None:
    """A driven offset, taken out of a checkpoint's arrays; None where there is none. Raises
    StgaError naming an array that is wrong."""
    taken = _taken(arrays, f"{name}/")
    if not taken:
        return None
    found = OffsetState(**taken)
    triangles = found.steps.shape[:1]
    for part, array in taken.items():
        tail = () if part == "steps" else (OFFSETS[name].signals, 3)
        check_array(
            path, f"{name}/{part}", array, "float32" if tail else "int32", (*triangles, *tail)
        )
    return found


def _taken(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The arrays whose names begin with the prefix, under the rest of their names; removed from
    `arrays`."""
    return {
        name.removeprefix(prefix): arrays.pop(name)
        for name in list(arrays)
        if name.startswith(prefix)
    }
