"""Splats placed in a scene, and the image made of them; importing this needs numpy only."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, Self, TypeVar

import numpy as np

from ..avatar.embedding import NO_COLUMNS, WORLD, FaceFrames
from ..avatar.splats import SH_C0, Splats


@dataclass(frozen=True)
class PosedSplats:
    """One set of splats in a scene with others: a layer of `compose`.

    frames: those of the splats' triangles (`WORLD` for a world-space set), in the space that the
    splats were trained in. to_world (4, 4): from that space to the scene; it may scale and shear;
    by default, they are one.
    antialiased as in `Avatar`. holdout: it makes what it covers transparent.
    """

    splats: Splats
    frames: FaceFrames = WORLD
    to_world: np.ndarray = field(default_factory=lambda: np.eye(4))
    antialiased: bool = False
    holdout: bool = False

    def painted(self, value: float) -> "PosedSplats":
        """The same splats in one gray of 0…1, sRGB."""
        splats, frames = in_gray(self.splats, self.frames, value)
        return replace(self, splats=splats, frames=frames)


@dataclass(frozen=True)
class ComposedImage:
    """Image of several layers on a transparent background.

    rgb (3, H, W) float32: display values (sRGB), premultiplied with alpha (H, W). depth (H, W):
    meters along the view axis, the alpha-weighted mean of what a pixel shows, 0 where that is
    nothing; None if it was not asked for. hidden (H, W): the part of alpha that holdouts have,
    which are black in it; None without any.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray | None
    hidden: np.ndarray | None = None


class Layer(Protocol):
    """What may be a holdout, and be painted as `PosedSplats` may."""

    @property
    def holdout(self) -> bool: ...

    def painted(self, value: float) -> Self: ...


AnyLayer = TypeVar("AnyLayer", bound=Layer)


def with_holdouts(
    layers: Sequence[AnyLayer], draw: Callable[[list[AnyLayer]], ComposedImage]
) -> ComposedImage:
    """The image that `draw` makes of layers, of which some may be holdouts."""
    if not any(layer.holdout for layer in layers):
        return draw(list(layers))
    image = draw([layer.painted(0.0) if layer.holdout else layer for layer in layers])
    # white where splats are seen, black where holdouts hide them
    white = draw([layer.painted(0.0 if layer.holdout else 1.0) for layer in layers])
    return replace(image, hidden=np.clip(image.alpha - white.rgb[0], 0, image.alpha))


def in_gray(splats: Splats, frames: FaceFrames, value: float) -> tuple[Splats, FaceFrames]:
    """The same splats in one gray of 0…1, sRGB."""
    sh = np.full((len(splats), 1, 3), (value - 0.5) / SH_C0, np.float32)
    return replace(splats, sh=sh), replace(frames, color=NO_COLUMNS)
