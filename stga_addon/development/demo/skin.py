"""Skin of the synthetic head: its neutral surface as a function of grid row and column.

A grid is bent around the vertical axis, with rows from the crown down to the neck's base. Two slits make the eyes and
one the mouth. Proportions are functions of position, so the same head exists at any density.
Meters, y up, facing +z; the person's left is +x.
"""

from dataclasses import dataclass

import numpy as np

COLUMNS = 52
# Height of each row at the front of the face; closer together where the face has more to say.
ROWS = np.array(
    [
        "0.130",
        "0.1265",
        "0.117",
        "0.104",
        "0.090",
        "0.076",
        "0.063",
        "0.052",
        "0.043",
        "0.035",
        "0.028",
        "0.0205",
        "0.0135",
        "0.0065",
        "-0.002",
        "-0.010",
        "-0.0175",
        "-0.0245",
        "-0.031",
        "-0.038",
        "-0.0445",
        "-0.050",
        "-0.0555",
        "-0.062",
        "-0.070",
        "-0.079",
        "-0.089",
        "-0.099",
        "-0.107",
        "-0.112",
        "-0.118",
        "-0.130",
        "-0.150",
        "-0.175",
    ],
    float,
)
EYE_ROW, EYE_COLUMNS = 11, (3, 9)  # the slit's corners, counted from the middle of the face
MOUTH_ROW, MOUTH_COLUMNS = 21, (-6, 6)
# The bare skull and neck, by height at the front: height at the back, half width, front, widest depth, back.
CONTOUR = np.array(
    [
        (0.130, 0.130, 0.000, -0.010, -0.010, -0.010),
        (0.1265, 0.127, 0.022, 0.016, -0.012, -0.040),
        (0.117, 0.116, 0.044, 0.046, -0.013, -0.072),
        (0.104, 0.102, 0.058, 0.067, -0.013, -0.091),
        (0.090, 0.089, 0.0665, 0.080, -0.013, -0.100),
        (0.063, 0.065, 0.0745, 0.0915, -0.012, -0.1075),
        (0.043, 0.048, 0.0762, 0.0945, -0.012, -0.107),
        (0.0205, 0.028, 0.0758, 0.0925, -0.011, -0.1045),
        (0.000, 0.011, 0.0735, 0.0895, -0.010, -0.099),
        (-0.0175, -0.005, 0.0705, 0.0865, -0.010, -0.0925),
        (-0.038, -0.021, 0.066, 0.0845, -0.010, -0.086),
        (-0.050, -0.029, 0.063, 0.083, -0.010, -0.083),
        (-0.062, -0.034, 0.0595, 0.081, -0.010, -0.081),
        (-0.079, -0.041, 0.0545, 0.0765, -0.011, -0.079),
        (-0.089, -0.046, 0.052, 0.072, -0.013, -0.078),
        (-0.099, -0.052, 0.0495, 0.059, -0.017, -0.0775),
        (-0.107, -0.060, 0.0485, 0.040, -0.023, -0.0775),
        (-0.112, -0.068, 0.048, 0.024, -0.028, -0.078),
        (-0.118, -0.079, 0.048, 0.015, -0.031, -0.078),
        (-0.130, -0.100, 0.0485, 0.0105, -0.034, -0.079),
        (-0.150, -0.135, 0.052, 0.0115, -0.035, -0.082),
        (-0.175, -0.172, 0.063, 0.020, -0.036, -0.092),
    ]
)
EYE = np.array([0.0295, 0.0195, 0.0680])  # center of the left eyeball
EYE_RADIUS, LID = 0.0127, 0.0014
MOUTH = np.array([0.0, -0.050, 0.085])


@dataclass(frozen=True)
class Skin:
    """Points on the grid: rest position (N, 3), angle from the front (N,), signed rows above eyes and mouth (N,)."""

    at: np.ndarray
    angle: np.ndarray
    above_eyes: np.ndarray
    above_mouth: np.ndarray

    @property
    def x(self) -> np.ndarray:
        return np.asarray(self.at[:, 0])

    @property
    def y(self) -> np.ndarray:
        return np.asarray(self.at[:, 1])

    @property
    def z(self) -> np.ndarray:
        return np.asarray(self.at[:, 2])


