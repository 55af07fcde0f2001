"""Which visible triangles of a head unseen ones look like: hair like hair, a neck like a neck."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...capture.mesh_geometry import connected_parts, head_axes
from ...capture.model import Capture
from ...flame.model import faces_within

SCALP_ANGLE_DEG = 66.0
"""Angle from straight ahead, from the middle of the head, behind which hair grows."""
SCALP_ELEVATION_DEG = 38.0
"""Elevation above which hair grows."""
NECK_ANGLE_DEG = 60.0
"""Angle from straight ahead behind which the neck begins."""
EYES_TO_MIDDLE = 1.35
"""Distance of the head's middle behind the eyes, in distances of the eyes from the mouth, the unit
of all lengths here."""
BROWS_OVER_EYES = 0.15
"""Height of the head's middle above the eyes: that of the brows."""
BROWS_LEVEL = 0.45
"""Height of the brows over the eyes."""
JAW_LEVEL = -0.5
"""Height of the jaw over the eyes."""
CHIN_LEVEL = -2.0
"""Height of the chin over the eyes."""
TORSO_HEIGHT = 2.0
"""Least extent of a torso; the end of a bust has less."""
JAW_DEG = (76.0, 90.0)
"""Angles from straight ahead between which the jaw's lower end rises to what is behind it."""
JAW = (-1.0, JAW_LEVEL)
"""Heights over the eyes at JAW_DEG below which the neck begins."""
HAIRLINE_DEG = (84.0, 112.0, 140.0)
"""Angles from straight ahead of the hairline's points."""
HAIRLINE = (0.15, -0.55, -1.15)
"""Heights over the eyes at HAIRLINE_DEG below which no hair grows; it begins above the ears."""
LONG_HAIRLINE = (-1.0, -2.3, -2.3)
"""Heights over the eyes at HAIRLINE_DEG below which no long hair hangs."""
LONG_HAIR_SIDE = 1.1
"""Distance from the middle plane beyond which long hair does not hide shoulders."""
EAR_SIDE = 0.93
"""Distance of ears from the middle plane at least."""
EAR_LEVEL = -0.33
"""Height of the ears' middle over the eyes."""
EAR_HEIGHT = 0.57
"""Half the height of an ear."""
EAR_ANGLE_DEG = 90.0
"""Angle of the ears' middle from straight ahead."""
EAR_WIDTH_DEG = 14.0
"""Half the angle that an ear takes up."""
MIN_HAIR_CONTRAST = 0.9
"""A triangle of the scalp has hair if its color is this far from the skin's, as a fraction of the
scalp's most different ones, in standard deviations of skin."""
LEAST_SHADE = 0.02
"""Least standard deviation of skin's shades, in colors of 0…1."""
SMOOTHED = 24
"""Triangles around one over which a decision or color is smoothed."""

LINING_REACH = 1.3
"""Distance from the mouth's middle within which its lining and throat lie."""
LINING_LEVEL = -0.4
"""Height over the eyes below which they lie; the sockets of the eyes are as near."""
TONGUE_REACH = 0.5
"""Distance from the mouth's middle within which everything but skin is teeth, gums or tongue."""
DEPTHS = (0.0, 0.25, 0.45, 0.75)
"""Distances from the visible lips at which the colors of a mouth's inside are given: it gets darker
inward."""
LIP_FRACTION = 0.75
"""Brightness of the lining at the lips, as a fraction of theirs."""
GUM_FRACTIONS = np.array([[0.43, 0.24, 0.22], [0.22, 0.1, 0.09], [0.12, 0.04, 0.03]])
"""Color of gums and tongue at the later DEPTHS, as fractions of the eyes' white."""
TOOTH_DEPTHS = (0.05, 0.15, 0.5)
"""Distances from the visible lips at which the brightness of teeth is given."""
TOOTH_FRACTIONS = (0.92, 0.74, 0.23)
"""Brightness of teeth at TOOTH_DEPTHS, as fractions of the eyes' white."""
WHITE_QUANTILE = 0.8
"""Quantile of the eyeballs' brightness above which triangles are white."""
WHITE = np.array([0.75, 0.67, 0.63])
"""Color of the eyes' white in daylight, for heads without eyes."""


