"""What ARKit's shapes do to points of a face: displacements measured on ICT-FaceKit.

`arkit_shapes.npz` holds samples of the ICT-FaceKit light model (MIT License, Copyright (c) 2020 USC Institute for
Creative Technologies), made by `development/arkit_shapes.py`.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from ..files import read_npz
from .names import ARKIT_SHAPES, COLUMN, COUNT, OPTIONAL

SHAPES_FILE = Path(__file__).with_name("arkit_shapes.npz")
PUPILS = (468, 473)
SKIN_POINTS = 468
"""The points after these are the irises', which move with the eyeballs."""
MOUTH_CLOSE, JAW_OPEN = COLUMN["mouthClose"], COLUMN["jawOpen"]


@dataclass(frozen=True)
class FaceShapes:
    """ICT-FaceKit at MediaPipe's 478 landmarks, in meters, y up, looking along +z; the person's left is +x.

    points, normals  (478, 3) of the neutral face
    reliable  (478,) bool: found on the surface by the detector
    shapes    (52, 478, 3) displacements in the order of `ARKIT_SHAPES`; tongueOut's are zero
    identity  (20, 478, 3) displacements that make other people
    """

    points: np.ndarray
    normals: np.ndarray
    reliable: np.ndarray
    shapes: np.ndarray
    identity: np.ndarray


@cache
def face_shapes() -> FaceShapes:
    """The shapes that come with this package."""
    arrays = read_npz(SHAPES_FILE)
    shapes = np.zeros((COUNT, *arrays["points"].shape))
    shapes[[COLUMN[name] for name in ARKIT_SHAPES if name not in OPTIONAL]] = arrays["shapes"]
    points, normals, identity = (arrays[name].astype(np.float64) for name in ("points", "normals", "identity"))
    return FaceShapes(points, normals, arrays["reliable"], shapes, identity)


def effective_weights(weights: np.ndarray) -> np.ndarray:
    """Weights (..., 52) with mouthClose at most jawOpen: it closes the lips of an open jaw, and does nothing else."""
    limited = weights.copy()
    limited[..., MOUTH_CLOSE] = np.minimum(weights[..., MOUTH_CLOSE], np.maximum(weights[..., JAW_OPEN], 0))
    return limited
