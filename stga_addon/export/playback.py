"""How an exported avatar plays: frames per second, cameras, selection, and whether its rig goes along."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..capture.camera import Camera

DEFAULT_FPS = 25.0
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
    motion_only  leave out blend shapes, skeleton and sliders of the FLAME file; the posed meshes stay
    """

    title: str = "Avatar"
    fps: float = DEFAULT_FPS
    views: Mapping[str, Camera] = field(default_factory=dict)
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    selection: Sequence[np.ndarray] | None = None
    motion_only: bool = False
