"""Refinement of the tracked FLAME parameters while the splats are trained."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ...avatar.embedding import FaceFrames
from ...capture.model import Capture
from ...errors import StgaError
from ...flame.forward import POSE_SIZE, TRANSLATION_SIZE, FlameFrame, frame_of, parameters_gradient
from ...flame.sequence import FlameSequence, sequence_mesh, with_identity
from ...raster.cpu.layout import Parameters

REFINEMENT_START_SHARE = 0.15
"""Share of the budget before the first step: gradients of untrained splats carry no information."""
FINAL_RATE_FACTOR = 0.1
"""Learning rates at the end of the budget, as a share of those at the start."""
EXPRESSION_RATE, JOINT_RATE_RAD, TRANSLATION_RATE_M = 1e-2, 2e-3, 2e-4
"""Adam's initial learning rates. GaussianAvatars' 1e-3, 1e-5 and 1e-6 are meant for 600,000 iterations; here, a
timestep is visited a few dozen times."""
BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15
DECAY_PER_STEP = 0.03
"""Decay towards the tracked values with each step at full rate, for parameters that no image determines."""
CACHED_TIMESTEPS = 12
"""FLAME frames kept in memory, with their dynamic offsets."""


@dataclass
class RefinementState:
    """State of T timesteps with P parameters each, in FLAME's units, float64; part of a checkpoint.

    change  (T, P) added to the tracked parameters
    first   (T, P) Adam's first moment
    second  (P,) Adam's second moment, shared because most timesteps are visited too rarely to estimate their own
    steps   (T,) int64
    """

    change: np.ndarray
    first: np.ndarray
    second: np.ndarray
    steps: np.ndarray


class Tracking:
    """The FLAME parameters of a sequence, of which some timesteps are refined.

    tracked  (T, P) the tracker's parameters
    trained  (T,) bool timesteps that are refined
    """

    def __init__(self, sequence: FlameSequence, timesteps: Collection[int]) -> None:
        """timesteps: which ones to refine."""
        self.sequence = sequence
        self.tracked = np.stack([sequence.frame(timestep).parameters for timestep in sequence.timesteps])
        self.trained = np.isin(sequence.timesteps, list(timesteps))
        zero = np.zeros_like(self.tracked)
        self.state = RefinementState(zero, zero.copy(), zero[0].copy(), np.zeros(len(zero), np.int64))
        expressions = self.tracked.shape[1] - POSE_SIZE - TRANSLATION_SIZE
        self._rates = np.repeat(
            (EXPRESSION_RATE, JOINT_RATE_RAD, TRANSLATION_RATE_M), (expressions, POSE_SIZE, TRANSLATION_SIZE)
        )
        self._row = {timestep: row for row, timestep in enumerate(sequence.timesteps)}
        self._source = lru_cache(CACHED_TIMESTEPS)(sequence.frame)
        self._person = replace(with_identity(sequence), frame=self.frame)

    def refines(self, timestep: int) -> bool:
        return timestep in self._row and bool(self.trained[self._row[timestep]])

    def parameters(self) -> np.ndarray:
        """(T, P) refined parameters.

        The mean change of the timesteps that were stepped is removed: the splats' local positions can express it as
        well, and all other timesteps, which stay as tracked, would not follow it.
        """
        stepped, refined = self.state.steps > 0, np.array(self.tracked)
        if stepped.any():
            refined[stepped] += self.state.change[stepped] - self.state.change[stepped].mean(0)
        return refined

    def frame(self, timestep: int) -> FlameFrame:
        return frame_of(self.parameters()[self._row[timestep]], self._source(timestep).dynamic_offset)

    def mesh(self, timestep: int) -> np.ndarray:
        """Refined mesh (V, 3) of the timestep, in meters."""
        return sequence_mesh(self._person, timestep)

    def step(self, timestep: int, vertex_gradient: np.ndarray, share: float) -> None:
        """Adam step of the timestep's parameters, at a share of the learning rates.

        vertex_gradient (V, 3): of the loss, with respect to the timestep's vertices.
        """
        row, state = self._row[timestep], self.state
        refined = self.parameters()[row] - self.tracked[row]
        gradient = self.gradient(timestep, vertex_gradient)
        state.steps[row] += 1
        state.first[row] += (1 - BETA1) * (gradient - state.first[row])
        state.second += (1 - BETA2) * (gradient**2 - state.second)
        first = state.first[row] / (1 - BETA1 ** int(state.steps[row]))
        second = state.second / (1 - BETA2 ** int(state.steps.sum()))
        step = self._rates * first / (np.sqrt(second) + EPSILON)
        state.change[row] -= share * (step + DECAY_PER_STEP * refined)

    def gradient(self, timestep: int, vertex_gradient: np.ndarray) -> np.ndarray:
        """(P,) gradient with respect to the timestep's parameters, from that with respect to its vertices (V, 3)."""
        return parameters_gradient(self._person.model, self.frame(timestep), vertex_gradient)


def refinable_tracking(capture: Capture, convention: str) -> Tracking:
    """The capture's FLAME parameters, refinable at the timesteps of its training views.

    Raises StgaError if it has none, or for an embedding convention that `frame_backward` does not support.
    """
    if convention != "stga":
        raise StgaError(f"--effect tracking=on: needs the embedding convention 'stga', got '{convention}'")
    if capture.flame is None:
        raise StgaError(
            f"{capture.root}: is not tracked with FLAME, so --effect tracking=on cannot refine its parameters"
        )
    return Tracking(capture.flame, {view.timestep for view in capture.views["train"]})


def refinement_rate(progress: float) -> float:
    """Share of the learning rates at a share of the budget; 0 before REFINEMENT_START_SHARE."""
    start = REFINEMENT_START_SHARE
    return 0.0 if progress < start else FINAL_RATE_FACTOR ** min(1.0, (progress - start) / (1 - start))


def frame_gradient(
    splats: Parameters, face: np.ndarray, gradients: Parameters, rows: np.ndarray, frames: FaceFrames
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gradients of the face frames from those of their splats `rows` (M,), as `frame_backward` takes them.

    Returns those of translation (F, 3), rotation (F, 3) and scale (F,). A frame translates, rotates and scales all its
    splats alike, so each is a sum over its splats.
    """
    (x, y, z), (fx, fy, fz) = splats.xyz[rows].T, gradients.xyz[rows].T
    (q0, q1, q2, q3), (v0, v1, v2, v3) = splats.rotation[rows].T, gradients.rotation[rows].T
    rotation = (  # of position (cross product), plus of orientation (half of the quaternion's gradient)
        y * fz - z * fy + (q0 * v1 - q1 * v0 + q2 * v3 - q3 * v2) / 2,
        z * fx - x * fz + (q0 * v2 - q2 * v0 + q3 * v1 - q1 * v3) / 2,
        x * fy - y * fx + (q0 * v3 - q3 * v0 + q1 * v2 - q2 * v1) / 2,
    )
    scale = x * fx + y * fy + z * fz + gradients.log_scale[rows].sum(1)
    on, count = face[rows], len(frames.origin)
    sums = [np.bincount(on, column, count) for column in (fx, fy, fz, *rotation, scale)]
    return np.stack(sums[:3], -1) / frames.scale[:, None], np.stack(sums[3:6], -1), sums[6]
