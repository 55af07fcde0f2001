"""ARKit's 52 weights as parameters of one FLAME head: fitted, or exact for the bundled head."""

import hashlib
from dataclasses import dataclass

import numpy as np

from ..capture.mesh_geometry import similarity
from ..errors import StgaError
from ..export.rig import ShapeControls
from ..flame.forward import RIGID_SIZE, FlameFrame
from ..flame.model import JOINTS, FlameModel
from ..flame.quaternions import from_axis_angle, multiply, to_axis_angle
from ..flame.sequence import FlameSequence, with_identity
from ..tracking.posed_points import PosedPoints, SurfacePoints
from .performance import ARKIT_SHAPES, COLUMN, COUNT, OPTIONAL, Performance
from .shapes import JAW_OPEN, MOUTH_CLOSE, effective_weights, face_points, face_shapes

JAW_SHAPES = ("jawOpen", "jawLeft", "jawRight")
"""Those that turn the jaw; jawForward, which a rotation cannot do, is left to the expressions."""
PRODUCT_SHAPES = tuple(name for name in ARKIT_SHAPES if name.startswith(("jaw", "mouth")))
"""Shapes whose products with jawOpen are features: a jaw that turns carries what they move."""
PRODUCTS = np.array([COLUMN[name] for name in PRODUCT_SHAPES])
"""Columns of PRODUCT_SHAPES among ARKit's shapes."""
FEATURES = COUNT + len(PRODUCTS)
"""Features of a face (`features`): the weights, then the products."""

GAZE_RAD = 0.61
"""Angle of an eye at weight 1 of an eyeLook shape, the largest in Live Link Face's takes."""
RIDGE_M = 5e-5  # RMS displacement of the face that a unit of a coefficient must be worth
JAW_STEPS = 4
MAX_JAW_RAD = 0.8  # Angle that no jaw reaches; beyond it, the fit has left its linear range
# jawOpen, jawLeft and jawRight at which the other shapes are combined.
JAW_POSES = (
    (0, 0, 0), (0.25, 0, 0), (0.5, 0, 0), (0.75, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1),
    (0, 0.5, 0), (0, 0, 0.5), (0.5, 0.5, 0), (0.5, 0, 0.5), (1, 1, 0), (1, 0, 1), (0.25, 1, 0),
    (0.25, 0, 1),
)  # fmt: skip
COMBINATIONS = 60  # Random combinations of the other shapes at each of the poses of the jaw
ACTIVE_FRACTION = 0.35  # Fraction of the shapes in a combination
CACHED_MAPS = 8
_cache: dict[bytes, "HeadMap"] = {}


@dataclass(frozen=True)
class HeadMap:
    """Parameters of a head of E expressions as functions of ARKit weights.

    points       where the N face points lie on the head's mesh
    used         (478,) bool: which of MediaPipe's landmarks they are
    targets      (52, N, 3) meters: what each shape does to them on this head
    expressions  (FEATURES, E) coefficients per feature (`features`)
    jaw          (52, 3) axis-angle per weight
    eyes         (52, 6) axis-angle of left and right eye per weight
    """

    points: SurfacePoints
    used: np.ndarray
    targets: np.ndarray
    expressions: np.ndarray
    jaw: np.ndarray
    eyes: np.ndarray

    def parameters(self, weights: np.ndarray) -> np.ndarray:
        """(T, E + 9) expression coefficients, jaw and eyes of weights (T, 52)."""
        effective = effective_weights(weights)
        expressions = features(weights) @ self.expressions
        return np.hstack([expressions, effective @ self.jaw, effective @ self.eyes])

    def frames(self, performance: Performance) -> list[FlameFrame]:
        """One frame per row of the performance; the head's rotation turns the neck."""
        values = self.parameters(performance.weights)
        zero = np.zeros(3)
        count = self.expressions.shape[1]
        turns = head_turns(performance.head)
        return [
            FlameFrame(row[:count], zero, turn, row[count : count + 3], zero, row[count + 3 :])
            for row, turn in zip(values, turns, strict=True)
        ]


