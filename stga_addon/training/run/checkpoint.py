"""Checkpoints of a training run, the selection that it trains, and the range of deformation that it
has trained on, within which its avatar's colors and positions follow it, as files in its folder."""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...avatar.file import check_array, read_avatar
from ...avatar.offsets import OFFSETS
from ...avatar.splats import ARRAYS
from ...avatar.strain import (
    STRAIN_COMPONENTS,
    TRAINED_RANGE,
    observed_range,
    strain_basis,
    trained_range,
)
from ...capture.model import Capture
from ...errors import StgaError, shorten
from ...files import MAX_CHECKPOINT_BYTES, check_version, read_npz, write_npz
from ...schema import from_json, setting
from ..optimize.state import OffsetState, TrainState, arrays_of, state_of
from ..settings import TrainingSettings
from .folder import AVATAR, CHECKPOINT, SELECTION, Continuation, Run

VERSION = 4
"""Version of the format of checkpoints: those of other versions are refused."""
TRACKING = "tracking/parameters"
"""Prefix of the arrays of the tracking's parameters."""
IDENTITY = "identity"
"""Array with the capture's identity."""
STRAIN_RANGE = "strain_range.npz"
"""File of a run's `strain_range` (F, 2, 6) float32 and its `identity`."""
MAX_COUNT = (1 << 53) - 1
"""Largest iteration or timestep that a checkpoint may hold."""
OTHER_RUN = "belongs to another run than run.json; remove it, or train into another folder"


@dataclass(frozen=True, kw_only=True)
class Counts:
    """What a checkpoint holds beside arrays, of the trainer, the session and the evaluator.

    lines      of metrics.jsonl that were written so far
    rounds     in which tracking was refined
    identity   digest of the run's identity
    """

    iteration: int = setting(minimum=0, maximum=MAX_COUNT)
    visit: int = setting(minimum=-1, maximum=MAX_COUNT)
    last_timestep: int | None = setting(minimum=0, maximum=MAX_COUNT)
    initial_count: int = setting(minimum=0, maximum=MAX_COUNT)
    elapsed_s: float = setting(minimum=0)
    evaluations: int = setting(minimum=0, maximum=MAX_COUNT)
    losses: tuple[float, ...] = ()
    lines: int = setting(minimum=0, maximum=MAX_COUNT)
    rounds: int = setting(0, 0, MAX_COUNT)
    identity: str = ""


@dataclass(frozen=True, kw_only=True)
class Checkpoint(Counts):
    """State of training between two iterations.

    tracking_gain  that the next evaluation decides on, if any; NaN: nothing was left out
    tracking   (T, P + 3) float64 `RefinedTracking.parameters`; None where they are not refined
    """

    state: TrainState
    tracking_gain: float | None = None
    tracking: np.ndarray | None = None


def write_selection(folder: Path, selection: Mapping[int, np.ndarray], identity: str) -> None:
    """Write timestep -> (F,) bool of the run with this digest of its identity."""
    arrays = {f"{timestep:05d}": faces for timestep, faces in selection.items()}
    write_npz(folder / SELECTION, {**arrays, IDENTITY: _packed(identity)}, compressed=True)


def read_selection(folder: Path, faces: int, identity: str | None = None) -> dict[int, np.ndarray]:
    """timestep -> (F,) bool. Raises StgaError for another mesh, or another `identity` if given."""
    path = folder / SELECTION
    arrays = _arrays_of_run(path, identity)
    for name, mask in arrays.items():
        named = re.fullmatch(r"\d{1,18}", name, re.ASCII)
        if not named or mask.dtype != bool or mask.shape != (faces,):
            raise StgaError(
                f"{path}: '{name}' is {mask.dtype} {mask.shape}, expected bool ({faces},) by "
                "timestep"
            )
    return {int(name): mask for name, mask in arrays.items()}


