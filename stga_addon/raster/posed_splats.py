"""Splats where a scene has them; needs nothing that draws."""

from dataclasses import dataclass

import numpy as np

from ..avatar.embedding import FaceFrames
from ..avatar.splats import Splats


@dataclass(frozen=True)
class PosedSplats:
    """One posed set of splats in a scene with others.

    frames: those of the splats' triangles (`WORLD` for a world-space set), in the space they were trained in.
    to_world (4, 4): from there to the scene; it may scale and shear. antialiased as in `Avatar`.
    """

    splats: Splats
    frames: FaceFrames
    to_world: np.ndarray
    antialiased: bool = False


@dataclass(frozen=True)
class ComposedImage:
    """A picture of splats on nothing.

    rgb (3, H, W) float32: display values, premultiplied; alpha (H, W); depth (H, W) meters along the view axis, the
    mean over what a pixel shows, 0 where it shows nothing, or None where nobody asked for it.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray | None
