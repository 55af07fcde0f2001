"""Data model of a capture, independent of its layout on disk."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..flame.sequence import FlameSequence
from .camera import Camera

Item = TypeVar("Item")

FPS_LIMIT = 1000.0
"""Frame rates are below it."""


@dataclass(frozen=True)
class View:
    """One image: a camera at a timestep. `name` is its `file_path` with forward slashes."""

    timestep: int
    camera_index: int
    camera: Camera
    name: str
    image: Path
    mask: Path | None = None


ViewExposure = Callable[[View], np.ndarray | None]
"""View -> gain and offset (2, 3), in levels, of red, green and blue in its image; None where they are not known."""


@dataclass(frozen=True)
class Capture:
    """A multi-view recording with a tracked mesh of constant topology per timestep.

    faces      (F, 3) int32, shared by all timesteps
    neutral    (V, 3) float64 meters: the canonical mesh (expression and pose zero)
    views      split name ("train", "val", "test") -> its views; empty for a bare mesh sequence
    timesteps  all timesteps that have a mesh, ascending
    regions    key region name -> (F,) bool
    mesh       timestep -> (V, 3) float64, the tracked mesh in world space, read on demand
    expression_mesh  (timestep, zero_pose) -> (V, 3) float64 without rigid head motion (STGA, selective training)
    flame      the parameters and model behind the meshes, for FLAME captures
    flame_file the model's file; None without one
    given_selection  timestep -> (F,) bool where the capture comes with a selection
    warnings   one sentence each
    fps        timesteps per second, counted by their numbers: with 60, timestep 30 was recorded 0.5 s after timestep 0,
               also where those between are missing; None where unknown
    """

    root: Path
    layout: str
    faces: np.ndarray
    neutral: np.ndarray
    views: Mapping[str, tuple[View, ...]]
    timesteps: tuple[int, ...]
    regions: Mapping[str, np.ndarray]
    mesh: Callable[[int], np.ndarray]
    expression_mesh: Callable[[int, str], np.ndarray]
    flame: FlameSequence | None = None
    flame_file: Path | None = None
    given_selection: Mapping[int, np.ndarray] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    fps: float | None = None


def evenly_spread(items: Sequence[Item], limit: int) -> list[Item]:
    """At most `limit` of the items, such as views or timesteps: the first, the last, and those evenly between."""
    if len(items) <= limit:
        return list(items)
    return [items[n] for n in np.linspace(0, len(items) - 1, limit).round().astype(int)]
