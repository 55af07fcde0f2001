"""FLAME's parameters refined while the splats are trained, where the tracked mesh is not quite where the images are."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from ...avatar.embedding import FaceFrames
from ...capture.flame_capture import with_sequence
from ...capture.model import Capture
from ...errors import StgaError
from ...files import read_npz, write_npz
from ...flame.forward import FlameFrame
from ...flame.forward_torch import flame_forward, flame_tensors
from ...flame.sequence import FRAME_FIELDS, FlameSequence, read_motion, sequence_mesh, with_identity
from ...raster.cpu.layout import Parameters
from ..effect_plan import TRACKING

START = 0.15
"""Share of the budget before the first step: splats that show nothing yet pull nowhere."""
END = 0.1
"""Share of the rates that is left at the end of the budget."""
COEFFICIENT, RADIAN, METRE = 1e-2, 2e-3, 2e-4
"""Adam's rates at the start, of expression, joints and translation; GaussianAvatars' 1e-3, 1e-5 and 1e-6 are made for
600,000 iterations, and here a timestep is visited a few dozen times."""
BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15
LEASH = 0.03
"""Share of the way back to the tracked values that comes with a step at full rate, for what no image shows."""
POSE_SIZE, TRANSLATION_SIZE = 15, 3
"""The last numbers of a timestep: axis-angles of five joints, and the translation. Expression comes first."""
CACHED_TIMESTEPS = 12
"""Frames that stay in memory with their dynamic offsets."""


@dataclass
class RefinementState:
    """How far T timesteps have come, P numbers each in FLAME's units: what a checkpoint holds, in float64.

    change (T, P) and Adam's first moment `first` (T, P); its second moment `second` (P,), which the timesteps share
    because most of them are seen too rarely to know their own; steps (T,) int64.
    """

    change: np.ndarray
    first: np.ndarray
    second: np.ndarray
    steps: np.ndarray


class Tracking:
    """The parameters of a sequence of which some timesteps are refined.

    tracked (T, P): as the tracker left them; trained (T,) bool: which timesteps are refined.
    """

    def __init__(self, sequence: FlameSequence, timesteps: Collection[int]) -> None:
        """timesteps: those to refine."""
        self.sequence = sequence
        self.tracked = np.stack([parameters_of(sequence.frame(timestep)) for timestep in sequence.timesteps])
        self.trained = np.isin(sequence.timesteps, list(timesteps))
        zero = np.zeros_like(self.tracked)
        self.state = RefinementState(zero, zero.copy(), zero[0].copy(), np.zeros(len(zero), np.int64))
        expressions = self.tracked.shape[1] - POSE_SIZE - TRANSLATION_SIZE
        self._rates = np.repeat([COEFFICIENT, RADIAN, METRE], [expressions, POSE_SIZE, TRANSLATION_SIZE])
        self._row = {timestep: row for row, timestep in enumerate(sequence.timesteps)}
        self._source = lru_cache(CACHED_TIMESTEPS)(sequence.frame)
        self._person = replace(with_identity(sequence), frame=self.frame)
        self._flame = flame_tensors(self._person.model)

    def refines(self, timestep: int) -> bool:
        return timestep in self._row and bool(self.trained[self._row[timestep]])

    def parameters(self) -> np.ndarray:
        """(T, P) as refined.

        What all timesteps have in common is left to the splats: they stand off the mesh as easily as the mesh moves
        off the images, but a timestep that is not refined would follow neither.
        """
        common = self.state.change[self.trained].mean(0)
        return np.asarray(self.tracked + np.where(self.trained[:, None], self.state.change - common, 0.0))

    def frame(self, timestep: int) -> FlameFrame:
        return with_parameters(self._source(timestep), self.parameters()[self._row[timestep]])

    def mesh(self, timestep: int) -> np.ndarray:
        """(V, 3) metres."""
        return sequence_mesh(self._person, timestep)

    def step(self, timestep: int, pull: np.ndarray, share: float) -> None:
        """Move the timestep against the gradient `pull` (V, 3) of its vertices, at a share of the rates."""
        row, state = self._row[timestep], self.state
        gradient = self.gradient(timestep, pull)
        state.steps[row] += 1
        state.first[row] += (1 - BETA1) * (gradient - state.first[row])
        state.second += (1 - BETA2) * (gradient**2 - state.second)
        first = state.first[row] / (1 - BETA1 ** int(state.steps[row]))
        second = state.second / (1 - BETA2 ** int(state.steps.sum()))
        step = self._rates * first / (np.sqrt(second) + EPSILON)
        state.change[row] -= share * (step + LEASH * state.change[row])

    def gradient(self, timestep: int, pull: np.ndarray) -> np.ndarray:
        """(P,) with respect to the timestep's parameters, from that with respect to its vertices, `pull` (V, 3)."""
        frame = self.frame(timestep)
        numbers = torch.tensor(parameters_of(frame)[None], dtype=torch.float32, requires_grad=True)
        expr, pose, translation = numbers.tensor_split([-POSE_SIZE - TRANSLATION_SIZE, -TRANSLATION_SIZE], dim=1)
        offset = None if frame.dynamic_offset is None else torch.tensor(frame.dynamic_offset, dtype=torch.float32)
        vertices = flame_forward(self._flame, numbers.new_zeros(0), expr, pose.reshape(1, -1, 3), translation, offset)
        (gradient,) = torch.autograd.grad(vertices, numbers, torch.tensor(pull[None], dtype=torch.float32))
        return gradient[0].numpy().astype(np.float64)


