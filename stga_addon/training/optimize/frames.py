"""Face frames of a capture's timesteps, the latest ones kept."""

import numpy as np

from ...avatar.embedding import FaceFrames, face_frames
from ...avatar.strain import strain_basis
from ...capture.model import Capture
from .tracking import Tracking

CACHED_TIMESTEPS = 12
"""Timesteps whose frames stay in memory: about 1 MB each for 10,000 triangles."""


class FrameStore:
    """Meshes and face frames by timestep, float64, bounded however long the sequence is.

    strain: what strain needs of the neutral mesh, None where colours do not follow it.
    tracking: the timesteps whose mesh is being refined, None where all are as tracked.
    """

    def __init__(
        self, capture: Capture, convention: str, strain: bool = False, tracking: Tracking | None = None
    ) -> None:
        self.capture, self.convention, self.tracking = capture, convention, tracking
        self.strain = strain_basis(capture.neutral, capture.faces) if strain else None
        self._kept: dict[int, tuple[np.ndarray, FaceFrames]] = {}

    def of(self, timestep: int) -> FaceFrames:
        return self._latest(timestep)[1]

    def mesh(self, timestep: int) -> np.ndarray:
        """(V, 3) that the frames stand on."""
        return self._latest(timestep)[0]

    def forget(self) -> None:
        """The meshes have changed."""
        self._kept.clear()

    def _latest(self, timestep: int) -> tuple[np.ndarray, FaceFrames]:
        known = self._kept.pop(timestep, None)
        self._kept[timestep] = known or self._read(timestep)  # the latest asked for stands last
        if len(self._kept) > CACHED_TIMESTEPS:
            del self._kept[next(iter(self._kept))]
        return self._kept[timestep]

    def _read(self, timestep: int) -> tuple[np.ndarray, FaceFrames]:
        capture, tracking = self.capture, self.tracking
        source = capture if tracking is None or not tracking.refines(timestep) else tracking
        mesh = np.asarray(source.mesh(timestep))
        return mesh, face_frames(mesh, capture.faces, capture.neutral, self.convention, self.strain)
