"""How an exported avatar plays: rate, cameras, selection, and whether its rig goes along."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median_low

import numpy as np

from ..capture.camera import Camera
from ..capture.model import Capture
from ..errors import StgaError
from .rig import ShapeControls

DEFAULT_FPS = 25.0
"""Frame rate where none is known."""
MIN_FPS = 0.01
"""Least frame rate that videos, USD files and the web player (player/data.js) take."""
MAX_FPS = 1000.0
"""Largest frame rate that they take."""
MAX_VIEWS = 32
"""Cameras that a page offers."""


@dataclass(frozen=True)
class Playback:
    """What plays besides the poses.

    title      of the page
    fps        poses per second
    views      name -> camera in the avatar's space; the first is where a viewer begins
    up         (3,) direction that points up in the avatar's space
    selection  (F,) bool per pose: the triangles that it trained; None where that is not known
    motion_only  leave out blend shapes, skeleton and sliders of the FLAME file; the posed meshes
                 stay
    controls   sliders beside those of the rig; only of FLAME heads, and not with `motion_only`
    """

    title: str = "Avatar"
    fps: float = DEFAULT_FPS
    views: Mapping[str, Camera] = field(default_factory=dict)
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    selection: Sequence[np.ndarray] | None = None
    motion_only: bool = False
    controls: ShapeControls | None = None


def playback_fps(
    capture: Capture | None, given: float | None = None, numbered: bool = False
) -> float:
    """Poses per second at which a capture plays: the given ones, else those of its recording, else
    `DEFAULT_FPS`.

    numbered: poses are shown at the numbers of their timesteps, as in Blender and USD. Otherwise
    one follows the other, so that every third frame of a recording plays at a third of its rate.
    """
    if given is not None:
        return given
    if capture is None or capture.fps is None:
        return DEFAULT_FPS
    gaps = np.diff(capture.timesteps).tolist()
    return capture.fps if numbered or not gaps else capture.fps / median_low(gaps)


def check_rate(path: Path, fps: float) -> None:
    """Raise StgaError naming `path` unless `fps` is from MIN_FPS to MAX_FPS."""
    if not MIN_FPS <= fps <= MAX_FPS:
        raise StgaError(
            f"{path}: the frame rate (--fps) must be from {MIN_FPS:g} to {MAX_FPS:g}, got {fps:g}"
        )
