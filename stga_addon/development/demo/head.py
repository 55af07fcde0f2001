"""A head of our own in FLAME's format, so that everything runs with no download.

Skin is a grid bent around the vertical axis: rows from the crown down to the neck's base, columns around. Two slits
make the eyes and one the mouth; their edges continue inwards as pockets. Proportions, blend shapes, weights and masks
are functions of position, so the same head exists at any density: `level` 1 is what a tracker would fit, a higher
level is what the camera sees. Metres, y up, facing +z; the person's left is +x.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...files import write_npz
from ...flame.model import JOINTS, MASK_PREFIX, POSE_FEATURES, FlameModel

IDENTITY = ("width", "length", "jaw", "nose", "cheekbones", "lips", "brow", "chin", "nostrils", "ears")
EXPRESSIONS = (
    "smile",
    "pucker",
    "frown",
    "brows_up",
    "brows_down",
    "cheek_puff",
    "blink_left",
    "blink_right",
    "lips_open",
    "squint",
)

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
EYE = np.array([0.0295, 0.0195, 0.0680])  # centre of the left eyeball
EYE_RADIUS, LID = 0.0127, 0.0014
MOUTH = np.array([0.0, -0.050, 0.085])
JOINTS_AT = np.array([[0, -0.150, -0.035], [0, -0.075, -0.035], [0, -0.012, 0.000], EYE, EYE * [-1, 1, 1]])


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


@dataclass(frozen=True)
class Head:
    """A head at one density: the model, each vertex's place on the average person, and its part (index of `PARTS`)."""

    model: FlameModel
    rest: np.ndarray
    part: np.ndarray


PARTS = ("skin", "mouth", "lid", "eyeball", "teeth")


def synthetic_flame(seed: int) -> FlameModel:
    """A made-up person in FLAME's format: 10 identity and 10 expression components (`IDENTITY`, `EXPRESSIONS`).

    About 2,100 vertices and 4,000 triangles, with vertex masks; a coefficient of 1 is one full action.
    """
    return synthetic_head(seed, 1).model


def write_flame(model: FlameModel, path: Path) -> None:
    """Write a model as .npz with FLAME's keys; `n_identity` and `masks/<region>` are stored beside them."""
    parents = model.parents.astype(np.int64) % (1 << 32)  # FLAME spells the root's parent 2**32 - 1
    arrays = {
        "v_template": model.v_template,
        "shapedirs": model.shapedirs,
        "posedirs": model.posedirs,
        "J_regressor": model.j_regressor,
        "kintree_table": np.stack([parents, np.arange(len(parents))]).astype(np.uint32),
        "weights": model.weights,
        "f": model.faces.astype(np.uint32),
        "n_identity": np.array(model.n_identity),
    }
    write_npz(path, arrays | {MASK_PREFIX + name: ids for name, ids in model.masks.items()}, compressed=True)


def synthetic_head(seed: int, level: int) -> Head:
    """The head of `synthetic_flame` with `level` times as many rows and columns; the motion is the same function."""
    grid = _Grid(level)
    skin, source = grid.skin, grid.source
    base, faces, part = [grid.positions], [grid.faces], [grid.part]
    directions, correctives = [_components(skin)[source]], [_correctives(skin)[source]]
    weights = [_skin_weights(skin)[source]]
    pieces: dict[str, np.ndarray] = {}
    start = len(grid.positions)
    for name, points, triangles, joint in (
        ("left_eyeball", *_eyeball(EYE, level), "left_eye"),
        ("right_eyeball", *_eyeball(EYE * [-1, 1, 1], level), "right_eye"),
        ("upper_teeth", *_tooth_row(level, 1), "neck"),
        ("lower_teeth", *_tooth_row(level, -1), "jaw"),
    ):
        pieces[name] = np.arange(start, start + len(points))
        base.append(points)
        faces.append(triangles + start)
        part.append(np.full(len(points), PARTS.index("eyeball" if "eye" in name else "teeth")))
        weights.append(np.tile(np.eye(len(JOINTS))[JOINTS.index(joint)], (len(points), 1)))
        correctives.append(np.zeros((len(points), 3, POSE_FEATURES)))
        directions.append(_rigid_components(points.mean(0), len(points)))
        start += len(points)
    rest, shapedirs = np.concatenate(base), np.concatenate(directions)
    person = 0.6 * np.random.default_rng(seed).normal(size=len(IDENTITY))
    model = FlameModel(
        v_template=rest + shapedirs[:, :, : len(IDENTITY)] @ person,
        shapedirs=shapedirs,
        n_identity=len(IDENTITY),
        posedirs=np.concatenate(correctives),
        j_regressor=_joint_regressor(rest, grid.coarse, pieces),
        parents=np.array([-1, 0, 1, 1, 1]),
        weights=np.concatenate(weights),
        faces=np.concatenate(faces).astype(np.int32),
        masks=_masks(grid, pieces),
    )
    return Head(model, rest, np.concatenate(part))


