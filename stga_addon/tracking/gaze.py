"""Gaze: the eyes' joints, turned so that the model's irises are where the images show them."""

from dataclasses import replace

import numpy as np

from ..flame.model import EYEBALL_WEIGHT
from .correspondence import EYE_JOINTS
from .fit import HeadFit, LandmarkVisibility, RecordedTake, observed_landmarks, triangulate
from .posed_points import PosedPoints
from .solve import (
    LANDMARK_SIGMA_M,
    Observation,
    acceleration_precision,
    normal_equations,
    parameter_precision,
    solve_in_time,
)

ITERATIONS = 4
"""Largest number of Gauss–Newton iterations for the gaze."""
IRIS_SIGMA_M = 0.0005
"""Standard deviation of the middle of an iris, which images show sharply."""
MAX_GAZE_RAD = 0.7
"""Up, down or to a side; no eye turns farther."""
CONSTANT_GAZE_SIGMA_RAD = 0.25
"""Standard deviation of where a person looks all through a take, from straight ahead."""
EYEBALL_SIGMA_RAD = np.array([0.06, 0.025])
"""Standard deviation of how far the model's two eyeballs turn alike, up and sideways, because they
are off: both lie too high together, but a face is symmetric, and sideways they are off against each
other."""
SINGLE_EYEBALL_SIGMA_RAD = np.array([0.06, 0.15])
"""The same for a single eye, whose errors cannot be compared with the other's."""
MIN_REMOVED_RAD = 0.1
"""Constant turn of an eye, not taken for gaze, from which on a warning names it."""
PARALLEL_QUANTILE = 0.8
"""Quantile, over a take, of the angle by which the left eye looks to the left of the right one, at
which both look in parallel: eyes converge on near things and never diverge."""
AXES = 2
"""About which an eye turns: x, by which it looks up and down, and y, sideways."""


def with_gaze(
    fit: HeadFit, take: RecordedTake, is_stranger: bool
) -> tuple[HeadFit, tuple[str, ...]]:
    """The fit with eyes turned so that the foremost points of the eyeballs are at the take's
    landmarks of the irises; unchanged without eyeballs, or without landmarks of irises. And
    warnings, one sentence each.

    Beside hundreds of landmarks of skin, two of irises hardly count: eyes would turn by less than
    half of what they do. is_stranger: the model's eyeballs may be some millimeters off, which turns
    each eye all the time: where they converge least, they are taken to look in parallel. What both
    do alike is kept as far as it is gaze rather than such an error (`_constant_gaze`); what is
    removed, a warning says. Landmarks of a known person are corrected (`without_measured_bias`).
    """
    model = fit.head.model
    on_eyeball = (model.weights[model.faces] > EYEBALL_WEIGHT).all(axis=1)[take.places.face]
    irises = {joint: np.flatnonzero(take.reliable & on_eyeball[:, joint]) for joint in EYE_JOINTS}
    eyes = {joint: rows for joint, rows in irises.items() if len(rows)}
    if not eyes:
        return fit, ()
    rows = np.concatenate(list(eyes.values()))
    first = model.n_expression
    columns = np.concatenate([first + 3 * joint + np.arange(AXES) for joint in eyes])
    timesteps = sorted(fit.parameters)
    start = np.stack([fit.parameters[timestep] for timestep in timesteps])
    observed = _observed(fit, take, timesteps, rows)
    points = PosedPoints(model, take.places[rows])
    precision = parameter_precision(fit.head)[columns]
    sharper = (LANDMARK_SIGMA_M / IRIS_SIGMA_M) ** 2

    def terms(row: int, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = start[row].copy()
        values[columns] = turns
        matrix, right = normal_equations(points, values, observed[row])
        pull = precision * (start[row, columns] - turns)
        sharpened = sharper * matrix[np.ix_(columns, columns)] + np.diag(precision)
        return sharpened, sharper * right[columns] + pull

    stiffness = acceleration_precision(model)[columns] if fit.ordered else None
    turns = solve_in_time(None, terms, start[:, columns], stiffness, ITERATIONS)
    warnings: tuple[str, ...] = ()
    if is_stranger:
        rest = _rest(turns)
        removed = rest - np.tile(_constant_gaze(rest), len(eyes))
        turns = turns - removed
        if np.abs(removed).max() >= MIN_REMOVED_RAD:
            warnings = (_removal(list(eyes), removed),)
    moved = start.copy()
    moved[:, columns] = np.clip(turns, -MAX_GAZE_RAD, MAX_GAZE_RAD)
    return replace(fit, parameters=dict(zip(timesteps, moved, strict=True))), warnings


def _rest(turns: np.ndarray) -> np.ndarray:
    """(2 E,) turns of one or two eyes, the left one first, at which they look straight ahead and in
    parallel, from all of a take (T, 2 E): their medians, as far apart as the eyes seldom are."""
    rest = np.median(turns, axis=0)
    if turns.shape[1] > AXES:
        left, right = (turns - rest)[:, 1::AXES].T
        rest[1::AXES] += np.quantile(left - right, PARALLEL_QUANTILE) / 2 * np.array([1, -1])
    return rest


def _constant_gaze(rest: np.ndarray) -> np.ndarray:
    """(2,) the gaze up and sideways that is most likely behind `rest` (2 E,) of one or two eyes."""
    eyes = rest.reshape(-1, AXES)
    sigma = EYEBALL_SIGMA_RAD if len(eyes) > 1 else SINGLE_EYEBALL_SIGMA_RAD
    is_gaze = CONSTANT_GAZE_SIGMA_RAD**2 / (CONSTANT_GAZE_SIGMA_RAD**2 + sigma**2)
    return np.asarray(is_gaze * eyes.mean(axis=0))


def _removal(joints: list[int], removed: np.ndarray) -> str:
    """The sentence about constant turns (2 E,) of the eyes at some joints."""
    names = ["left" if joint == EYE_JOINTS[0] else "right" for joint in joints]
    degrees = np.degrees(removed).reshape(-1, AXES)
    turns = [
        f"the {name} eye's by {up:+.0f}° down and {sideways:+.0f}° to its left"
        for name, (up, sideways) in zip(names, degrees, strict=True)
    ]
    return (
        "gaze: a turn that lasts all through the take is taken for the head model's error and "
        f"removed: {', '.join(turns)}"
    )


def _observed(
    fit: HeadFit, take: RecordedTake, timesteps: list[int], rows: np.ndarray
) -> list[Observation]:
    """Some of the landmarks at each timestep, all of them on the eyeballs."""
    visibility = LandmarkVisibility(fit.head, take.places[rows])
    found = []
    for timestep in timesteps:
        landmarks = take.landmarks[timestep]
        landmarks = replace(
            landmarks, points=landmarks.points[:, rows], confidence=landmarks.confidence[:, rows]
        )
        weighted = visibility.weighted(landmarks, fit.parameters[timestep], fit.to_capture)
        triangulation = triangulate(weighted.cameras, weighted.points, weighted.confidence)
        used = np.ones(len(rows), bool)
        found.append(observed_landmarks(triangulation, fit.to_capture, used))
    return found