def features(weights: np.ndarray) -> np.ndarray:
    """(T, FEATURES): `effective_weights` of (T, 52), then jawOpen times PRODUCT_SHAPES."""
    effective = effective_weights(weights)
    return np.hstack([effective, effective[:, JAW_OPEN, None] * effective[:, PRODUCTS]])


def head_turns(angles: np.ndarray) -> np.ndarray:
    """Axis-angle (T, 3) of yaw, pitch and roll: about y, the turned x, then the turned z."""
    yaw, pitch, roll = np.asarray(angles, np.float64).T
    zero = np.zeros_like(yaw)
    about = [(zero, yaw, zero), (pitch, zero, zero), (zero, zero, roll)]
    first, second, third = (from_axis_angle(np.stack(axis, axis=1)) for axis in about)
    return to_axis_angle(multiply(multiply(first, second), third))


def head_map(sequence: FlameSequence, name: str) -> HeadMap:
    """The map for a model and identity, kept in memory; `name` is what errors call the head. Raises
    StgaError as `face_points` does."""
    person = with_identity(sequence).model
    digest = hashlib.blake2b()
    for field in ("v_template", "shapedirs", "posedirs", "weights", "j_regressor", "faces"):
        digest.update(np.ascontiguousarray(getattr(person, field)).tobytes())
    key = digest.digest()
    if key not in _cache:
        places, used = face_points(sequence.model, name)
        points = SurfacePoints(places.face[used], places.barycentric[used])
        if person.expression_names:
            _cache[key] = _named(person, points, used)
        else:
            fit = _Fit(person, points, used)
            _cache[key] = HeadMap(points, used, fit.targets, fit.expressions(), fit.jaw, _gaze())
        if len(_cache) > CACHED_MAPS:
            del _cache[next(iter(_cache))]
    return _cache[key]


def person_of(model: FlameModel, neutral: np.ndarray) -> FlameSequence:
    """A sequence without timesteps of the person whose neutral mesh (V, 3) this is."""
    no_frames: dict[int, FlameFrame] = {}
    offset = neutral - model.v_template
    return FlameSequence(model, np.zeros(model.n_identity), offset, (), no_frames.__getitem__)


def _named(person: FlameModel, points: SurfacePoints, used: np.ndarray) -> HeadMap:
    """The map of a model without identity components whose expressions are ARKit's shapes."""
    columns = [COLUMN[name] for name in person.expression_names]
    targets = np.zeros((COUNT, used.sum(), 3))
    expressions = np.zeros((FEATURES, person.n_expression))
    shapes = np.moveaxis(person.shapedirs, 2, 0)
    targets[columns] = [points.on(shape, person.faces) for shape in shapes]
    expressions[columns, range(person.n_expression)] = 1
    return HeadMap(points, used, targets, expressions, np.zeros((COUNT, 3)), _gaze())


