"""File of a run folder with refined FLAME parameters: the motion, as any other, and what the run started from."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ...capture.model import Capture
from ...capture.open import with_sequence
from ...errors import StgaError
from ...files import read_npz, write_npz
from ...flame.forward import FlameFrame, frame_of
from ...flame.sequence import FRAME_FIELDS, FlameSequence, read_motion

TRACKING = "tracking.npz"


def write_tracking(folder: Path, sequence: FlameSequence, refined: np.ndarray, tracked: np.ndarray) -> None:
    """Write refined and tracked `FlameFrame.parameters` (T, P) of the timesteps of a sequence."""
    frame = frame_of(refined.T)
    arrays = {name: getattr(frame, name).T for name in FRAME_FIELDS}
    arrays["shape"] = sequence.shape
    if sequence.static_offset is not None:
        arrays["static_offset"] = sequence.static_offset
    arrays["timesteps"], arrays["tracked"] = np.array(sequence.timesteps), tracked
    write_npz(folder / TRACKING, arrays, compressed=True)


def with_refined_tracking(capture: Capture, folder: Path) -> Capture:
    """The capture with the parameters that the run in `folder` refined; unchanged if it refined none.

    A timestep is replaced only if the capture's tracked parameters are those that the run started from, so that
    another capture stays unchanged. Raises StgaError if the run's file is damaged.
    """
    path, sequence = folder / TRACKING, capture.flame
    if sequence is None or not path.exists():
        return capture
    motion, tracked = read_motion(path, sequence.model), read_npz(path).get("tracked", np.zeros(0))
    if len(tracked) != len(motion.timesteps):
        raise StgaError(f"{path}: tracked has shape {tracked.shape}, expected {len(motion.timesteps)} timesteps first")
    before = dict(zip(motion.timesteps, tracked, strict=True))

    def frame(timestep: int) -> FlameFrame:
        found = sequence.frame(timestep)
        if timestep not in before or not np.array_equal(found.parameters, before[timestep]):
            return found
        return replace(motion.frame(timestep), dynamic_offset=found.dynamic_offset)

    return with_sequence(capture, replace(sequence, frame=frame))
