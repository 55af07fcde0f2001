"""Data model of a capture, independent of its layout on disk, and its summary in a few lines of text."""

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


def parts_of(timesteps: Sequence[int], limit: int) -> list[list[int]]:
    """Consecutive parts of at most `limit` timesteps, the same on every machine; at least one."""
    return [part.tolist() for part in np.array_split(np.array(timesteps), max(1, -(-len(timesteps) // limit)))]


def summarize_capture(capture: Capture) -> list[tuple[str, str]]:
    """(label, value) lines: recording, tracking, warnings. Reads no image."""
    views = [view for split in capture.views.values() for view in split]
    lines = [("folder", str(capture.root)), ("layout", capture.layout)]
    lines += _recorded(capture, views) if views else [("cameras", "none: can be imported and animated, not trained on")]
    lines += [
        ("timesteps", format_ranges(capture.timesteps)),
        *([("frame rate", f"{capture.fps:g} frames per second")] if capture.fps is not None else []),
        ("mesh", f"{len(capture.neutral)} vertices, {len(capture.faces)} triangles"),
        ("regions", _regions(capture)),
    ]
    if capture.given_selection:
        shares = [float(np.mean(selected)) for selected in capture.given_selection.values()]
        lines.append(("given selection", f"{len(shares)} timesteps, {np.mean(shares):.1%} of the triangles on average"))
    return lines + _flame(capture) + [("warning", warning) for warning in capture.warnings]


def format_ranges(numbers: Sequence[int]) -> str:
    """Ascending whole numbers as count, ranges and gaps: "5: 0–2, 6–7 (gap 3–5)"."""
    starts = [n for i, n in enumerate(numbers) if i == 0 or numbers[i - 1] != n - 1]
    ends = [n for i, n in enumerate(numbers) if i == len(numbers) - 1 or numbers[i + 1] != n + 1]
    text = f"{len(numbers)}: " + ", ".join(_span(*pair) for pair in zip(starts, ends, strict=True))
    gaps = [_span(end + 1, start - 1) for end, start in zip(ends[:-1], starts[1:], strict=True)]
    return text + (f" ({'gap' if len(gaps) == 1 else 'gaps'} {', '.join(gaps)})" if gaps else "")


def _span(first: int, last: int) -> str:
    return str(first) if first == last else f"{first}–{last}"


def _recorded(capture: Capture, views: list[View]) -> list[tuple[str, str]]:
    sizes = sorted({(view.camera.width, view.camera.height) for view in views})
    masked = sum(view.mask is not None for view in views)
    splits = [f"{name} {_split(split)}" for name, split in capture.views.items() if split]
    return [
        ("cameras", format_ranges(sorted({view.camera_index for view in views}))),
        ("image size", ", ".join(f"{width} x {height}" for width, height in sizes)),
        ("masks", f"{masked} of {len(views)} views"),
        ("splits", "; ".join(splits)),
    ]


def _split(views: Sequence[View]) -> str:
    cameras = len({view.camera_index for view in views})
    return f"{len(views)} views ({len({view.timestep for view in views})} timesteps, {cameras} cameras)"


def _regions(capture: Capture) -> str:
    counts = [f"{name} {int(np.count_nonzero(members))}" for name, members in capture.regions.items()]
    return ", ".join(counts) + " triangles" if counts else "none"


def _flame(capture: Capture) -> list[tuple[str, str]]:
    """Largest offsets; the dynamic one is that of the first timestep."""
    if capture.flame is None:
        return []
    dynamic = capture.flame.frame(capture.flame.timesteps[0]).dynamic_offset
    offsets = (("static offset", capture.flame.static_offset), ("dynamic offset", dynamic))
    largest = [(name, None if o is None else 1000 * float(np.linalg.norm(o, axis=1).max())) for name, o in offsets]
    return [(name, "none" if offset is None else f"up to {offset:.1f} mm") for name, offset in largest]
