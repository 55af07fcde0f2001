"""The person of the demo's capture: ICT-FaceKit's whole head with an identity, painted, and
hair."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...avatar.embedding import face_areas, face_frames
from ...capture.mesh_geometry import vertex_normals
from ...flame.forward import flame_forward, neutral_frame
from ...flame.model import JOINTS, POSE_FEATURES, FlameModel
from ...flame.parts import flame_model
from ..arkit_shapes import METERS_PER_UNIT
from ..bundled_head import (
    FACE,
    GUMS,
    LEFT_EYEBALL,
    MOUTH_INSIDE,
    RIGHT_EYEBALL,
    SKIN,
    TEETH,
    arkit_displacements,
    neutral_head,
    skinning_weights,
)

SURFACES = ("skin", "mouth", "gums", "teeth", "eyes")
"""Surfaces with a color each."""
IDENTITY_SEED = 14
"""Seed of the random identity."""
IDENTITIES = 40
"""Identity components that are drawn at random."""
IDENTITY_DEVIATION = 0.68
"""Standard deviation of their coefficients."""
EYES_IDENTITY = 10
"""Identity component that is set, because with it the lids close over the eyes."""
EYES = -0.3
"""Coefficient of EYES_IDENTITY."""
SEED = 7
"""Seed of the random hairs."""

SKIN_COLOR = np.array([0.66, 0.41, 0.305])
"""Color of skin before it is tinted, linear RGB."""
LIP_COLOR = np.array([0.48, 0.17, 0.155])
"""Color towards which lips are tinted, linear RGB."""
FLUSH = np.array([1.04, 0.72, 0.70])
"""Factor of the skin's linear RGB on cheeks and nose."""
SHADOW = np.array([0.84, 0.70, 0.68])
"""Factor of the skin's linear RGB around the eyes."""
MOUTH_COLOR = np.array([0.30, 0.075, 0.07])
"""Color of the mouth's lining, linear RGB."""
GUM_COLOR = np.array([0.42, 0.12, 0.11])
"""Color of the gums, linear RGB."""
TOOTH_COLOR = np.array([0.80, 0.75, 0.66])
"""Color of the teeth, linear RGB."""
SCALP_COLOR = np.array([0.06, 0.038, 0.025])
"""Color towards which the scalp is tinted under hair, linear RGB."""

PARTS = (
    ("skin", SKIN),
    ("mouth", MOUTH_INSIDE),
    ("gums", GUMS),
    ("teeth", TEETH),
    ("eyes", LEFT_EYEBALL),
    ("eyes", RIGHT_EYEBALL),
)
"""(surface, first and last vertex of ICT-FaceKit's)"""

# Heights are in ICT-FaceKit's axes.
LIP_LINE_CM = -3.35
"""Height of the line on which the lips meet."""
LIP_HALF_WIDTH_CM = 2.35
"""Distance of the mouth's corners from its middle."""
UPPER_LIP_CM = 0.98
"""Thickness of the upper lip in its middle, without the dip of the Cupid's bow."""
LOWER_LIP_CM = 1.28
"""Thickness of the lower lip in its middle."""

NECKLINE_CM = -10.6
"""Height on the axis of the head above which there is no cloth."""
NECKLINE_SLOPE = 0.30
"""Slope by which the neckline falls to the front."""
HEAD_AXIS_Z_CM = -1.0
"""Depth of the head's axis."""
HAIRLINE = (
    (0, 35, 55, 68, 78, 88, 97, 106, 115, 130, 150, 180),
    (6.6, 6.5, 5.0, 3.5, -1.0, 1.0, 1.5, -1.5, -5.0, -8.0, -9.5, -10.0),
)
"""(degrees from straight ahead, centimeters above the eyes)"""
BROW_HEIGHTS_CM = 1.95, 2.6, 2.1
"""Height of a brow above the eyes at its inner end, its arch and its outer end."""
REDNESS = 0.5
"""Redness of the hair's melanin, 0…1."""
LID_GAP_CM = 0.25
"""Largest distance of the upper lid's edge from the eyeball."""
LID_EDGE_CM = 0.06
"""Height above that edge up to which lashes grow."""
LID_CORNER_CM = -0.1
"""Height of the corners between lids, over the eyeball's middle."""
LID_HALF_WIDTH_CM = 1.05
"""Half the width of a lid's edge with lashes."""
LID_COLUMNS = 15
"""Places along a lid whose edge is looked for."""
HAIRS_PER_CLUMP = 30
"""Hairs that lean toward one of them."""
POINTS_PER_HAIR = 9
"""Points of the line that a hair is."""
LASHES = 260
"""Lashes of both eyes."""
LASH_LENGTH_M = 0.006
"""Typical length of a lash."""
LASH_RADIUS_M = 0.00008
"""Radius of a lash."""


