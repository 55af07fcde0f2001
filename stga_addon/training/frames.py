"""Face frames of a capture's timesteps, the latest ones kept."""

from functools import lru_cache

import numpy as np

from ..avatar.embedding import FaceFrames, face_frames
from ..avatar.strain import strain_basis
from ..capture.model import Capture

KEPT = 12
"""Timesteps whose frames stay in memory: about 1 MB each for 10,000 triangles."""


class FrameStore:
    """Face frames by timestep, float64, bounded however long the sequence is."""

    def __init__(self, capture: Capture, convention: str, strain: bool = False) -> None:
        self._capture, self._convention = capture, convention
        self._strain = strain_basis(capture.neutral, capture.faces) if strain else None
        self.of = lru_cache(KEPT)(self._read)

    def _read(self, timestep: int) -> FaceFrames:
        mesh = np.asarray(self._capture.mesh(timestep))
        return face_frames(mesh, self._capture.faces, self._capture.neutral, self._convention, self._strain)
