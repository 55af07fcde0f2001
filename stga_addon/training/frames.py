"""Face frames of a capture's timesteps, the latest ones kept."""

from functools import lru_cache

import numpy as np

from ..avatar.embedding import FaceFrames, face_frames
from ..avatar.strain import strain_basis
from ..capture.model import Capture

KEPT = 12
"""Timesteps whose frames stay in memory: about 1 MB each for 10,000 triangles."""


class FrameStore:
    """Face frames by timestep, float64, bounded however long the sequence is.

    strain: what strain needs of the neutral mesh, None where colours do not follow it.
    """

    def __init__(self, capture: Capture, convention: str, strain: bool = False) -> None:
        self.capture, self.convention = capture, convention
        self.strain = strain_basis(capture.neutral, capture.faces) if strain else None
        self.of = lru_cache(KEPT)(self._read)

    def _read(self, timestep: int) -> FaceFrames:
        mesh = np.asarray(self.capture.mesh(timestep))
        return face_frames(mesh, self.capture.faces, self.capture.neutral, self.convention, self.strain)