def smooth_step(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """0 below `low`, 1 above `high`, smooth between."""
    t = np.clip((values - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def _curve(at: np.ndarray, knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Smooth interpolation through (knots, values) ascending: cubic Hermite pieces, slopes that never overshoot."""
    step, rise = np.diff(knots), np.diff(values, axis=0)
    slope = rise / step[:, None]
    product = slope[1:] * slope[:-1]
    inner = np.where(product > 0, 2 * product / np.where(product > 0, slope[1:] + slope[:-1], 1), 0)
    tangent = np.concatenate([slope[:1], inner, slope[-1:]])
    piece = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(step) - 1)
    width = step[piece][:, None]
    t = ((at - knots[piece]) / step[piece])[:, None]
    start, end = values[piece], values[piece + 1]
    return np.asarray(
        start * (1 + 2 * t) * (1 - t) ** 2
        + end * t * t * (3 - 2 * t)
        + width * tangent[piece] * t * (1 - t) ** 2
        - width * tangent[piece + 1] * t * t * (1 - t)
    )


def side_sign(x: np.ndarray) -> np.ndarray:
    """-1 on the person's right, 1 on the left, and no jump in the middle."""
    return np.asarray(np.clip(x / 0.004, -1, 1))


def bump(skin_x: np.ndarray, skin_y: np.ndarray, at: tuple[float, float], size: tuple[float, float]) -> np.ndarray:
    """A Gaussian in the face's plane."""
    return np.asarray(np.exp(-(((skin_x - at[0]) / size[0]) ** 2) - ((skin_y - at[1]) / size[1]) ** 2))


def neutral_skin(row: np.ndarray, column: np.ndarray, under: np.ndarray) -> Skin:
    """The neutral face at fractional rows and columns; `under` marks the lower edges of the slits."""
    around = column / (COLUMNS / 2)
    angle = np.pi * (0.5 * around + 0.5 * around**3)  # half as far apart in front as evenly spaced columns would be
    front_y = _curve(row, np.arange(len(ROWS), dtype=float), ROWS[:, None])[:, 0]
    # The square root opens up the crown, where the contour is round.
    knots = np.sqrt(CONTOUR[0, 0] - CONTOUR[:, 0])
    back_y, width, front, middle, back = _curve(
        np.sqrt(np.maximum(CONTOUR[0, 0] - front_y, 0)), knots, CONTOUR[:, 1:]
    ).T
    facing = np.cos(angle)
    x = width * np.sin(angle)
    y = back_y + (front_y - back_y) * (1 + facing) / 2
    z = middle + np.where(facing > 0, front - middle, middle - back) * facing
    above_eyes, above_mouth = EYE_ROW - row, MOUTH_ROW - row
    above_eyes = np.where((above_eyes == 0) & under, -1e-9, above_eyes)
    above_mouth = np.where((above_mouth == 0) & under, -1e-9, above_mouth)
    skin = Skin(np.stack([x, y, z], 1), angle, above_eyes, above_mouth)
    return _open_slits(Skin(_features(skin), angle, above_eyes, above_mouth))


def _features(skin: Skin) -> np.ndarray:
    """Brows, eye sockets, nose, lips, chin and ears on the bare skull."""
    x, y, z = skin.x, skin.y, skin.z.copy()
    side = abs(x)
    face = smooth_step(np.cos(skin.angle), 0.1, 0.5)
    relief = 0.0035 * bump(side, y, (0.026, 0.043), (0.022, 0.009))  # brow ridge
    relief -= 0.0088 * bump(side, y, (0.028, 0.021), (0.018, 0.014))  # eye socket
    relief += 0.0045 * bump(side, y, (0.044, -0.006), (0.018, 0.014))  # cheekbone
    relief -= 0.0030 * bump(side, y, (0.043, -0.048), (0.014, 0.018))  # hollow of the cheek
    relief += 0.0105 * bump(side, y, (0.0, -0.084), (0.018, 0.014))  # chin
    relief -= 0.0040 * bump(side, y, (0.0, -0.0665), (0.022, 0.0055))  # below the lower lip
    relief += 0.0050 * bump(side, y, (0.0, -0.046), (0.030, 0.024))  # the jaws' arch
    relief -= 0.0012 * bump(side, y, (0.0, -0.036), (0.004, 0.006))  # philtrum
    relief += _nose(side, y)
    relief += _lips(side, skin)
    ear = bump(z, y, (-0.020, 0.006), (0.011, 0.027)) * (1 - 0.55 * bump(z, y, (-0.014, 0.008), (0.006, 0.014)))
    ear *= smooth_step(abs(np.sin(skin.angle)), 0.75, 0.95)
    out = np.stack([x + side_sign(x) * 0.019 * ear, y, z + face * relief - 0.010 * ear], 1)
    return np.asarray(out)


def _nose(side: np.ndarray, y: np.ndarray) -> np.ndarray:
    ridge = _curve(
        y,
        np.array([-0.20, -0.034, -0.029, -0.024, -0.0175, -0.010, 0.000, 0.014, 0.030, 0.042, 0.2]),
        np.array([[0, 0, 0.0065, 0.0195, 0.0262, 0.0245, 0.0190, 0.0110, 0.0052, 0, 0]]).T,
    )[:, 0]
    width = np.interp(y, [-0.03, -0.0175, 0.0, 0.03], [0.0115, 0.0105, 0.0085, 0.0095])
    wings = 0.0075 * bump(side, y, (0.0135, -0.0225), (0.0055, 0.0065))
    return np.asarray(ridge * np.exp(-((side / width) ** 2)) + wings)


def _lips(side: np.ndarray, skin: Skin) -> np.ndarray:
    along = np.clip(1 - (side / 0.027) ** 2, 0, 1)
    bow = 1 - 0.15 * np.exp(-((side / 0.004) ** 2))
    upper = 0.0040 * bow * np.exp(-(((skin.y - MOUTH[1] - 0.0048) / 0.0042) ** 2))
    lower = 0.0050 * np.exp(-(((skin.y - MOUTH[1] + 0.0062) / 0.0050) ** 2))
    crease = 0.0022 * np.exp(-(((skin.y - MOUTH[1]) / 0.0022) ** 2))
    return np.asarray(along**0.7 * (upper + lower - crease))


def _open_slits(skin: Skin) -> Skin:
    at = skin.at.copy()
    lid = lid_opening(skin)
    at[:, 1] += np.where(skin.above_eyes >= 0, 0.0056, -0.0034) * lid
    at[:, 1] += (
        np.where(skin.above_mouth >= 0, 0.0002, -0.0002)
        * np.clip(1 - (at[:, 0] / 0.024) ** 2, 0, 1)
        * (abs(skin.above_mouth) < 1)
    )
    for eye in (EYE, EYE * [-1, 1, 1]):
        at = push_outside_eyeball(at, eye)
    return Skin(at, skin.angle, skin.above_eyes, skin.above_mouth)


def lid_opening(skin: Skin) -> np.ndarray:
    """(N,) how far a point follows the lids' edge: 1 in the middle of the edge, 0 at the corners and away from it."""
    across = np.clip(1 - ((abs(skin.x) - 0.0290) / 0.0150) ** 2, 0, 1)
    return np.asarray(across**0.8 * np.exp(-abs(skin.above_eyes) / 1.6) * (np.cos(skin.angle) > 0))


def push_outside_eyeball(at: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Skin pushed forward where it would cut into the eyeball, smoothly, so that lids rest on it."""
    away = at - eye
    flat = np.clip(1 - (away[:, 0] ** 2 + away[:, 1] ** 2) / (EYE_RADIUS + LID) ** 2, 0, None)
    sphere = (EYE_RADIUS + LID) * np.sqrt(flat)
    near = (flat > 0) & (away[:, 2] > -EYE_RADIUS)
    out = at.copy()
    softly = 0.5 * (away[:, 2] + sphere + np.sqrt((away[:, 2] - sphere) ** 2 + 0.0012**2))
    blend = smooth_step(flat, 0.0, 0.25)
    out[:, 2] = np.where(near, eye[2] + away[:, 2] + blend * (softly - away[:, 2]), at[:, 2])
    return out


def above_hairline(at: np.ndarray) -> np.ndarray:
    """(N,) meters above the line where hair begins, by rest position (N, 3)."""
    _, y, z = at.T
    line = np.interp(
        z,
        [-0.088, -0.076, -0.064, -0.052, -0.040, 0.000, 0.010, 0.022, 0.040, 0.060, 0.090],
        [-0.060, -0.050, -0.026, 0.004, 0.029, 0.031, 0.024, 0.046, 0.068, 0.080, 0.087],
    )
    return np.asarray(y - line)


def hair_offset(at: np.ndarray) -> np.ndarray:
    """(N, 3) meters: how far hair stands off the skull, by rest position. A tracker finds it as the static offset."""
    away = at - [0.0, 0.03, -0.012]
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return np.asarray(0.007 * smooth_step(above_hairline(at), -0.001, 0.016)[:, None] * away)
