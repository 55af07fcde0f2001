"""Splats placed in a scene, and the image made of them; importing this needs numpy only."""

from dataclasses import dataclass, field

import numpy as np

from ..avatar.embedding import WORLD, FaceFrames
from ..avatar.splats import Splats


@dataclass(frozen=True)
class PosedSplats:
    """One set of splats in a scene with others: a layer of `compose`.

    frames: those of the splats' triangles (`WORLD` for a world-space set), in the space that the
    splats were trained in. to_world (4, 4): from that space to the scene; it may scale and shear;
    by default, they are one.
    antialiased as in `Avatar`.
    """

    splats: Splats
    frames: FaceFrames = WORLD
    to_world: np.ndarray = field(default_factory=lambda: np.eye(4))
    antialiased: bool = False


@dataclass(frozen=True)
class ComposedImage:
    """Image of several layers on a transparent background.

    rgb (3, H, W) float32: display values (sRGB), premultiplied with alpha (H, W). depth (H, W):
    meters along the view axis, the alpha-weighted mean of what a pixel shows, 0 where that is
    nothing; None if it was not asked for.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray | None