class _Fit:
    """Least squares for one person at the N face points."""

    def __init__(self, person: FlameModel, points: SurfacePoints, used: np.ndarray) -> None:
        source = face_shapes()
        self.posed = PosedPoints(person, points)
        self.count = person.n_expression
        self.neutral = self.posed.positions(np.zeros(self.count), np.zeros(RIGID_SIZE))
        placed = similarity(source.points[used], self.neutral)
        self.targets = source.shapes[:, used] @ (placed.scale * placed.rotation).T
        self.ridge = RIDGE_M**2 * len(self.neutral)
        self.jaw = self._jaw()

    def rigid(self, jaw: np.ndarray) -> np.ndarray:
        """(18,) pose and translation with the jaw (3,) turned."""
        rigid = np.zeros(RIGID_SIZE)
        at = 3 * JOINTS.index("jaw")
        rigid[at : at + 3] = jaw
        return rigid

    def coefficients(self, jaw: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """(S, E) ridge solutions for points (S, N, 3) with the jaw (3,) turned."""
        start, slopes = self.posed.linearized(np.zeros(self.count), self.rigid(jaw))
        matrix = slopes[..., : self.count].reshape(-1, self.count)
        residual = (wanted - start).reshape(len(wanted), -1)
        normal = matrix.T @ matrix + self.ridge * np.eye(self.count)
        return np.linalg.solve(normal, matrix.T @ residual.T).T

    def expressions(self) -> np.ndarray:
        """(FEATURES, E) that best give single shapes and random combinations."""
        rows = []
        solutions = []
        for number, pose in enumerate(JAW_POSES):
            weights = _combinations(pose, np.random.default_rng(number))
            jaw = np.zeros(COUNT)
            jaw[[COLUMN[name] for name in JAW_SHAPES]] = pose
            wanted = self.neutral + np.tensordot(effective_weights(weights), self.targets, 1)
            rows.append(features(weights))
            solutions.append(self.coefficients(jaw @ self.jaw, wanted))
        return np.linalg.lstsq(np.concatenate(rows), np.concatenate(solutions), rcond=None)[0]

    def _jaw(self) -> np.ndarray:
        """(52, 3) axis-angle of the shapes that turn the jaw, fitted together with expressions."""
        found = np.zeros((COUNT, 3))
        at = self.count + 3 * JOINTS.index("jaw")
        columns = [*range(self.count), at, at + 1, at + 2]
        for name in JAW_SHAPES:
            wanted = self.neutral + self.targets[COLUMN[name]]
            values = np.zeros(len(columns))
            for _ in range(JAW_STEPS):
                expressions, jaw = np.split(values, [self.count])
                start, slopes = self.posed.linearized(expressions, self.rigid(jaw))
                matrix = slopes[..., columns].reshape(-1, len(columns))
                prior = np.diag([self.ridge] * self.count + [self.ridge * 1e-3] * 3)
                step = matrix.T @ (wanted - start).ravel() - prior @ values
                values = values + np.linalg.solve(matrix.T @ matrix + prior, step)
                values[self.count :] = np.clip(values[self.count :], -MAX_JAW_RAD, MAX_JAW_RAD)
            found[COLUMN[name]] = values[self.count :]
        return found


def _combinations(pose: tuple[float, float, float], rng: np.random.Generator) -> np.ndarray:
    """(S, 52) weights: each shape alone and random combinations, all with the jaw at `pose`."""
    weights = rng.random((COMBINATIONS, COUNT)) * (
        rng.random((COMBINATIONS, COUNT)) < ACTIVE_FRACTION
    )
    weights[::2, MOUTH_CLOSE] = rng.random(len(weights[::2]))
    weights[:, MOUTH_CLOSE] *= pose[0]
    alone = np.eye(COUNT)
    alone[MOUTH_CLOSE] *= pose[0]
    weights = np.concatenate([weights, alone, np.zeros((1, COUNT))])
    weights[:, [COLUMN[name] for name in OPTIONAL]] = 0
    weights[:, [COLUMN[name] for name in JAW_SHAPES]] = pose
    return weights


def _gaze() -> np.ndarray:
    """(52, 6) axis-angle of left and right eye; out and in are away from and towards the nose."""
    eyes = np.zeros((COUNT, 6))
    for side, first, outward in (("Left", 0, 1.0), ("Right", 3, -1.0)):
        eyes[COLUMN[f"eyeLookDown{side}"], first] = GAZE_RAD
        eyes[COLUMN[f"eyeLookUp{side}"], first] = -GAZE_RAD
        eyes[COLUMN[f"eyeLookOut{side}"], first + 1] = outward * GAZE_RAD
        eyes[COLUMN[f"eyeLookIn{side}"], first + 1] = -outward * GAZE_RAD
    return eyes


def page_controls(sequence: FlameSequence | None) -> ShapeControls | None:
    """The controls of a FLAME head; None for a head that ARKit's shapes do not fit."""
    if sequence is None:
        return None
    try:
        found = head_map(sequence, "the avatar")
    except StgaError:  # eyes that are not where a head has them
        return None
    products = np.zeros((COUNT, found.expressions.shape[1]))
    products[PRODUCTS] = found.expressions[COUNT:]
    linear = np.concatenate([found.expressions[:COUNT], found.jaw, found.eyes], axis=1)
    return ShapeControls(ARKIT_SHAPES, linear, products, "jawOpen", "mouthClose")