def refinable_tracking(capture: Capture, convention: str) -> Tracking:
    """The capture's parameters, to be refined where there are training views.

    Raises StgaError where it has none, or the splats are embedded by a convention other than "stga" (`frame_backward`).
    """
    if convention != "stga":
        raise StgaError(f"effect tracking: is made for the embedding 'stga', not for '{convention}'")
    if capture.flame is None:
        raise StgaError(f"{capture.root}: was not tracked with FLAME, so there are no parameters to refine")
    return Tracking(capture.flame, {view.timestep for view in capture.views["train"]})


def refinement_rate(progress: float) -> float:
    """Share of the rates at a share of the budget; 0 before the splats show anything."""
    return 0.0 if progress < START else END ** min(1.0, (progress - START) / (1 - START))


def frame_gradient(
    splats: Parameters, face: np.ndarray, gradients: Parameters, rows: np.ndarray, frames: FaceFrames
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Force (F, 3), torque (F, 3) and growth (F,) for `frame_backward`, from the gradients of the splats `rows` (M,).

    A frame moves, turns and grows all its splats alike, so its gradient is a sum over theirs.
    """
    (x, y, z), (fx, fy, fz) = splats.xyz[rows].T, gradients.xyz[rows].T
    (q0, q1, q2, q3), (v0, v1, v2, v3) = splats.rotation[rows].T, gradients.rotation[rows].T
    torque = (  # lever times force, and what turns a splat in its place: half of the quaternion's gradient
        y * fz - z * fy + (q0 * v1 - q1 * v0 + q2 * v3 - q3 * v2) / 2,
        z * fx - x * fz + (q0 * v2 - q2 * v0 + q3 * v1 - q1 * v3) / 2,
        x * fy - y * fx + (q0 * v3 - q3 * v0 + q1 * v2 - q2 * v1) / 2,
    )
    growth = x * fx + y * fy + z * fz + gradients.log_scale[rows].sum(1)
    on, count = face[rows], len(frames.origin)
    sums = [np.bincount(on, column, count) for column in (fx, fy, fz, *torque, growth)]
    return np.stack(sums[:3], -1) / frames.scale[:, None], np.stack(sums[3:6], -1), sums[6]


def parameters_of(frame: FlameFrame) -> np.ndarray:
    """(P,) of a frame: expression, joints, translation."""
    return np.concatenate([frame.expr, frame.pose.ravel(), frame.translation])


def with_parameters(frame: FlameFrame, numbers: np.ndarray) -> FlameFrame:
    """The frame with other `parameters_of`."""
    expr, pose, translation = np.split(numbers, [-POSE_SIZE - TRANSLATION_SIZE, -TRANSLATION_SIZE])
    rotation, neck, jaw, eyes = np.split(pose, [3, 6, 9])
    return replace(
        frame, expr=expr, rotation=rotation, neck_pose=neck, jaw_pose=jaw, eyes_pose=eyes, translation=translation
    )


def write_tracking(folder: Path, tracking: Tracking) -> None:
    """Replace a run folder's tracking.npz: the motion of all timesteps, for `read_motion`, and what it began as."""
    sequence = tracking.sequence
    frame = with_parameters(sequence.frame(sequence.timesteps[0]), tracking.parameters().T)
    arrays = {name: getattr(frame, name).T for name in FRAME_FIELDS}
    arrays["shape"] = sequence.shape
    if sequence.static_offset is not None:
        arrays["static_offset"] = sequence.static_offset
    arrays["timesteps"], arrays["tracked"] = np.array(sequence.timesteps), tracking.tracked
    write_npz(folder / TRACKING, arrays, compressed=True)


def with_refined_tracking(capture: Capture, folder: Path) -> Capture:
    """The capture as the run in `folder` refined it; as it is where the run refined nothing.

    A timestep is taken from the run only where the capture has the parameters that the run began with, so that another
    capture given in its place stays as it is. Raises StgaError where the run's file is damaged.
    """
    path, sequence = folder / TRACKING, capture.flame
    if sequence is None or not path.exists():
        return capture
    motion, tracked = read_motion(path, sequence.model), read_npz(path).get("tracked", np.zeros(0))
    if len(tracked) != len(motion.timesteps):
        raise StgaError(f"{path}: tracked has shape {tracked.shape}, expected {len(motion.timesteps)} timesteps first")
    began = dict(zip(motion.timesteps, tracked, strict=True))

    def frame(timestep: int) -> FlameFrame:
        found = sequence.frame(timestep)
        if timestep not in began or not np.array_equal(parameters_of(found), began[timestep]):
            return found
        return replace(motion.frame(timestep), dynamic_offset=found.dynamic_offset)

    return with_sequence(capture, replace(sequence, frame=frame))