@dataclass(frozen=True)
class HeadCoordinates:
    """Triangles' places around the neutral head, seen from its middle at the height of the brows.

    azimuth    (F,) radians from straight ahead, positive on the left
    elevation  (F,) radians
    level      (F,) height over the eyes, in distances of the eyes from the mouth
    side       (F,) distance from the middle plane, in the same unit
    unit       meters from the eyes to the mouth
    eyes       (3,) their middle
    middle     (3,) of the head, at the height of the brows
    axes       (3, 3) unit vectors to the head's left, up and ahead
    """

    azimuth: np.ndarray
    elevation: np.ndarray
    level: np.ndarray
    side: np.ndarray
    unit: float
    eyes: np.ndarray
    middle: np.ndarray
    axes: np.ndarray

    @property
    def angle_deg(self) -> np.ndarray:
        """(F,) from straight ahead, to either side."""
        return np.asarray(np.degrees(np.abs(self.azimuth)))


def head_coordinates(capture: Capture) -> HeadCoordinates | None:
    """None for a mesh whose eyes and mouth are not known, or not apart."""
    centers = np.asarray(capture.neutral, np.float64)[capture.faces].mean(1)
    found = head_axes(centers, capture.regions)
    if found is None:
        return None
    eyes, axes, unit = found
    across, up, ahead = axes
    middle = eyes + unit * (BROWS_OVER_EYES * up - EYES_TO_MIDDLE * ahead)
    x, y, z = ((centers - middle) @ axis for axis in (across, up, ahead))
    return HeadCoordinates(
        azimuth=np.arctan2(x, z),
        elevation=np.arctan2(y, np.hypot(x, z)),
        level=(centers - eyes) @ up / unit,
        side=np.abs(x) / unit,
        unit=unit,
        eyes=eyes,
        middle=middle,
        axes=axes,
    )


def ears_of(at: HeadCoordinates) -> np.ndarray:
    """(F,) bool: triangles of ears."""
    ear = (at.side > EAR_SIDE) & (abs(at.angle_deg - EAR_ANGLE_DEG) < EAR_WIDTH_DEG)
    return np.asarray(ear & (abs(at.level - EAR_LEVEL) < EAR_HEIGHT))


def face_of(at: HeadCoordinates) -> np.ndarray:
    """(F,) bool: triangles between brows and neck, ahead of the ears."""
    ahead = at.angle_deg < NECK_ANGLE_DEG
    return np.asarray(ahead & (at.level < BROWS_LEVEL) & (at.level > CHIN_LEVEL))


def kinds_of(
    at: HeadCoordinates, is_outside: np.ndarray, has_long_hair: bool = False
) -> dict[str, np.ndarray]:
    """Kind -> (F,) bool: "scalp", which includes the back of a neck that long hair hides, and
    "body", neck and shoulders. Unseen parts of each kind look like visible ones of it."""
    angle = at.angle_deg
    elevation = np.degrees(at.elevation)
    ear = ears_of(at)
    hairline = np.interp(angle, HAIRLINE_DEG, LONG_HAIRLINE if has_long_hair else HAIRLINE)
    hairy = (angle > SCALP_ANGLE_DEG) | (elevation > SCALP_ELEVATION_DEG)
    scalp = is_outside & ~ear & hairy & (at.level > hairline)
    if has_long_hair:
        scalp &= (at.side < LONG_HAIR_SIDE) | (at.level > JAW_LEVEL)
    beside = (angle > NECK_ANGLE_DEG) | (at.level < CHIN_LEVEL)
    below_jaw = at.level < np.interp(angle, JAW_DEG, JAW)
    body = is_outside & ~ear & ~scalp & beside & below_jaw
    return {"scalp": scalp, "body": body}


def nearest_rows(known: np.ndarray, places: np.ndarray, count: int) -> np.ndarray:
    """Rows (N, count) of the known places (M, 3) that are nearest to each of these (N, 3), the
    nearest first; M where there are fewer."""
    _, rows = cKDTree(known).query(places, np.arange(min(count, len(known))) + 1)
    return np.asarray(rows)


def hairy_triangles(
    sources: np.ndarray, centers: np.ndarray, color: np.ndarray, skin: np.ndarray
) -> np.ndarray:
    """Triangles of a scalp whose color differs from skin by more than skin's shades (K, 3) do among
    each other; all of them where no skin is known."""
    if not len(sources) or not len(skin):
        return sources
    median = np.median(skin, axis=0)
    shades = (skin - median).T @ (skin - median) / len(skin) + LEAST_SHADE**2 * np.eye(3)
    away = color[sources] - median
    contrast = np.sqrt((away * np.linalg.solve(shades, away.T).T).sum(1))
    near = nearest_rows(centers[sources], centers[sources], SMOOTHED)
    contrast = np.quantile(contrast[near], 0.1, axis=1)
    return np.asarray(sources[contrast > MIN_HAIR_CONTRAST * np.quantile(contrast, 0.9)])