@dataclass(frozen=True)
class Strands:
    """Hair of one kind on the neutral person.

    points (N, K, 3) meters; triangle (N,) that carries each; melanin and redness as Blender's
    Principled Hair has them.
    """

    name: str
    points: np.ndarray
    triangle: np.ndarray
    radius_m: float
    melanin: float
    redness: float


@dataclass(frozen=True)
class Person:
    """What is rendered. V vertices, F triangles.

    model      of ICT-FaceKit's vertices, with the bundled head's joints; shape (I,): the identity
    rest       (V, 3) meters, ICT-FaceKit's neutral head, to which colors are fixed
    neutral    (V, 3) meters, the person's
    surface    (F,) index into SURFACES
    tint       (V, 3) linear RGB; roughness and freckles (V,)
    eye        (V, 3) positions in an eyeball, in its radii
    neckline   (V,) centimeters above the cloth's edge
    """

    model: FlameModel
    shape: np.ndarray
    rest: np.ndarray
    neutral: np.ndarray
    surface: np.ndarray
    tint: np.ndarray
    roughness: np.ndarray
    freckles: np.ndarray
    eye: np.ndarray
    neckline: np.ndarray
    strands: tuple[Strands, ...]

    def carried(self, strands: Strands, vertices: np.ndarray) -> np.ndarray:
        """The hair's points (N, K, 3) on the posed vertices (V, 3)."""
        faces = self.model.faces[strands.triangle]
        rest, posed = (face_frames(mesh, faces, self.neutral) for mesh in (self.neutral, vertices))
        local = np.einsum("nab,nka->nkb", rest.rotation, strands.points - rest.origin[:, None])
        return np.asarray(np.einsum("nab,nkb->nka", posed.rotation, local) + posed.origin[:, None])


def make_person(arrays: Mapping[str, np.ndarray]) -> Person:
    """The demo's person, of the ICT-FaceKit arrays that `bundled_head.py` takes."""
    model = whole_head(arrays)
    shape = np.zeros(model.n_identity)
    shape[:IDENTITIES] = np.random.default_rng(IDENTITY_SEED).normal(
        0, IDENTITY_DEVIATION, IDENTITIES
    )
    shape[EYES_IDENTITY] = EYES
    neutral = flame_forward(model, shape, neutral_frame(model))
    paint = _Paint(model)
    return Person(
        model=model,
        shape=shape,
        rest=model.v_template,
        neutral=neutral,
        surface=paint.surface(),
        tint=paint.tint(),
        roughness=paint.roughness(),
        freckles=paint.freckles(),
        eye=paint.eye(),
        neckline=paint.at[:, 1] + NECKLINE_SLOPE * paint.at[:, 2] - NECKLINE_CM,
        strands=_all_strands(paint, neutral),
    )


def whole_head(arrays: Mapping[str, np.ndarray]) -> FlameModel:
    """ICT-FaceKit with all its vertices, posed as the bundled head is.

    Its vertices that the bundled head has are where that head's are.
    """
    bundled = flame_model(None)
    neutral = neutral_head(arrays)
    names, expression = arkit_displacements(arrays)
    displacements = np.concatenate(
        [arrays["identity"][: bundled.n_identity].astype(np.float64), expression]
    )
    template = METERS_PER_UNIT * neutral
    regressor = np.zeros((len(JOINTS), len(template)))
    regressor[:, cKDTree(template).query(bundled.v_template)[1]] = bundled.j_regressor
    return FlameModel(
        v_template=template,
        shapedirs=METERS_PER_UNIT * np.moveaxis(displacements, 0, -1),
        n_identity=bundled.n_identity,
        posedirs=np.zeros((len(template), 3, POSE_FEATURES)),
        j_regressor=regressor,
        parents=bundled.parents,
        weights=skinning_weights(neutral, np.arange(len(neutral))),
        faces=arrays["tris"].astype(np.int32),
        expression_names=names,
    )