def _arrays_of_run(path: Path, identity: str | None) -> dict[str, np.ndarray]:
    """The arrays of a file of the run with this digest; None: of any. Raises StgaError."""
    arrays = read_npz(path)
    stored = arrays.pop(IDENTITY, None)
    if identity is not None and (stored is None or stored.tobytes() != identity.encode()):
        raise StgaError(f"{path}: {OTHER_RUN}")
    return arrays


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Replaced as a whole. Gradients are not kept: they are overwritten before they are read."""
    every = arrays_of(checkpoint.state).items()
    arrays = {name: array for name, array in every if not name.startswith("gradients/")}
    for effect, offset in checkpoint.state.driven_offsets.items():
        arrays.update({f"{effect}/{name}": array for name, array in vars(offset).items()})
    if checkpoint.tracking is not None:
        arrays[TRACKING] = checkpoint.tracking
    values = {k: v for k, v in vars(checkpoint).items() if k not in ("state", "tracking")}
    arrays["meta"] = _packed(json.dumps({"version": VERSION, **values}))
    write_npz(folder / CHECKPOINT, arrays)


def read_checkpoint(folder: Path) -> Checkpoint:
    """Raises StgaError where there is none, or it is damaged or of another format version."""
    path = folder / CHECKPOINT
    arrays = read_npz(path, limit=MAX_CHECKPOINT_BYTES)
    try:
        meta = json.loads(arrays.pop("meta").tobytes())
        check_version(path, "checkpoint", meta.pop("version"), VERSION)
        gain = meta.pop("tracking_gain")
        counts: Counts = from_json(Counts, meta, path)
        if type(gain) not in (float, type(None)):
            raise StgaError(f"{path}: tracking_gain is {shorten(gain)}, expected a number")
        tracking = arrays.pop(TRACKING, None)
        if tracking is not None:
            timesteps, parameters = tracking.shape
            check_array(path, TRACKING, tracking, "float64", (timesteps, parameters))
        offsets = {}
        for effect in OFFSETS:
            names = [name for name in arrays if name.startswith(f"{effect}/")]
            if names:
                taken = {name.removeprefix(f"{effect}/"): arrays.pop(name) for name in names}
                offsets[effect] = found = OffsetState(**taken)
                whole = found.steps.shape[:1]
                tail = (STRAIN_COMPONENTS, 3)
                for part, array in taken.items():
                    kind = ("int32", whole) if part == "steps" else ("float32", (*whole, *tail))
                    check_array(path, f"{effect}/{part}", array, *kind)
        if any(array.ndim == 0 for array in arrays.values()):
            raise StgaError(f"{path}: an array has no rows")
        for name in [n for n in arrays if n.startswith("first/")]:
            arrays[name.replace("first/", "gradients/")] = np.zeros_like(arrays[name])
        state = state_of({name: np.ascontiguousarray(array) for name, array in arrays.items()})
        _check_state(path, state)
        state.driven_offsets = offsets
        return Checkpoint(state=state, tracking_gain=gain, tracking=tracking, **vars(counts))
    except (AttributeError, KeyError, IndexError, TypeError, ValueError, RecursionError) as error:
        raise StgaError(f"{path}: a field is missing or malformed ({error!s:.200})") from error


def _packed(text: str) -> np.ndarray:
    return np.frombuffer(text.encode(), np.uint8)


def _check_state(path: Path, state: TrainState) -> None:
    """Kernels trust shapes and types. Raises StgaError naming the array."""
    n = len(state)
    tails = {}
    for field, kind in ARRAYS.items():
        size = getattr(state.parameters, field).shape[1] if kind.sizes else 0
        if kind.sizes and size not in kind.sizes:
            raise StgaError(
                f"{path}: parameters/{field} has {size} coefficients, expected one of {kind.sizes}"
            )
        tails[field] = tuple(size if axis < 0 else axis for axis in kind.shape)
    whole = {"steps": "int32", "face": "int32", "unbound": "bool"}
    for name, array in arrays_of(state).items():
        shape = n, *tails.get(name.rpartition("/")[2], ())
        check_array(path, name, array, whole.get(name, "float32"), shape)


def check_fits(
    folder: Path, capture: Capture, settings: TrainingSettings, state: TrainState
) -> None:
    """Raise StgaError where a checkpoint's splats do not fit the mesh or the settings."""
    face = state.face
    splats = state.splats()
    faces = len(capture.faces)
    text = ""
    if len(face) and not 0 <= int(face.min()) <= int(face.max()) < faces:
        text = f"its splats refer to triangles that {capture.root} does not have"
    elif splats.sh_degree != settings.sh_degree:
        found = f"SH degree {splats.sh_degree}, run.json says {settings.sh_degree}"
        text = f"its splats have {found}"
    for name in state.driven_offsets.keys() ^ set(settings.driven_offsets):
        text = text or f"its checkpoint and run.json disagree on the driven offset {name}"
    for name, offset in state.driven_offsets.items():
        if len(offset.steps) != faces:
            found = f"of {len(offset.steps)} triangles, {capture.root} has {faces}"
            text = text or f"its {name} is {found}"
    if text:
        raise StgaError(f"{folder}: {text}")


def trained_strain_range(
    capture: Capture, mesh: Callable[[int], np.ndarray], continuation: Continuation | None
) -> np.ndarray:
    """`Avatar.strain_range` (F, 2, 6) of a run: what all its training timesteps show, and what its
    parent's did.

    mesh: timestep -> (V, 3) that is trained on; one at a time is held. Within TRAINED_RANGE.
    """
    limits = trained_range(len(capture.faces))
    basis = strain_basis(capture.neutral, capture.faces, limits)
    timesteps = sorted({view.timestep for view in capture.views["train"]})
    strain_range = observed_range(basis, (mesh(timestep) for timestep in timesteps))
    parent = None if continuation is None else read_avatar(continuation.parent / AVATAR)
    if parent is None or not parent.follows_strain:
        return strain_range  # it follows strain only from here on
    if parent.strain_range is None:
        return limits
    low, high = (np.stack([strain_range[:, k], parent.strain_range[:, k]]) for k in range(2))
    lowest = np.maximum(low.min(0), limits[:, 0])
    highest = np.minimum(high.max(0), limits[:, 1])
    return np.stack([lowest, highest], axis=1)


def strain_range_of(folder: Path, capture: Capture, run: Run) -> np.ndarray | None:
    """The range (F, 2, 6) of a run that has begun in the folder, measured and written where the
    folder has no file yet.

    None where nothing follows strain, and with refined tracking, which moves the meshes while it
    trains. Raises StgaError where the file is damaged, or of another run or mesh.
    """
    if not run.settings.follows_strain or run.settings.tracking:
        return None
    path = folder / STRAIN_RANGE
    if not path.exists():
        limits = trained_strain_range(capture, capture.mesh, run.continuation)
        write_npz(path, {"strain_range": limits, IDENTITY: _packed(run.digest)}, compressed=True)
        return limits
    arrays = _arrays_of_run(path, run.digest)
    found = arrays.get("strain_range", np.zeros(0))
    shape = len(capture.faces), *TRAINED_RANGE.shape
    check_array(path, "strain_range", found, "float32", shape)
    if not _is_trained_range(found):
        raise StgaError(
            f"{path}: 'strain_range' is not within the range that is trained; remove it"
        )
    return found


def _is_trained_range(limits: np.ndarray) -> bool:
    """Whether limits (F, 2, 6) lie within TRAINED_RANGE; not so where one is NaN."""
    return bool(((limits[:, 0] >= TRAINED_RANGE[0]) & (limits[:, 1] <= TRAINED_RANGE[1])).all())