# The grid ------------------------------------------------------------------------------------------------------------


class _Grid:
    """Skin and pockets: positions (V, 3), faces, the grid point each vertex moves with, and parts.

    Vertex order: the rows below the crown, the crown, the slits' lower edges, the pockets.
    """

    def __init__(self, level: int) -> None:
        self.columns, self.rows = COLUMNS * level, (len(ROWS) - 1) * level
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        self.row, self.column = np.append((row + 1) / level, 0.0), np.append(self._signed(column) / level, 0.0)
        rings, above, below = self._cut_slits(level)
        self.skin = _skin(self.row, self.column, np.arange(len(self.row)) > self.rows * self.columns)
        self.faces = self._skin_faces(above, below)
        self.positions, self.source = self.skin.at, np.arange(len(self.row))
        self.part = np.zeros(len(self.row), int)
        for ring, kind in rings:
            self._add_pocket(ring, kind)
        self.coarse = np.flatnonzero((self.row % 1 == 0) & (self.column % 1 == 0))

    def _cut_slits(self, level: int) -> tuple[list[tuple[np.ndarray, str]], np.ndarray, np.ndarray]:
        """Rings of vertices around each slit, and vertex ids (rows, columns) as seen from above and from below."""
        above = np.arange(self.rows * self.columns).reshape(self.rows, self.columns)
        below = above.copy()
        left, right = EYE_COLUMNS, (-EYE_COLUMNS[1], -EYE_COLUMNS[0])
        rings = []
        for at, (first, last), kind in (
            (EYE_ROW, left, "lid"),
            (EYE_ROW, right, "lid"),
            (MOUTH_ROW, MOUTH_COLUMNS, "mouth"),
        ):
            inner = np.arange(first * level + 1, last * level)
            lower = len(self.row) + np.arange(len(inner))
            self.row = np.append(self.row, np.full(len(inner), float(at)))
            self.column = np.append(self.column, inner / level)
            below[at * level - 1, inner % self.columns] = lower
            upper = above[at * level - 1, np.arange(first * level, last * level + 1) % self.columns]
            rings.append((np.concatenate([upper, lower[::-1]]), kind))
        return rings, above, below

    def _signed(self, column: np.ndarray) -> np.ndarray:
        """Columns counted from the middle of the face: negative on the person's right."""
        return np.where(column > self.columns // 2, column - self.columns, column)

    def _skin_faces(self, above: np.ndarray, below: np.ndarray) -> np.ndarray:
        crown = self.rows * self.columns
        near, far = np.arange(self.columns), (np.arange(self.columns) + 1) % self.columns
        cap = np.stack([np.full(self.columns, crown), above[0][near], above[0][far]], 1)
        quads = [
            np.stack([below[r][near], above[r + 1][near], above[r + 1][far], below[r][far]], 1)
            for r in range(self.rows - 1)
        ]
        return np.concatenate([cap, _split(np.concatenate(quads), self.skin.at)])

    def _add_pocket(self, ring: np.ndarray, kind: str) -> None:
        """Continue a slit's edge inwards: behind the lids, or into the mouth."""
        edge = self.skin.at[ring]
        if kind == "lid":
            # Down onto the eyeball, so that no gap shows at the corners.
            eye = EYE * [np.sign(edge[0, 0]), 1, 1]
            inwards = (edge - eye) / np.linalg.norm(edge - eye, axis=1, keepdims=True)
            layers = [edge - [0, 0, 0.0012], eye + 0.96 * EYE_RADIUS * inwards]
        else:
            # The ring runs along the upper lip first.
            apart = np.clip(1 - (edge[:, :1] / 0.0245) ** 2, 0, 1) * [0, 1, 0]
            apart[len(ring) // 2 + 1 :] *= -1
            layers = [
                edge + 0.0006 * apart - [0, 0, 0.003],
                edge * [0.97, 1, 1] + 0.012 * apart - [0, 0, 0.010],
                edge * [0.90, 1, 1] + 0.014 * apart - [0, 0, 0.032],
            ]
        previous, size = ring, len(ring)
        for layer in layers:
            fresh = len(self.positions) + np.arange(size)
            after = np.roll(np.arange(size), -1)
            quads = np.stack([previous[after], previous, fresh, fresh[after]], 1)
            self.positions = np.concatenate([self.positions, layer])
            self.source = np.append(self.source, self.source[ring])
            self.part = np.append(self.part, np.full(size, PARTS.index(kind)))
            self.faces = np.concatenate([self.faces, _split(quads, self.positions)])
            previous = fresh
        if kind == "mouth":
            # Close the throat: both lips' ends joined by a band, corner to corner.
            upper, lower = previous[: size // 2 + 1], np.append(previous[0], previous[: size // 2 - 1 : -1])
            band = np.stack([lower[:-1], lower[1:], upper[1:], upper[:-1]], 1)
            self.faces = np.concatenate([self.faces, _whole(_split(band, self.positions))])


def _split(quads: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Two triangles of each quad (N, 4), cut along the shorter diagonal."""
    a, b, c, d = quads.T
    short = np.linalg.norm(at[a] - at[c], axis=1) <= np.linalg.norm(at[b] - at[d], axis=1) + 1e-9
    first = np.where(short, [a, b, c], [a, b, d])
    second = np.where(short, [a, c, d], [b, c, d])
    return np.asarray(np.stack([first, second], 1).transpose(2, 1, 0).reshape(-1, 3))


def _whole(faces: np.ndarray) -> np.ndarray:
    """Triangles with three different corners."""
    a, b, c = faces.T
    return np.asarray(faces[(a != b) & (b != c) & (c != a)])


def _smooth(values: np.ndarray, low: float, high: float) -> np.ndarray:
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


def _sideways(x: np.ndarray) -> np.ndarray:
    """-1 on the person's right, 1 on the left, and no jump in the middle."""
    return np.asarray(np.clip(x / 0.004, -1, 1))


def _bump(skin_x: np.ndarray, skin_y: np.ndarray, at: tuple[float, float], size: tuple[float, float]) -> np.ndarray:
    """A Gaussian in the face's plane."""
    return np.asarray(np.exp(-(((skin_x - at[0]) / size[0]) ** 2) - ((skin_y - at[1]) / size[1]) ** 2))


def _skin(row: np.ndarray, column: np.ndarray, under: np.ndarray) -> Skin:
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
    face = _smooth(np.cos(skin.angle), 0.1, 0.5)
    relief = 0.0035 * _bump(side, y, (0.026, 0.043), (0.022, 0.009))  # brow ridge
    relief -= 0.0088 * _bump(side, y, (0.028, 0.021), (0.018, 0.014))  # eye socket
    relief += 0.0045 * _bump(side, y, (0.044, -0.006), (0.018, 0.014))  # cheekbone
    relief -= 0.0030 * _bump(side, y, (0.043, -0.048), (0.014, 0.018))  # hollow of the cheek
    relief += 0.0105 * _bump(side, y, (0.0, -0.084), (0.018, 0.014))  # chin
    relief -= 0.0040 * _bump(side, y, (0.0, -0.0665), (0.022, 0.0055))  # below the lower lip
    relief += 0.0050 * _bump(side, y, (0.0, -0.046), (0.030, 0.024))  # the jaws' arch
    relief -= 0.0012 * _bump(side, y, (0.0, -0.036), (0.004, 0.006))  # philtrum
    relief += _nose(side, y)
    relief += _lips(side, skin)
    ear = _bump(z, y, (-0.020, 0.006), (0.011, 0.027)) * (1 - 0.55 * _bump(z, y, (-0.014, 0.008), (0.006, 0.014)))
    ear *= _smooth(abs(np.sin(skin.angle)), 0.75, 0.95)
    out = np.stack([x + _sideways(x) * 0.019 * ear, y, z + face * relief - 0.010 * ear], 1)
    return np.asarray(out)


def _nose(side: np.ndarray, y: np.ndarray) -> np.ndarray:
    ridge = _curve(
        y,
        np.array([-0.20, -0.034, -0.029, -0.024, -0.0175, -0.010, 0.000, 0.014, 0.030, 0.042, 0.2]),
        np.array([[0, 0, 0.0065, 0.0195, 0.0262, 0.0245, 0.0190, 0.0110, 0.0052, 0, 0]]).T,
    )[:, 0]
    width = np.interp(y, [-0.03, -0.0175, 0.0, 0.03], [0.0115, 0.0105, 0.0085, 0.0095])
    wings = 0.0075 * _bump(side, y, (0.0135, -0.0225), (0.0055, 0.0065))
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
    lid = _lid_opening(skin)
    at[:, 1] += np.where(skin.above_eyes >= 0, 0.0056, -0.0034) * lid
    at[:, 1] += (
        np.where(skin.above_mouth >= 0, 0.0002, -0.0002)
        * np.clip(1 - (at[:, 0] / 0.024) ** 2, 0, 1)
        * (abs(skin.above_mouth) < 1)
    )
    for eye in (EYE, EYE * [-1, 1, 1]):
        at = _outside_eyeball(at, eye)
    return Skin(at, skin.angle, skin.above_eyes, skin.above_mouth)


def _lid_opening(skin: Skin) -> np.ndarray:
    """(N,) how far a point follows the lids' edge: 1 in the middle of the edge, 0 at the corners and away from it."""
    across = np.clip(1 - ((abs(skin.x) - 0.0290) / 0.0150) ** 2, 0, 1)
    return np.asarray(across**0.8 * np.exp(-abs(skin.above_eyes) / 1.6) * (np.cos(skin.angle) > 0))


def _outside_eyeball(at: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Skin pushed forward where it would cut into the eyeball, smoothly, so that lids rest on it."""
    away = at - eye
    flat = np.clip(1 - (away[:, 0] ** 2 + away[:, 1] ** 2) / (EYE_RADIUS + LID) ** 2, 0, None)
    sphere = (EYE_RADIUS + LID) * np.sqrt(flat)
    near = (flat > 0) & (away[:, 2] > -EYE_RADIUS)
    out = at.copy()
    softly = 0.5 * (away[:, 2] + sphere + np.sqrt((away[:, 2] - sphere) ** 2 + 0.0012**2))
    blend = _smooth(flat, 0.0, 0.25)
    out[:, 2] = np.where(near, eye[2] + away[:, 2] + blend * (softly - away[:, 2]), at[:, 2])
    return out


# Pieces that move rigidly --------------------------------------------------------------------------------------------


def _eyeball(centre: np.ndarray, level: int) -> tuple[np.ndarray, np.ndarray]:
    """A globe (points, triangles) whose pole looks forward."""
    rings, around = 7 * level, 12 * level
    polar = np.pi * np.arange(1, rings) / rings
    turn = 2 * np.pi * np.arange(around) / around
    shell = np.stack(
        [
            np.sin(polar)[:, None] * np.cos(turn),
            np.sin(polar)[:, None] * np.sin(turn),
            np.cos(polar)[:, None] + 0 * turn,
        ],
        -1,
    ).reshape(-1, 3)
    points = np.concatenate([shell, [[0, 0, 1], [0, 0, -1]]])
    ids = np.arange(len(shell)).reshape(rings - 1, around)
    after = np.roll(ids, -1, axis=1)
    quads = np.stack([ids[:-1], ids[1:], after[1:], after[:-1]], -1).reshape(-1, 4)
    pole = np.full(around, len(shell))
    caps = [np.stack([pole, ids[0], after[0]], 1), np.stack([pole + 1, after[-1], ids[-1]], 1)]
    return centre + EYE_RADIUS * points, np.concatenate([_split(quads, points), *caps])


def _tooth_row(level: int, up: int) -> tuple[np.ndarray, np.ndarray]:
    """A curved band (points, triangles) behind the upper (`up` 1) or lower (-1) lip."""
    across, down = 12 * level, 2 * level
    bow = np.linspace(-1.15, 1.15, across + 1)
    drop = np.linspace(0.0, 1.0, down + 1)
    x = 0.0225 * np.sin(bow) / np.sin(1.15)
    z = MOUTH[2] - 0.0055 - (0.0 if up > 0 else 0.0016) - 0.020 * (1 - np.cos(bow))
    edge = MOUTH[1] - (0.0022 if up > 0 else 0.0030)
    y = edge + up * 0.0105 * drop
    points = np.stack(np.broadcast_arrays(x, y[:, None], z), -1).reshape(-1, 3)
    ids = np.arange(len(points)).reshape(down + 1, across + 1)
    corners = [ids[:-1, :-1], ids[:-1, 1:], ids[1:, 1:], ids[1:, :-1]]
    quads = np.stack(corners if up > 0 else corners[::-1], -1).reshape(-1, 4)
    return points, _split(quads, points)


# Blend shapes --------------------------------------------------------------------------------------------------------


def _vector(
    skin: Skin, x: np.ndarray | float = 0.0, y: np.ndarray | float = 0.0, z: np.ndarray | float = 0.0
) -> np.ndarray:
    return np.stack([np.broadcast_to(part, skin.x.shape) for part in (x, y, z)], 1)


def _components(skin: Skin) -> np.ndarray:
    """(N, 3, 20): identity, then expression displacements of the skin for a coefficient of 1."""
    return np.stack([*_identity(skin), *_expressions(skin)], -1)


def _identity(skin: Skin) -> list[np.ndarray]:
    x, y, side = skin.x, skin.y, abs(skin.x)
    front = _smooth(skin.z, -0.01, 0.05)
    cheek = front * _bump(side, y, (0.046, -0.006), (0.022, 0.018))
    chin = front * _bump(side, y, (0.0, -0.088), (0.028, 0.020))
    nose = front * _bump(side, y, (0.0, -0.014), (0.013, 0.016))
    lips = front * _bump(side, y, (0.0, MOUTH[1]), (0.020, 0.009))
    ears = _bump(skin.z, y, (-0.020, 0.006), (0.016, 0.030)) * _smooth(side, 0.06, 0.08)
    return [
        _vector(skin, x=0.030 * x),
        _vector(skin, y=0.035 * (y - EYE[1])),
        _vector(skin, x=0.075 * x * _smooth(-y, 0.025, 0.075) * _smooth(y, -0.13, -0.09)),
        _vector(skin, z=0.0035 * nose, y=-0.0012 * nose),
        _vector(skin, x=_sideways(x) * 0.0022 * cheek, z=0.0026 * cheek),
        _vector(skin, z=0.0018 * lips, y=np.where(skin.above_mouth >= 0, 0.0005, -0.0006) * lips),
        _vector(skin, z=0.0024 * front * _bump(side, y, (0.0, 0.056), (0.05, 0.022))),
        _vector(skin, z=0.0036 * chin, y=-0.0024 * chin),
        _vector(skin, x=0.10 * x * front * _bump(side, y, (0.012, -0.022), (0.010, 0.010))),
        _vector(skin, x=_sideways(x) * 0.0045 * ears),
    ]


def _expressions(skin: Skin) -> list[np.ndarray]:
    x, y, side, sign = skin.x, skin.y, abs(skin.x), _sideways(skin.x)
    front = _smooth(skin.z, 0.0, 0.045)
    corner = front * _bump(side, y, (0.025, MOUTH[1]), (0.014, 0.017))
    cheek = front * _bump(side, y, (0.040, -0.018), (0.017, 0.016))
    mouth = front * _bump(side, y, (0.0, MOUTH[1]), (0.027, 0.021))
    brow = front * _bump(side, y, (0.026, 0.046), (0.026, 0.017)) * _smooth(y, 0.024, 0.038)
    forehead = front * _bump(side, y, (0.0, 0.062), (0.055, 0.022)) * _smooth(y, 0.030, 0.045)
    inner_brow = front * _bump(side, y, (0.012, 0.042), (0.013, 0.013)) * _smooth(y, 0.020, 0.036)
    bulge = front * _bump(side, y, (0.040, -0.046), (0.016, 0.018)) * _smooth(side, 0.018, 0.034)
    lip = front * np.clip(1 - (side / 0.026) ** 2, 0, 1) * np.exp(-((y - MOUTH[1]) ** 2) / 0.012**2)
    parted = np.where(skin.above_mouth >= 0, 0.0042, -0.0058) * lip
    lower_lid = _lid_opening(skin) * (skin.above_eyes < 0)
    return [
        _vector(
            skin,
            sign * 0.0085 * corner + sign * 0.002 * cheek,
            0.0085 * corner + 0.004 * cheek,
            0.004 * cheek - 0.0045 * corner,
        ),
        _vector(skin, -0.42 * x * mouth, 0.0, 0.0085 * mouth),
        _vector(skin, sign * 0.002 * corner, -0.0085 * corner, -0.001 * corner),
        _vector(skin, 0.0, 0.0085 * brow + 0.0035 * forehead, 0.001 * brow),
        _vector(skin, -sign * 0.0035 * inner_brow, -0.0055 * brow - 0.003 * inner_brow, 0.0022 * inner_brow),
        _vector(skin, sign * 0.0085 * bulge, 0.0, 0.0055 * bulge),
        _blink(skin, EYE),
        _blink(skin, EYE * [-1, 1, 1]),
        _vector(skin, 0.0, parted, 0.0012 * lip),
        _vector(skin, 0.0, 0.0028 * cheek + 0.0022 * lower_lid, 0.0035 * cheek + 0.0008 * lower_lid),
    ]


def _blink(skin: Skin, eye: np.ndarray) -> np.ndarray:
    """The upper lid slides over the eyeball down to the lower one."""
    lid = _lid_opening(skin) * (skin.above_eyes >= 0) * (skin.x * eye[0] > 0)
    closed = skin.at + _vector(skin, y=-0.0088 * lid)
    return np.asarray((_outside_eyeball(closed, eye) - skin.at) * (lid > 0)[:, None])


def _rigid_components(centre: np.ndarray, count: int) -> np.ndarray:
    """Components of a piece at `centre`: it is carried along by identity, and untouched by expression."""
    where = Skin(centre[None], np.zeros(1), np.ones(1), np.ones(1))
    identity = np.stack(_identity(where), -1)
    rigid = np.concatenate([identity, np.zeros((1, 3, len(EXPRESSIONS)))], -1)
    return np.tile(rigid, (count, 1, 1))


# Skeleton ------------------------------------------------------------------------------------------------------------


def _skin_weights(skin: Skin) -> np.ndarray:
    """(N, 5) skinning weights: the neck carries the head, the jaw everything below the line from hinge to lips."""
    hinge = JOINTS_AT[2]
    line = np.arctan2(MOUTH[1] - hinge[1], MOUTH[2] - hinge[2])
    below = line - np.arctan2(skin.y - hinge[1], np.maximum(skin.z - hinge[2], 1e-3))
    jaw = _smooth(below, -0.22, 0.22) * _smooth(skin.z, -0.015, 0.045) * _smooth(skin.y, -0.135, -0.095)
    lip = np.clip(1 - (skin.x / 0.0245) ** 2, 0, 1) * np.exp(-((skin.y - MOUTH[1]) ** 2) / 0.016**2)
    lip = np.sqrt(lip) * _smooth(skin.z, 0.04, 0.06)
    jaw = np.where(skin.above_mouth >= 0, jaw * (1 - lip), jaw + (1 - jaw) * lip)
    root = 1 - _smooth(skin.y, -0.160, -0.085)
    weights = np.zeros((len(jaw), 5))
    weights[:, 0], weights[:, 2] = root * (1 - jaw), jaw
    weights[:, 1] = 1 - weights[:, 0] - weights[:, 2]
    return weights


def _correctives(skin: Skin) -> np.ndarray:
    """(N, 3, 36): cheeks hollow as the jaw opens, the throat gives way as the neck bends."""
    out = np.zeros((len(skin.x), 3, POSE_FEATURES))
    sine = 7  # entry (2, 1) of a rotation about x is the sine of its angle
    side = abs(skin.x)
    cheek = _smooth(skin.z, 0.0, 0.04) * _bump(side, skin.y, (0.044, -0.040), (0.018, 0.022))
    throat = _smooth(skin.z, -0.03, 0.01) * _bump(side, skin.y, (0.0, -0.115), (0.035, 0.016))
    out[:, 0, 9 + sine] = -_sideways(skin.x) * 0.006 * cheek
    out[:, 2, 9 + sine] = -0.004 * cheek
    out[:, 2, 0 + sine] = -0.006 * throat
    return out


def _joint_regressor(base: np.ndarray, coarse: np.ndarray, pieces: dict[str, np.ndarray]) -> np.ndarray:
    """(5, V): each joint as a weighted mean of skin around it, or of its eyeball. The same at every level."""
    regressor = np.zeros((5, len(base)))
    for joint, eyeball in ((3, "left_eyeball"), (4, "right_eyeball")):
        regressor[joint, pieces[eyeball]] = 1 / len(pieces[eyeball])
    for joint in range(3):
        band = coarse[abs(base[coarse, 1] - JOINTS_AT[joint, 1]) < 0.02]
        # Closest to the plain mean among the weights that hit the joint exactly.
        conditions = np.vstack([base[band].T, np.ones(len(band))])
        even = np.full(len(band), 1 / len(band))
        miss = np.append(JOINTS_AT[joint], 1) - conditions @ even
        regressor[joint, band] = even + conditions.T @ np.linalg.solve(conditions @ conditions.T, miss)
    return regressor


# Masks ---------------------------------------------------------------------------------------------------------------


def _masks(grid: _Grid, pieces: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """FLAME's regions by name -> vertex ids; pockets belong to the region of the edge they continue."""
    skin = grid.skin
    x, y, side = skin.x, skin.y, abs(skin.x)
    front = skin.z > 0.03
    hair = above_hairline(skin.at) > 0
    eye = front & (((side - EYE[0]) / 0.024) ** 2 + ((y - EYE[1]) / 0.018) ** 2 < 1)
    lips = front & ((x / 0.0275) ** 2 + ((y - MOUTH[1]) / 0.0125) ** 2 < 1)
    ear = (side > 0.06) & (abs(y - 0.006) < 0.034) & (abs(skin.z + 0.024) < 0.020)
    neck = (y < -0.100) | ((y < -0.06) & (skin.z < -0.02))
    regions = {
        "lips": lips,
        "nose": front & (side < 0.020) & (y > -0.033) & (y < 0.016) & ~eye & ~lips,
        "eye_region": eye,
        "left_eye_region": eye & (x > 0),
        "right_eye_region": eye & (x < 0),
        "left_ear": ear & (x > 0),
        "right_ear": ear & (x < 0),
        "forehead": front & (y > 0.042) & ~hair,
        "scalp": hair & ~ear,
        "neck": neck,
        "face": front & (y > -0.105) & ~hair,
        "boundary": grid.row == len(ROWS) - 1,
    }
    masks = {name: np.flatnonzero(inside[grid.source]) for name, inside in regions.items()}
    teeth = np.concatenate([pieces["upper_teeth"], pieces["lower_teeth"]])
    return masks | {name: pieces[name] for name in ("left_eyeball", "right_eyeball")} | {"teeth": teeth}


def above_hairline(at: np.ndarray) -> np.ndarray:
    """(N,) metres above the line where hair begins, by rest position (N, 3)."""
    _, y, z = at.T
    line = np.interp(
        z,
        [-0.088, -0.076, -0.064, -0.052, -0.040, 0.000, 0.010, 0.022, 0.040, 0.060, 0.090],
        [-0.060, -0.050, -0.026, 0.004, 0.029, 0.031, 0.024, 0.046, 0.068, 0.080, 0.087],
    )
    return np.asarray(y - line)


def hair_offset(at: np.ndarray) -> np.ndarray:
    """(N, 3) metres: how far hair stands off the skull, by rest position. A tracker finds it as the static offset."""
    away = at - [0.0, 0.03, -0.012]
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return np.asarray(0.007 * _smooth(above_hairline(at), -0.001, 0.016)[:, None] * away)
