"""The other way: FLAME parameters as ARKit weights, and the CSV file that holds them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..files import replacing
from ..flame.forward import RIGID_SIZE, FlameFrame
from ..flame.quaternions import from_axis_angle, to_matrices
from ..flame.sequence import FlameSequence, with_identity
from ..tracking.posed_points import PosedPoints
from .head_map import JAW_SHAPES, PRODUCTS, HeadMap, head_map
from .performance import ARKIT_SHAPES, COLUMN, COUNT, OPTIONAL, Performance
from .shapes import JAW_OPEN, MOUTH_CLOSE

MAX_SWEEPS = 60
"""Sweeps of the descent over all weights, at most."""
CONVERGED = 1e-5
"""Largest change of a weight in a sweep, below which the descent stops."""
NEWTON_STEPS = 12
"""Projected Newton steps that follow the descent."""
STEP_FRACTIONS = (1.0, 0.5, 0.2, 0.05, 0.0)
"""Fractions of a Newton step, of which the best is taken."""
CHUNK = 256
"""Rows whose matrices are held at once."""

RIDGE = 1e-9
"""Fraction of the mean squared displacement, for weights that a head cannot distinguish."""
TIMECODE_BASE = 60
TURNS = "Yaw", "Pitch", "Roll"
EXTRA_COLUMNS = [f"{part}{turn}" for part in ("Head", "LeftEye", "RightEye") for turn in TURNS]


def captured_performance(sequence: FlameSequence, name: str, fps: float) -> Performance:
    """The motion of a FLAME head as ARKit weights: the least-squares fit of 0 to 1 to what its face
    does.

    The neck's rotation becomes the head's; other head motion has no place in a performance. `name`
    is what errors call the head.
    """
    frames = sequence.frames()
    weights = arkit_weights(frames, head_map(sequence, name), sequence)
    first = sequence.timesteps[0]
    times = (np.array(sequence.timesteps) - first) / fps
    head = head_angles(np.stack([frame.neck_pose for frame in frames]))
    return Performance(times, weights, head, fps)


def arkit_weights(
    frames: Sequence[FlameFrame], found: HeadMap, sequence: FlameSequence
) -> np.ndarray:
    """(T, 52) weights of 0 to 1 whose parameters (`HeadMap.parameters`) move the face most like the
    frames.

    Expressions with ARKit's names are the weights. Else the jaw's and the gaze's shapes follow from
    the rotations; what they do to the skin is taken off, and the others follow from the expression
    coefficients by coordinate descent on the non-negative least squares.
    """
    weights = np.zeros((len(frames), COUNT))
    if names := sequence.model.expression_names:
        columns = [COLUMN[name] for name in names]
        weights[:, columns] = np.clip([frame.expr for frame in frames], 0, 1)
        return weights
    jaw_columns = [COLUMN[name] for name in JAW_SHAPES]
    jaw = np.stack([frame.jaw_pose for frame in frames])
    rows = found.jaw[jaw_columns]
    weights[:, jaw_columns] = _descended((rows @ rows.T)[None], jaw @ rows.T)
    looks = [column for column, name in enumerate(ARKIT_SHAPES) if name.startswith("eyeLook")]
    eyes = np.stack([frame.eyes_pose for frame in frames])
    weights[:, looks] = np.clip(eyes @ np.linalg.pinv(found.eyes[looks]) * 2, 0, 1)
    fixed = {*jaw_columns, *looks, *(COLUMN[name] for name in OPTIONAL)}
    free = np.array([column for column in range(COUNT) if column not in fixed])
    opened = weights[:, JAW_OPEN]
    linear = found.expressions[:COUNT]
    by_jaw = np.zeros((COUNT, found.expressions.shape[1]))
    by_jaw[PRODUCTS] = found.expressions[COUNT:]
    known = weights @ linear + opened[:, None] * (weights @ by_jaw)
    wanted = np.stack([frame.expr for frame in frames]) - known
    # The length of coefficients times the metric is how far they move the face's points.
    person = with_identity(sequence).model
    count = person.n_expression
    posed = PosedPoints(person, found.points)
    _, slopes = posed.linearized(np.zeros(count), np.zeros(RIGID_SIZE))
    moves = slopes[..., :count].reshape(-1, count)
    values, vectors = np.linalg.eigh(moves.T @ moves)
    metric = vectors * np.sqrt(np.maximum(values, 0))
    first = linear[free] @ metric
    second = by_jaw[free] @ metric
    wanted = wanted @ metric
    cross = first @ second.T
    gram = np.stack([first @ first.T, cross + cross.T, second @ second.T])
    right = wanted @ first.T + opened[:, None] * (wanted @ second.T)
    limits = np.ones((len(frames), len(free)))
    limits[:, free == MOUTH_CLOSE] = opened[:, None]
    powers = np.stack([np.ones_like(opened), opened, opened**2], axis=1)
    weights[:, free] = _descended(gram, right, powers, limits)
    return weights


def _descended(
    gram: np.ndarray,
    right: np.ndarray,
    powers: np.ndarray | None = None,
    limits: np.ndarray | float = 1.0,
) -> np.ndarray:
    """(T, K) minimizers in 0…`limits` of ½ wᵀGw − rᵀw, G = Σ powers[:, p] gram[p], row by row."""
    powers = np.ones((len(right), 1)) if powers is None else powers
    limits = np.broadcast_to(limits, right.shape)
    weights = np.zeros_like(right)
    ridge = RIDGE * float(np.trace(gram[0])) / max(len(gram[0]), 1)
    rows = [powers @ gram[:, column] for column in range(right.shape[1])]
    for _ in range(MAX_SWEEPS):
        largest = 0.0
        for column, row in enumerate(rows):
            curvature = row[:, column] + ridge
            slope = right[:, column] - (row * weights).sum(axis=1) - ridge * weights[:, column]
            old = weights[:, column].copy()
            moved = old + slope / np.maximum(curvature, 1e-30)
            weights[:, column] = np.clip(moved, 0, limits[:, column])
            largest = max(largest, float(np.abs(weights[:, column] - old).max(initial=0)))
        if largest < CONVERGED:
            break
    for first in range(0, len(weights), CHUNK):
        part = slice(first, first + CHUNK)
        matrices = np.einsum("tp,pjk->tjk", powers[part], gram) + ridge * np.eye(len(rows))
        weights[part] = _polished(matrices, right[part], weights[part], limits[part])
    return weights


def _polished(
    matrices: np.ndarray, right: np.ndarray, weights: np.ndarray, limits: np.ndarray
) -> np.ndarray:
    """The minimizers near weights (T, K), by projected Newton steps (Bertsekas 1982)."""

    def value(w: np.ndarray) -> np.ndarray:
        return (w * (0.5 * np.einsum("tjk,tk->tj", matrices, w) - right)).sum(axis=1)

    for _ in range(NEWTON_STEPS):
        slope = right - np.einsum("tjk,tk->tj", matrices, weights)
        held = ((weights <= 0) & (slope < 0)) | ((weights >= limits) & (slope > 0))
        free = ~held
        reduced = matrices * (free[:, :, None] & free[:, None, :])
        reduced[:, np.arange(right.shape[1]), np.arange(right.shape[1])] += held
        step = np.linalg.solve(reduced, np.where(held, 0.0, slope)[..., None])[..., 0]
        tried = np.stack(
            [np.clip(weights + fraction * step, 0, limits) for fraction in STEP_FRACTIONS]
        )
        best = np.stack([value(each) for each in tried]).argmin(axis=0)
        weights = tried[best, np.arange(len(weights))]
    return weights


def head_angles(turns: np.ndarray) -> np.ndarray:
    """(T, 3) yaw, pitch and roll of axis-angle (T, 3); the inverse of `head_map.head_turns`."""
    matrices = to_matrices(from_axis_angle(turns))
    yaw = np.arctan2(matrices[:, 0, 2], matrices[:, 2, 2])
    pitch = np.arcsin(np.clip(-matrices[:, 1, 2], -1, 1))
    return np.stack([yaw, pitch, np.arctan2(matrices[:, 1, 0], matrices[:, 1, 1])], axis=1)


def write_performance(path: Path, performance: Performance) -> None:
    """Write a performance as a CSV file in Live Link Face's layout, atomically."""
    names = [name[0].upper() + name[1:] for name in ARKIT_SHAPES]
    header = ["Timecode", "BlendShapeCount", *names, *EXTRA_COLUMNS]
    lines = [",".join(header)]
    eyes = np.zeros((len(performance.times), len(EXTRA_COLUMNS) - 3))
    rows = np.hstack([performance.weights, performance.head, eyes]).tolist()
    for time, cells in zip(performance.times.tolist(), rows, strict=True):
        count, sub = divmod(round(time * TIMECODE_BASE * 1000), 1000)
        whole, frame = divmod(count, TIMECODE_BASE)
        code = f"{whole // 3600:02d}:{whole // 60 % 60:02d}:{whole % 60:02d}:{frame:02d}.{sub:03d}"
        lines.append(",".join([code, str(len(cells)), *(f"{cell:.6f}" for cell in cells)]))
    with replacing(path) as partial:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")
