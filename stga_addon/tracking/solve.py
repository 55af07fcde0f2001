"""Least squares for identity, expression and pose from triangulated landmarks."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..flame.forward import POSE_SIZE, RIGID_SIZE, TRANSLATION_SIZE, by_change, unwound
from ..flame.model import JOINTS, FlameModel
from .head_model import HeadModel
from .posed_points import PosedPoints, SurfacePoints, head_rotation, split

LANDMARK_SIGMA_M = 0.002
"""Standard deviation of a landmark over people and views; coefficients have a standard deviation of
1."""
SCALE_SIGMA = 0.3
"""Relative standard deviation of the capture's scale, of which the average head gives the first
guess."""
SIZE_SIGMA = 0.02
"""Standard deviation of the size of a head that one camera sees, relative to the average head."""
JOINT_SIGMA_RAD = {
    "root": (3.0, 3.0, 3.0),
    "neck": (0.1, 0.1, 0.1),
    "jaw": (0.3, 0.05, 0.03),
    "left_eye": (0.3, 0.3, 0.01),
    "right_eye": (0.3, 0.3, 0.01),
}
"""Standard deviation of each joint's rotation vector. Landmarks of the face cannot distinguish the
neck's rotation from the head's: the root takes nearly all of it."""
WEIGHT_EXCESS_SIGMA = 0.1
"""Standard deviation of how far a coefficient that is a weight leaves the range from 0 to 1."""
LID_SHAPES = {"eyeBlink": 1.0, "eyeLookDown": 0.57}
"""Shape -> fraction by which it closes an eye at weight 1. The eye is closed where the sum of
fraction times weight is 1."""
TRANSLATION_SIGMA_M = 10.0
"""Standard deviation of the head's position."""
ABSENT_SIGMA = 1e-6
"""Standard deviation of a joint that the head lacks, in radians."""
EXPRESSION_ACCELERATION = 0.25
"""Standard deviation of an expression coefficient's second difference over timesteps."""
JOINT_ACCELERATION_RAD = 0.015
"""Standard deviation of a joint's second difference."""
TRANSLATION_ACCELERATION_M = 0.0015
"""Standard deviation of the position's second difference."""
LID_ACCELERATION = 1.0
"""Standard deviation of the second difference of LID_SHAPES: a blink closes the eyes within two or
three frames of a video."""
JUMP_SCALE = 3.0
"""Second difference, in standard deviations, above which it is a cut instead of motion."""
MAX_ORDERED_CHANGE = 0.7
"""Largest mean squared change of expression and jaw between neighboring timesteps, relative to that
between any two, for which timesteps follow each other in time."""
IDENTITY_ITERATIONS = 12
"""Iterations for the identity, together with the poses that it is solved from."""
TAKE_ITERATIONS = 8
"""Largest number of Gauss–Newton iterations for a take."""
ROUGH_TAKE_ITERATIONS = 2
"""Iterations for a take whose identity is not yet known; it is solved again from their result."""
CONVERGED_STEP = 1e-3
"""Largest change of a parameter (standard deviations, radians, meters) after which iterations
stop."""
MIN_DISTANCE_M = 1e-9
"""Distance between a landmark and the camera below which the landmark has no ray."""
MIN_DEPTH_RATIO = 0.2
"""Depth of a point on the head, relative to its landmark's, below which residuals no longer grow,
so that a head that a step moved behind the camera comes back."""
WINDOW = 192
"""Timesteps that are solved at once, so that memory does not grow with the take."""
OVERLAP = 24
"""Timesteps that two neighboring windows have in common."""


