"""What a capture filmed, in words and as a picture: from which directions, and which expressions;
and what to film next."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

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
ONE_EXPRESSION = "one expression"
"""Description of a face that does not move."""
SECTOR_DEG = 15
"""Width of the cells into which directions around a head are divided."""
SECTORS = 360 // SECTOR_DEG
"""Cells around a head at one elevation."""
BANDS_DEG = (-90.0, -12.0, 25.0, 90.0)
"""Bounds of the cells' elevations: from below, level, from above."""
SIDE_DEG = 90
"""Angle up to which a head is to be filmed on both sides: to behind the ears."""
PICTURE_PX = 160
"""Side of the picture of directions."""
HEAD_RADIUS = 0.3
"""Radius of the head in that picture, as a fraction of half of its side; cells reach from there to
its border."""
OBSERVED_COLOR = (0.16, 0.62, 0.34, 1.0)
UNOBSERVED_COLOR = (0.3, 0.3, 0.3, 1.0)
HEAD_COLOR = (0.75, 0.6, 0.5, 1.0)


@dataclass(frozen=True)
class CaptureCoverage:
    """What a capture filmed. directions: (N, 2) of `observed_directions`; expressions: in words."""

    directions: np.ndarray
    expressions: str

    @property
    def text(self) -> str:
        """Such as "32 views, from 112° on its right to 110° on its left, 3° below to 9° above; one
        expression"."""
        parts = []
        if len(self.directions):
            right, low = self.directions.min(0).tolist()
            left, high = self.directions.max(0).tolist()
            around = f"from {_side(right)} to {_side(left)}, {_height(low)} to {_height(high)}"
            parts.append(f"{len(self.directions)} views, {around}")
        return "; ".join([*parts, self.expressions])

    @property
    def cells(self) -> list[int]:
        """Numbers of the cells that were filmed: sectors to the left, band by band."""
        across, up = self.directions.T
        sector = np.round(across / SECTOR_DEG).astype(int) % SECTORS
        band = np.digitize(up, BANDS_DEG[1:-1])
        return sorted(set((SECTORS * band + sector).tolist()))

    @property
    def next_take(self) -> str:
        """What to film next, in a sentence; "" where nothing is missing."""
        sectors = {cell % SECTORS for cell in self.cells}
        wanted = range(-SIDE_DEG // SECTOR_DEG, SIDE_DEG // SECTOR_DEG + 1)
        missing = [sector * SECTOR_DEG for sector in wanted if sector % SECTORS not in sectors]
        if len(self.directions) and missing:
            ends = {"right": min(missing) < 0, "left": max(missing) > 0}
            where = " and ".join(side for side, is_missing in ends.items() if is_missing)
            return f"Film next: once around the head, which keeps still, for its {where or 'front'}"
        if self.expressions == ONE_EXPRESSION:
            return "Film next: the face talking, from the front, for its expressions"
        return ""


def capture_coverage(capture: Capture) -> CaptureCoverage:
    """Directions and expressions of a capture, of evenly spread timesteps."""
    timesteps = evenly_spread(capture.timesteps, MAX_TIMESTEPS)
    directions = observed_directions(capture, timesteps)
    return CaptureCoverage(directions, _expressions(capture, timesteps))


@lru_cache(maxsize=8)
def directions_picture(cells: tuple[int, ...]) -> np.ndarray:
    """(PICTURE_PX, PICTURE_PX, 4) float32 from the bottom up: the head, seen from above, looks
    downwards amid the cells of directions, those from above within those from below."""
    across, up = np.meshgrid(*2 * [np.linspace(-1, 1, PICTURE_PX)])
    radius = np.hypot(across, up)
    sector = np.round(np.degrees(np.arctan2(across, -up)) / SECTOR_DEG).astype(int) % SECTORS
    bands = len(BANDS_DEG) - 1
    inwards = (1 - radius) / (1 - HEAD_RADIUS) * bands
    band = np.clip(np.floor(inwards).astype(int), 0, bands - 1)
    is_observed = np.isin(SECTORS * band + sector, cells)
    picture = np.where(is_observed[..., None], OBSERVED_COLOR, UNOBSERVED_COLOR)
    is_gap = np.abs(inwards - np.round(inwards)) < 0.04
    picture[(radius > 1) | is_gap] = 0
    nose = np.hypot(across / 0.6, up + HEAD_RADIUS - 0.04) < 0.11
    picture[radius < HEAD_RADIUS] = 0
    picture[(radius < HEAD_RADIUS - 0.06) | nose] = HEAD_COLOR
    return picture.astype(np.float32)


def observed_directions(capture: Capture, timesteps: Sequence[int]) -> np.ndarray:
    """(N, 2) degrees to the head's left and up, from which cameras see it in all views of some
    timesteps. Empty where the mesh does not show where eyes and mouth are."""
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
        return ONE_EXPRESSION
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
