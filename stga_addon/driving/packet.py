"""What one packet of a live source says."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class FacePacket:
    """One frame of a live source.

    names    ARKit shapes that it holds
    weights  (52,) in the order of `ARKIT_SHAPES`, 0 for shapes that it lacks; None: the source sees no face
    head     yaw, pitch, roll in radians as in `Performance.head`; None where it holds none
    subject  the source's name for itself or its face
    time     seconds of the source's own clock; None where it sends none
    """

    names: tuple[str, ...]
    weights: np.ndarray | None
    head: tuple[float, float, float] | None = None
    subject: str = ""
    time: float | None = None