Terms = Callable[[int, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Timestep's number and parameters (P,) -> its Gauss–Newton matrix and right-hand side."""


@dataclass(frozen=True)
class Observation:
    """Landmarks of one timestep in meters.

    position  (N, 3)
    root      (N, 3, 3) square root of the information
    weight    (N,)
    eye       (3,) of the only camera, None of several: residuals are then measured in its image,
              at the depth of `position`, because a head that shrinks into the camera would
              otherwise miss every ray by less
    """

    position: np.ndarray
    root: np.ndarray
    weight: np.ndarray
    eye: np.ndarray | None = None


@dataclass(frozen=True)
class Identity:
    """Result of `solve_identity`: coefficients (I,), relative scale, and (T, E + 18) parameters of
    its timesteps."""

    shape: np.ndarray
    scale: float
    frames: np.ndarray


def solve_identity(
    head: HeadModel,
    places: SurfacePoints,
    observations: Sequence[Observation],
    start: np.ndarray,
    metric: bool = False,
    shape: np.ndarray | None = None,
) -> Identity:
    """Identity common to some timesteps, with their expressions and poses, which begin at `start`:
    poses (T, 18), or with expressions (T, E + 18). The identity begins at `shape` (I,), else at 0.

    The scale of the world is solved as a component: a head `scale` times as large as the model's
    fits best. Where the world is `metric`, it is 1, and the size of the head is the person's, which
    a single camera does not see: the head's is then that of the average one.
    """
    model = head.model
    known = model.n_identity
    expressions = model.n_expression
    columns = np.split(model.shapedirs, [known], axis=2)
    scale_sigma = 0.0 if metric else SCALE_SIGMA
    sized = np.concatenate(
        [columns[0], scale_sigma * model.v_template[..., None], columns[1]], axis=2
    )
    points = PosedPoints(replace(model, shapedirs=sized), places)
    shared = known + 1
    own = expressions + RIGID_SIZE
    frames = np.pad(start, ((0, 0), (own - start.shape[1], 0)))
    begun = np.zeros(known) if shape is None else shape
    common = np.append(begun, 0.0)
    size = np.zeros(shared)
    if observations[0].eye is not None:
        size[:known] = _size_by_identity(head, places) / SIZE_SIGMA
    for _ in range(IDENTITY_ITERATIONS):
        precision, pull = prior_terms(head, frames)
        matrix = np.eye(shared) + np.outer(size, size)
        right = -matrix @ common
        solved = []
        for values, diagonal, pulled, observation in zip(
            frames, precision, pull, observations, strict=True
        ):
            every = np.concatenate([common, values])
            block, gradient = normal_equations(points, every, observation)
            inner = block[shared:, shared:] + np.diag(diagonal)
            outer = np.column_stack([block[shared:, :shared], gradient[shared:] + pulled])
            inside = np.linalg.solve(inner, outer)
            solved.append(inside)
            # Schur complement: timesteps share nothing but the identity
            eliminated = block[:shared, shared:] @ inside
            matrix += block[:shared, :shared] - eliminated[:, :-1]
            right += gradient[:shared] - eliminated[:, -1]
        step = np.linalg.solve(matrix, right)
        moves: np.ndarray = np.stack([inside[:, -1] - inside[:, :-1] @ step for inside in solved])
        common = common + step
        frames = frames + moves
        if max(np.abs(step).max(), np.abs(moves).max()) < CONVERGED_STEP:
            break
    scale = 1 + scale_sigma * common[known]
    frames[:, :expressions] /= scale
    frames[:, -TRANSLATION_SIZE:] /= scale
    return Identity(common[:known] / scale, float(scale), frames)


def _size_by_identity(head: HeadModel, places: SurfacePoints) -> np.ndarray:
    """(I,) relative change of the landmarks' extent by identity coefficients."""
    model = head.model
    corners = model.faces[places.face]
    at = places.on(model.v_template, model.faces)
    moved = np.einsum(
        "nb,nbci->nci", places.barycentric, model.shapedirs[corners][..., : model.n_identity]
    )
    out = at - at.mean(0)
    return np.einsum("nc,nci->i", out, moved) / (out**2).sum()


def solve_take(
    head: HeadModel,
    places: SurfacePoints,
    observations: Sequence[Observation],
    start: np.ndarray,
    ordered: bool,
    iterations: int = TAKE_ITERATIONS,
) -> np.ndarray:
    """Expression and pose (T, E + 18) of consecutive timesteps of a person whose identity is in the
    template, after so many Gauss–Newton iterations at most.

    start (T, E + 18). ordered: second differences over time are penalized, but for jumps, such as
    cuts; else every timestep is solved for itself. Memory does not grow with the take beyond its
    observations.
    """
    points = PosedPoints(head.model, places)

    def terms(row: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return normal_equations(points, values, observations[row])

    stiffness = acceleration_precision(head.model) if ordered else None
    return solve_in_time(head, terms, unwound(start) if ordered else start, stiffness, iterations)


def in_order(
    head: HeadModel, places: SurfacePoints, observations: Sequence[Observation], alone: np.ndarray
) -> bool:
    """Whether a take's timesteps follow each other in time: captures of one expression per timestep
    do not.

    alone (T, E + 18): each timestep solved for itself. By von Neumann's ratio (1941) over
    expression and jaw, in standard deviations of the prior, without the variance that the noise of
    landmarks has in them.
    """
    if len(alone) < 3:
        return True
    points = PosedPoints(head.model, places)
    prior = parameter_precision(head)
    missed = []
    variances = []
    for values, own in zip(alone, observations, strict=True):
        away = points.positions(*split(values)) - own.position
        missed.append(np.einsum("nij,nj->ni", own.root, away) @ head_rotation(values))
        information, _ = normal_equations(points, values, own)
        covariance = np.linalg.inv(information + np.diag(prior))
        variances.append(np.diag(covariance @ information @ covariance))
    # landmarks move about their mean places
    weight = np.mean([observation.weight for observation in observations], axis=0)
    spread = (weight[:, None] * np.var(missed, axis=0)).sum() / max(3 * weight.sum(), 1e-9)
    noises = spread / LANDMARK_SIGMA_M**2 * np.mean(variances, axis=0)
    jaw = head.model.n_expression + 3 * JOINTS.index("jaw")
    moving = np.r_[: head.model.n_expression, jaw : jaw + 3]
    noise = float((noises * prior)[moving].sum())
    expressions = (alone * np.sqrt(prior))[:, moving]
    variance = expressions.var(axis=0, ddof=1).sum() - noise
    change = ((expressions[1:] - expressions[:-1]) ** 2).sum(1).mean() - 2 * noise
    return bool(change <= MAX_ORDERED_CHANGE * 2 * variance)


def smoothed(
    start: np.ndarray,
    information: np.ndarray,
    stiffness: np.ndarray | None,
    right: np.ndarray | float = 0.0,
    head: HeadModel | None = None,
) -> np.ndarray:
    """Parameters (T, P) of consecutive timesteps from the Gauss–Newton matrices (T, P, P) and
    right-hand sides (T, P) that they have at `start`: where these are 0, their inverse covariances.

    stiffness (P,): inverse variances of second differences over time, which are penalized but for
    jumps, such as cuts; None: they are not. head: whose prior parameters (T, E + 18) have.
    """
    pull = np.broadcast_to(right, start.shape)
    rows = np.arange(len(start))
    values = start if stiffness is None else unwound(start)
    moved = rows[(values != start).any(axis=1)]
    if len(moved):  # terms by parameters of the same rotations, to which derivatives are others
        information = information.copy()
        pull = pull.copy()
    for row in moved:
        derivative = by_change(start[row]) @ np.linalg.inv(by_change(values[row]))
        information[row] = derivative.T @ information[row] @ derivative
        pull[row] = derivative.T @ pull[row]

    def linear(row: int, now: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return information[row], pull[row] - information[row] @ (now - values[row])

    return solve_in_time(head, linear, values, stiffness)


def person(head: HeadModel, shape: np.ndarray) -> HeadModel:
    """The head model with identity coefficients (I,) in its template, and expression components
    alone."""
    model = head.model
    template = model.v_template + model.shapedirs[:, :, : model.n_identity] @ shape
    shapes = np.ascontiguousarray(model.shapedirs[:, :, model.n_identity :])
    return replace(head, model=replace(model, v_template=template, shapedirs=shapes, n_identity=0))


def normal_equations(
    points: PosedPoints, parameters: np.ndarray, observation: Observation
) -> tuple[np.ndarray, np.ndarray]:
    """Jᵀ W J and −Jᵀ W r of one timestep by its parameters (K + 18,), with soft-L1 weights."""
    residual, jacobian = residuals(points, parameters, observation)
    weight = observation.weight / np.sqrt(1 + (residual**2).sum(1))
    flat = (np.sqrt(weight)[:, None, None] * jacobian).reshape(-1, jacobian.shape[2])
    return flat.T @ flat, -flat.T @ (np.sqrt(weight)[:, None] * residual).ravel()


def residuals(
    points: PosedPoints, parameters: np.ndarray, observation: Observation
) -> tuple[np.ndarray, np.ndarray]:
    """Differences of landmarks at parameters (K + 18,), in LANDMARK_SIGMA_M: (N, 3), and their
    derivatives (N, 3, K + 18)."""
    positions, jacobian = points.linearized(*split(parameters))
    away = positions - observation.position
    residual = np.einsum("nij,nj->ni", observation.root, away) / LANDMARK_SIGMA_M
    derivative = (observation.root @ jacobian) / LANDMARK_SIGMA_M
    if observation.eye is None:
        return residual, derivative
    along = observation.position - observation.eye
    distance = np.maximum(np.linalg.norm(along, axis=1), MIN_DISTANCE_M)
    direction = along / distance[:, None]
    depth = ((positions - observation.eye) * direction).sum(1)
    depth = np.maximum(depth, MIN_DEPTH_RATIO * distance)
    enlarged = distance / depth
    nearer = np.einsum("ni,nip->np", direction, jacobian) / depth[:, None]
    derivative -= residual[:, :, None] * nearer[:, None, :]
    return enlarged[:, None] * residual, enlarged[:, None, None] * derivative


def solve_in_time(
    head: HeadModel | None,
    terms: Terms,
    start: np.ndarray,
    stiffness: np.ndarray | None,
    iterations: int = TAKE_ITERATIONS,
) -> np.ndarray:
    """Parameters (T, P). head: whose prior they have; stiffness (P,): of second differences."""
    solved = start.copy()
    size = start.shape[1]
    for first in range(0, len(start), WINDOW - OVERLAP):
        last = min(first + WINDOW, len(start))
        state = solved[first:last].copy()
        blocks = np.zeros((len(state), size, size))
        right = np.zeros_like(state)
        for _ in range(iterations):
            for number, values in enumerate(state):
                blocks[number], right[number] = terms(first + number, values)
            if head is not None:
                precision, pull = prior_terms(head, state)
                blocks[:, np.arange(size), np.arange(size)] += precision
                right += pull
            if stiffness is not None and len(state) > 2:
                step = _smooth_step(blocks, right, state, stiffness)
            else:
                step = np.linalg.solve(blocks, right[..., None])[..., 0]
            state = state + step
            if np.abs(step).max() < CONVERGED_STEP:
                break
        kept = 0 if first == 0 else OVERLAP // 2
        solved[first + kept : last] = state[kept:]
        if last == len(start):
            break
    return solved


def _smooth_step(
    blocks: np.ndarray, right: np.ndarray, state: np.ndarray, stiffness: np.ndarray
) -> np.ndarray:
    """(T, P) Gauss–Newton step of all timesteps together, with the penalty of second differences
    by Geman-McClure weights."""
    from scipy.linalg import solveh_banded

    count, size = state.shape
    band = np.zeros((2 * size + 1, count * size))
    for number, block in enumerate(blocks):
        for offset in range(size):
            band[offset, number * size : (number + 1) * size - offset] = np.diagonal(block, offset)
    second = state[:-2] - 2 * state[1:-1] + state[2:]
    jump = second**2 * stiffness / JUMP_SCALE**2
    # a cut changes all parameters
    weight = stiffness / ((1 + jump) * (1 + jump.mean(axis=1, keepdims=True))) ** 2
    for number, (difference, fraction) in enumerate(zip(second, weight, strict=True)):
        for row, first in enumerate((1.0, -2.0, 1.0)):
            right[number + row] -= fraction * first * difference
            for column, other in enumerate((1.0, -2.0, 1.0)[: row + 1]):
                at = (number + column) * size
                band[(row - column) * size, at : at + size] += fraction * first * other
    return solveh_banded(band, right.ravel(), lower=True).reshape(count, size)


def parameter_precision(head: HeadModel) -> np.ndarray:
    """(E + 18,) inverse variances of a timestep's parameters around zero."""
    joints = [
        JOINT_SIGMA_RAD[name] if present else (ABSENT_SIGMA,) * 3
        for name, present in zip(JOINTS, head.joints, strict=True)
    ]
    rigid = np.concatenate([*joints, (TRANSLATION_SIGMA_M,) * TRANSLATION_SIZE])
    return np.concatenate([np.ones(head.model.n_expression), rigid**-2.0])


def prior_terms(head: HeadModel, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The prior's diagonal Gauss–Newton matrix and right-hand side at parameters (..., E + 18), of
    the same shape.

    `parameter_precision`, and where expressions are weights from 0 to 1 a pull back into that
    range, also of what LID_SHAPES add up to, whose matrix is replaced by a diagonal one that is
    never smaller.
    """
    precision = np.broadcast_to(parameter_precision(head), values.shape).copy()
    right = -precision * values
    if head.model.expression_names:
        weights = values[..., :-RIGID_SIZE]
        excess = weights - np.clip(weights, 0, 1)
        precision[..., :-RIGID_SIZE] += (excess != 0) / WEIGHT_EXCESS_SIGMA**2
        right[..., :-RIGID_SIZE] -= excess / WEIGHT_EXCESS_SIGMA**2
        for side in ("Left", "Right"):
            columns, fractions = lid_fractions(head.model, side)
            beyond = np.maximum((weights[..., columns] * fractions).sum(-1, keepdims=True) - 1, 0)
            precision[..., columns] += (
                (beyond > 0) * fractions * fractions.sum() / WEIGHT_EXCESS_SIGMA**2
            )
            right[..., columns] -= beyond * fractions / WEIGHT_EXCESS_SIGMA**2
    return precision, right


def lid_fractions(model: FlameModel, side: str) -> tuple[list[int], np.ndarray]:
    """Columns (N,) of the expressions that close the eye on a side, "Left" or "Right", and their
    fractions (N,)."""
    names = model.expression_names
    known = [name for name in LID_SHAPES if name + side in names]
    columns = [names.index(name + side) for name in known]
    return columns, np.array([LID_SHAPES[name] for name in known])


def acceleration_precision(model: FlameModel) -> np.ndarray:
    """(E + 18,) inverse variances of second differences over time."""
    sigma = np.repeat(
        (EXPRESSION_ACCELERATION, JOINT_ACCELERATION_RAD, TRANSLATION_ACCELERATION_M),
        (model.n_expression, POSE_SIZE, TRANSLATION_SIZE),
    )
    for column, name in enumerate(model.expression_names):
        if name.removesuffix("Left").removesuffix("Right") in LID_SHAPES:
            sigma[column] = LID_ACCELERATION
    return sigma**-2.0