def inside_colors(
    capture: Capture, color: np.ndarray, shown: np.ndarray, inside: np.ndarray
) -> np.ndarray:
    """Colors (M, 3) of triangles `inside` (F,) bool that no view shows and that motion of mouth or
    lids exposes: teeth, gums and lining near the mouth, in the light on the person's lips and eyes;
    the hidden part of eyeballs, as white as the visible part; elsewhere the color of the skin
    around. color, shown: of `mean_colors`."""
    faces = capture.faces
    centers = np.asarray(capture.neutral)[faces].mean(1)
    skin = skin_of(capture)
    known = np.flatnonzero(shown & skin)
    if not len(known) or not inside.any():
        return np.asarray(color[inside])
    near = nearest_rows(centers[known], centers[inside], SMOOTHED)
    found = np.median(color[known[near]], axis=1)
    eyeballs = eyeballs_of(capture)
    white = _white_of_eyes(color[eyeballs & shown])
    found[eyeballs[inside]] = white
    at = head_coordinates(capture)
    if at is None:
        return np.asarray(found)
    mouth = capture.regions["mouth"]
    lips = mouth & skin & shown
    if not lips.any():
        return np.asarray(found)
    away = np.linalg.norm(centers - centers[mouth].mean(0), axis=1) / at.unit
    part = connected_parts(len(capture.neutral), faces)[faces[:, 0]]
    in_mouth = np.isin(part, part[~skin & (away < TONGUE_REACH)])
    within = inside & (in_mouth | lining_of(capture))
    depth = cKDTree(centers[lips]).query(centers[within])[0] / at.unit
    colors = np.vstack([LIP_FRACTION * np.median(color[lips], axis=0), GUM_FRACTIONS * white])
    inner = np.stack([np.interp(depth, DEPTHS, channel) for channel in colors.T], axis=1)
    teeth = teeth_of(capture)[within]
    inner[teeth] = np.interp(depth[teeth], TOOTH_DEPTHS, TOOTH_FRACTIONS)[:, None] * white
    found[within[inside]] = inner
    return np.asarray(found)


def _white_of_eyes(colors: np.ndarray) -> np.ndarray:
    """(3,) of the colors (M, 3) of those triangles of eyeballs that views show."""
    if not len(colors):
        return WHITE
    bright = colors[np.argsort(colors.sum(1))]
    return np.asarray(bright[int(WHITE_QUANTILE * len(bright)) :].mean(0))


def skin_of(capture: Capture) -> np.ndarray:
    """(F,) bool: the largest connected part of the mesh."""
    part = connected_parts(len(capture.neutral), capture.faces)[capture.faces[:, 0]]
    return np.asarray(part == np.bincount(part).argmax())


def lining_of(capture: Capture) -> np.ndarray:
    """(F,) bool: skin so near to the middle of the mouth that it may line it; none where the mouth
    is not known."""
    at = head_coordinates(capture)
    if at is None:
        return np.zeros(len(capture.faces), bool)
    centers = np.asarray(capture.neutral)[capture.faces].mean(1)
    away = np.linalg.norm(centers - centers[capture.regions["mouth"]].mean(0), axis=1)
    near = (away < LINING_REACH * at.unit) & (at.level < LINING_LEVEL)
    return np.asarray(skin_of(capture) & near)


def teeth_of(capture: Capture) -> np.ndarray:
    """(F,) bool: teeth, where the head model marks them."""
    return _in_masks(capture, ("teeth",))


def eyeballs_of(capture: Capture) -> np.ndarray:
    """(F,) bool: eyeballs, where the head model marks them."""
    return _in_masks(capture, ("left_eyeball", "right_eyeball"))


def _in_masks(capture: Capture, names: Collection[str]) -> np.ndarray:
    masks = {} if capture.flame is None else capture.flame.model.masks
    found = np.zeros(len(capture.faces), bool)
    for name in masks.keys() & set(names):
        found |= faces_within(capture.faces, masks[name])
    return found