def _step(values: np.ndarray, low: float | np.ndarray, high: float | np.ndarray) -> np.ndarray:
    """From 0 at `low` to 1 at `high`, smoothly."""
    t = np.clip((values - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def _spot(at: np.ndarray, center: tuple[float, float], size: tuple[float, float]) -> np.ndarray:
    """(N,) a soft spot on both sides of the face, in centimeters of x and y."""
    return np.asarray(
        np.exp(
            -(((abs(at[:, 0]) - center[0]) / size[0]) ** 2)
            - ((at[:, 1] - center[1]) / size[1]) ** 2
        )
    )


class _Paint:
    """Colors and densities of hair on ICT-FaceKit's neutral head, whose positions are in
    centimeters here."""

    def __init__(self, model: FlameModel) -> None:
        self.at = at = model.v_template / METERS_PER_UNIT
        self.faces = model.faces
        self.ids = np.arange(len(at))
        eye = at[slice(*LEFT_EYEBALL)]
        self.eye_at = (eye.min(0) + eye.max(0)) / 2
        self.eye_radius = float(np.ptp(eye[:, 1]) / 2)
        across = abs(at[:, 0])
        above = at[:, 1] - LIP_LINE_CM
        bow = np.clip(1 - (across / LIP_HALF_WIDTH_CM) ** 2, 0, 1) ** 0.6
        upper = UPPER_LIP_CM * bow - 0.13 * np.exp(-((across / 0.35) ** 2))
        height = np.where(above > 0, upper, LOWER_LIP_CM * bow)
        self.lips = (
            (1 - _step(abs(above) - height, -0.12, 0.06)) * (at[:, 2] > 9.5) * self.within(FACE)
        )
        self.front = _step(at[:, 2], 3.0, 6.0) * self.within(FACE)

    def within(self, part: tuple[int, int]) -> np.ndarray:
        return (self.ids >= part[0]) & (self.ids < part[1])

    def surface(self) -> np.ndarray:
        """(F,) index into SURFACES; -1 for what is not rendered: second shells, tear films, lashes'
        cards."""
        of = np.full(len(self.at), -1)
        for name, part in PARTS:
            of[slice(*part)] = SURFACES.index(name)
        return np.asarray(of[self.faces].min(1))

    def tint(self) -> np.ndarray:
        ex, ey = self.eye_at[:2]
        at = self.at
        tint = np.tile(SKIN_COLOR, (len(at), 1))

        def mix(color: np.ndarray, amount: np.ndarray) -> None:
            tint[:] += np.clip(amount, 0, 1)[:, None] * (color - tint)

        cheeks = _spot(at, (ex + 1.2, ey - 4.0), (2.4, 2.0)) + 0.6 * _spot(
            at, (0, ey - 4.2), (1.3, 1.2)
        )
        mix(SKIN_COLOR * FLUSH, 0.55 * self.front * cheeks)
        mix(SKIN_COLOR * SHADOW, 0.45 * self.front * _spot(at, (ex, ey - 0.1), (2.2, 1.3)))
        mix(LIP_COLOR, 0.85 * self.lips)
        mix(SCALP_COLOR, 0.9 * self.hair(at))
        for name, color in (("mouth", MOUTH_COLOR), ("gums", GUM_COLOR), ("teeth", TOOTH_COLOR)):
            tint[slice(*dict(PARTS)[name])] = color
        return tint

    def roughness(self) -> np.ndarray:
        ey = self.eye_at[1]
        shine = (
            0.10
            * self.front
            * (_spot(self.at, (0, ey + 3.5), (4, 2.5)) + _spot(self.at, (0, ey - 2.5), (1, 3)))
        )
        roughness = 0.47 - shine - 0.14 * self.lips
        return np.where(self.within(TEETH), 0.15, np.where(self.within(GUMS), 0.25, roughness))

    def freckles(self) -> np.ndarray:
        ex, ey = self.eye_at[:2]
        spots = _spot(self.at, (ex, ey - 3.4), (2.6, 1.5)) + _spot(
            self.at, (0, ey - 2.6), (2.0, 1.6)
        )
        return np.asarray(np.clip(spots, 0, 1) * self.front * (1 - self.lips))

    def eye(self) -> np.ndarray:
        """(V, 3) positions from the middle of the eyeballs, in their radii."""
        middle = np.where(self.at[:, :1] > 0, self.eye_at, self.eye_at * [-1, 1, 1])
        return np.asarray((self.at - middle) / self.eye_radius)

    def hair(self, at: np.ndarray) -> np.ndarray:
        """Density (N,) of hair at points (N, 3): 1 above the hairline, 0 on the ears."""
        around = np.degrees(np.arctan2(abs(at[:, 0]), at[:, 2] - HEAD_AXIS_Z_CM))
        line = self.eye_at[1] + np.interp(around, *HAIRLINE)
        return _step(at[:, 1] - line, -0.35, 0.35)

    def brows(self, at: np.ndarray) -> np.ndarray:
        """Density (N,) of the brows at points (N, 3)."""
        along = (abs(at[:, 0]) - 1.2) / 4.5
        middle = self.eye_at[1] + np.interp(along, (0, 0.62, 1), BROW_HEIGHTS_CM)
        half = np.interp(along, (-0.02, 0.1, 0.55, 1.0), (0.0, 0.32, 0.28, 0.08))
        inside = 1 - _step(abs(at[:, 1] - middle), 0.6 * half, half + 1e-6)
        return np.asarray(inside * (along > -0.02) * (along < 1) * (at[:, 2] > 3))

    def lid_edges(self, at: np.ndarray) -> np.ndarray:
        """Density (N,) of lashes at points (N, 3): 1 on the upper lids' edges. The skin above them
        that touches the eyeball is the lids' inner side."""
        out, up, is_lid = self._on_upper_lid(self.at[slice(*FACE)])
        columns = np.linspace(-LID_HALF_WIDTH_CM, LID_HALF_WIDTH_CM, LID_COLUMNS)
        half = LID_HALF_WIDTH_CM / (LID_COLUMNS - 1)
        edge = [up[is_lid & (abs(out - column) <= half)].min() for column in columns]
        out, up, is_lid = self._on_upper_lid(at)
        on_edge = up < np.interp(out, columns, edge) + LID_EDGE_CM
        return np.asarray((is_lid & on_edge & (abs(out) < LID_HALF_WIDTH_CM)).astype(float))

    def _on_upper_lid(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where points (N, 3) are: centimeters (N,) from the eyeball's middle to the temple and up,
        and whether they are near the eyeball's upper front."""
        away = at - np.where(at[:, :1] > 0, self.eye_at, self.eye_at * [-1, 1, 1])
        out = away[:, 0] * np.sign(at[:, 0])
        gap = np.linalg.norm(away, axis=1) - self.eye_radius
        above = (away[:, 1] > LID_CORNER_CM) & (away[:, 2] > 0)
        return out, away[:, 1], above & (gap < LID_GAP_CM)


def _scatter(
    paint: _Paint, density: Callable[[np.ndarray], np.ndarray], count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (N,) and barycentric coordinates (N, 3) of `count` points on the skin, by
    density."""
    skin = np.flatnonzero((paint.faces < MOUTH_INSIDE[0]).all(1))
    corners = paint.at[paint.faces[skin]]
    fraction = density(corners.mean(1)) * face_areas(paint.at, paint.faces[skin])
    triangle = rng.choice(len(skin), 2 * count, p=fraction / fraction.sum())
    inside = rng.dirichlet((1, 1, 1), len(triangle))
    kept = rng.random(len(triangle)) < density(np.einsum("nk,nka->na", inside, corners[triangle]))
    return skin[triangle[kept][:count]], inside[kept][:count]


@dataclass(frozen=True)
class _Growth:
    """How hair of one kind grows; roots (N, 3) are in centimeters on ICT-FaceKit's neutral head.

    heading    (roots, normals (N, 3) of the skin below) -> directions (N, 3), of which the part
               along the skin counts
    length     roots -> (N,) meters
    rise       degrees over the skin at the root, which `lift` (roots -> (N,)) scales, and at the
               tip
    disorder   standard deviation of each hair's own direction
    clump      fraction by which tips gather at that of one in HAIRS_PER_CLUMP hairs
    clearance  meters that tips keep from the skin
    """

    heading: Callable[[np.ndarray, np.ndarray], np.ndarray]
    length: Callable[[np.ndarray], np.ndarray]
    rise: tuple[float, float]
    disorder: float
    lift: Callable[[np.ndarray], np.ndarray] = lambda root: np.ones(len(root))
    clump: float = 0.0
    clearance: float = 0.0


def _grow(
    paint: _Paint,
    neutral: np.ndarray,
    triangle: np.ndarray,
    inside: np.ndarray,
    growth: _Growth,
    rng: np.random.Generator,
) -> np.ndarray:
    """Points (N, K, 3) in meters of hairs with these roots."""
    faces = paint.faces[paint.faces.max(1) < MOUTH_INSIDE[0]]
    normals = vertex_normals(neutral, faces)
    skin = np.flatnonzero(np.bincount(faces.ravel(), minlength=len(neutral)))
    tree = cKDTree(neutral[skin])
    corners = paint.faces[triangle]
    root = np.einsum("nk,nka->na", inside, neutral[corners])
    root_cm = np.einsum("nk,nka->na", inside, paint.at[corners])
    step = growth.length(root_cm) * rng.uniform(0.75, 1.1, len(root)) / (POINTS_PER_HAIR - 1)
    disorder = rng.normal(0, growth.disorder, (len(root), 3))
    points = [root]
    for number in range(1, POINTS_PER_HAIR):
        at = points[-1]
        near = skin[tree.query(at)[1]]
        normal = normals[near]
        along = growth.heading(root_cm, normal) + disorder
        along -= (along * normal).sum(1, keepdims=True) * normal
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
        fraction = (number - 1) / (POINTS_PER_HAIR - 2)
        rise = np.radians(
            growth.rise[0] * growth.lift(root_cm) * (1 - fraction) + growth.rise[1] * fraction
        )[:, None]
        at = at + step[:, None] * (np.cos(rise) * along + np.sin(rise) * normal)
        height = ((at - neutral[near]) * normal).sum(1)
        at = (
            at
            + np.maximum(growth.clearance * number / POINTS_PER_HAIR - height, 0)[:, None] * normal
        )
        points.append(at)
    hairs = np.stack(points, 1)
    if growth.clump:
        guides = rng.choice(len(root), max(1, len(root) // HAIRS_PER_CLUMP), replace=False)
        guide = guides[cKDTree(root[guides]).query(root)[1]]
        gathered = hairs[guide] + 0.25 * (root - root[guide])[:, None]
        hairs += (
            growth.clump * np.linspace(0, 1, POINTS_PER_HAIR)[:, None] ** 1.3 * (gathered - hairs)
        )
    return np.asarray(hairs)


def _lashes(paint: _Paint, neutral: np.ndarray, rng: np.random.Generator) -> Strands:
    """Lashes fan out from the upper lids' edges and curl up."""
    triangle, inside = _scatter(paint, paint.lid_edges, LASHES, rng)
    corners = paint.faces[triangle]
    root = np.einsum("nk,nka->na", inside, neutral[corners])
    away = np.einsum("nk,nka->na", inside, paint.at[corners])
    away -= np.where(away[:, :1] > 0, paint.eye_at, paint.eye_at * [-1, 1, 1])
    ahead = away * [0.75, 0.35, 1.0] + rng.normal(0, 0.06, away.shape)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    length = LASH_LENGTH_M * rng.uniform(0.7, 1.1, len(root))
    curl = np.array([0.0, 0.6, 0.0])
    t = np.linspace(0, 1, POINTS_PER_HAIR)[None, :, None]
    points = root[:, None] + length[:, None, None] * (t * ahead[:, None] + t**2 * curl)
    return Strands("lashes", points, triangle, LASH_RADIUS_M, 0.97, REDNESS)


def _all_strands(paint: _Paint, neutral: np.ndarray) -> tuple[Strands, ...]:
    rng = np.random.default_rng(SEED)

    def strands(
        name: str,
        density: Callable[[np.ndarray], np.ndarray],
        count: int,
        growth: _Growth,
        radius_m: float,
        melanin: float,
    ) -> Strands:
        triangle, inside = _scatter(paint, density, count, rng)
        return Strands(
            name,
            _grow(paint, neutral, triangle, inside, growth, rng),
            triangle,
            radius_m,
            melanin,
            REDNESS,
        )

    def top(root: np.ndarray) -> np.ndarray:
        return _step(root[:, 1] - paint.eye_at[1], 3.5, 8.0)

    def combed(root: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """To the person's left over the top; down and back at the sides and behind."""
        crown = np.tile([1.0, 0.0, -0.3], (len(root), 1))
        falling = np.tile([0.0, -1.0, -0.45], (len(root), 1))
        fraction = (top(root) * _step(normal[:, 1], 0.2, 0.7))[:, None]
        return np.asarray(fraction * crown + (1 - fraction) * falling)

    hair = _Growth(
        combed,
        lambda root: 0.022 + 0.048 * top(root),
        rise=(44, -24),
        disorder=0.14,
        lift=lambda root: 0.25 + 0.75 * top(root),
        clump=0.75,
        clearance=0.005,
    )
    brow = _Growth(
        lambda root, normal: np.stack(
            [np.sign(root[:, 0]), 0.75 - 0.22 * (abs(root[:, 0]) - 1.2), 0 * root[:, 0]], 1
        ),
        lambda root: np.full(len(root), 0.008),
        rise=(24, 4),
        disorder=0.15,
    )
    return (
        strands("hair", paint.hair, 19000, hair, 0.00013, 0.66),
        strands("brows", paint.brows, 700, brow, 0.00007, 0.75),
        _lashes(paint, neutral, rng),
    )
