"""What a capture filmed, in words: from which directions, and which expressions."""

from collections.abc import Sequence

import numpy as np

from .mesh_geometry import head_axes, weighted_procrustes
from .model import Capture, evenly_spread, views_by_timestep

MAX_TIMESTEPS = 64
"""Timesteps that are looked at, evenly spread."""
CLEAR_WEIGHT = 0.3
"""Weight of an expression, from which on it is named."""
MAX_NAMES = 6
"""Expressions that are named, the strongest first."""
SIDES = ("Left", "Right", "_L", "_R")
"""Ends of names of expressions of one side."""
FACE = ("left_eye", "right_eye", "nose", "mouth")
"""Regions that expressions move."""
STILL_MM = 1.0
"""Difference between timesteps of how far the face moves, below which it has one expression."""


def describe_filmed(capture: Capture) -> str:
    """Such as "32 views, from 112° on its right to 110° on its left, 3° below to 9° above; one
    expression"."""
    timesteps = evenly_spread(capture.timesteps, MAX_TIMESTEPS)
    directions = filmed_directions(capture, timesteps)
    parts = []
    if len(directions):
        right, low = directions.min(0).tolist()
        left, high = directions.max(0).tolist()
        around = f"from {_side(right)} to {_side(left)}, {_height(low)} to {_height(high)}"
        parts.append(f"{len(directions)} views, {around}")
    return "; ".join([*parts, _expressions(capture, timesteps)])


def filmed_directions(capture: Capture, timesteps: Sequence[int]) -> np.ndarray:
    """(N, 2) degrees to the head's left and up, from which cameras see it in all views of some
    timesteps. Empty where the mesh does not tell where eyes and mouth are."""
    neutral = np.asarray(capture.neutral, np.float64)
    axes = head_axes(neutral[capture.faces].mean(1), capture.regions)
    if axes is None:
        return np.zeros((0, 2))
    middle = neutral.mean(0)
    views = views_by_timestep(capture.all_views)
    found = []
    for timestep in timesteps:
        mesh = np.asarray(capture.mesh(timestep), np.float64)
        rotation, shift = weighted_procrustes(mesh, neutral, np.ones(len(mesh)))
        for view in views.get(timestep, ()):
            eye = rotation @ view.camera.position + shift
            across, up, ahead = axes[1] @ (eye - middle)
            found.append((np.arctan2(across, ahead), np.arctan2(up, np.hypot(across, ahead))))
    return np.degrees(np.array(found).reshape(-1, 2))


def _side(degrees: float) -> str:
    if round(degrees) == 0:
        return "straight ahead"
    return f"{abs(degrees):.0f}° on its {'left' if degrees > 0 else 'right'}"


def _height(degrees: float) -> str:
    return f"{abs(degrees):.0f}° {'above' if degrees >= 0 else 'below'}"


def _expressions(capture: Capture, timesteps: Sequence[int]) -> str:
    """The expressions of some timesteps, by how far eyes, nose and mouth move: shoulders do too."""
    known = [capture.regions[name] for name in FACE if name in capture.regions]
    of_face = np.unique(capture.faces[np.any(known, axis=0)] if known else capture.faces)
    moved = []
    for timestep in timesteps:
        mesh = capture.expression_mesh(timestep, "head")
        away = (mesh - capture.neutral)[of_face]
        moved.append(1000 * float(np.linalg.norm(away - np.median(away, axis=0), axis=1).max()))
    if len(timesteps) < 2 or max(moved) - min(moved) < STILL_MM:
        return "one expression"
    text = f"{len(capture.timesteps)} moments, in which the face moves by up to {max(moved):.0f} mm"
    sequence = capture.flame
    names = () if sequence is None else sequence.model.expression_names
    if sequence is None or not names:
        return text
    strongest: dict[str, float] = {}
    for timestep in timesteps:
        for name, weight in zip(names, sequence.frame(timestep).expr.tolist(), strict=False):
            both = next((name.removesuffix(end) for end in SIDES if name.endswith(end)), name)
            strongest[both] = max(strongest.get(both, 0.0), weight)
    clear = sorted((-weight, name) for name, weight in strongest.items() if weight >= CLEAR_WEIGHT)
    return f"{text}: {', '.join(name for _, name in clear[:MAX_NAMES])}" if clear else text
