"""Correction of a tracked take by heads that were posed by hand at some timesteps."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.model import Capture
from ..capture.open import open_capture
from ..errors import StgaError, shorten
from ..files import read_json, read_npz, write_json, write_npz
from ..flame.forward import RIGID_SIZE, by_change, change_between, changed_by
from ..flame.model import FlameModel
from ..flame.sequence import MAX_PARAMETER, FlameSequence, with_identity
from .folder import LANDMARKS_FOLDER, PLACES_FILE, REPORT_FILE, SHEET_FILE, rounded
from .footage.model import Footage
from .footage.open import open_footage
from .landmarks import CameraLandmarks, check_count, read_landmarks, read_places
from .pictures import PosedHead, write_contact_sheet
from .posed_points import PosedPoints, SurfacePoints
from .solve import LANDMARK_SIGMA_M, acceleration_precision
from .stages import ReportStage, Stage, unreported
from .write_capture import replace_head

SOLVED_FILE = "tracking_solved.npz"
"""File in a corrected capture with the parameters as they were solved without keys."""
DEFAULT_SPAN = 12  # Timesteps before and after a key that it may change


def correct_capture(
    out: Path,
    model: Path,
    keys: Mapping[int, np.ndarray],
    span: int = DEFAULT_SPAN,
    report: ReportStage = unreported,
) -> None:
    """Solve a tracked FLAME capture again around timesteps whose parameters (E + 18,) are given:
    `keys`.

    Always from what was tracked: a key that is no longer given leaves no trace. The timesteps'
    parameter files, the report's errors and the contact sheet are replaced. Raises StgaError where
    `out` was not tracked here, or a file that the correction starts from is damaged; nothing is
    written then.
    """
    capture = open_capture(out, model)
    tracked = capture.flame_motion()
    timesteps, solved = _solved(out, tracked)
    unknown = sorted(set(keys) - set(timesteps))
    if unknown:
        raise StgaError(f"{out}: has no timestep {unknown[0]}, which a key is of")
    size = solved.shape[1]
    for timestep, values in keys.items():
        if not _are_parameters(values, (size,)):
            raise StgaError(f"key at timestep {timestep}: expected {(size,)} finite numbers")
    rows = {timesteps.index(t): values.astype(np.float64) for t, values in keys.items()}
    trust = _trust(out / REPORT_FILE, read_json(out / REPORT_FILE), timesteps)
    places, used, _, _ = _landmarks(out, capture)
    report(Stage.CORRECTION, 0, 1)
    person = with_identity(tracked).model
    heads = corrected(person, places[used], solved, trust, rows, span)
    write_npz(out / SOLVED_FILE, {"timesteps": np.array(timesteps), "parameters": solved})
    for number, (timestep, values) in enumerate(zip(timesteps, heads, strict=True)):
        replace_head(out, timestep, values)
        report(Stage.HEADS, number + 1, len(timesteps))
    report(Stage.CONTACT_SHEET, 0, 1)
    report_errors(out, model)


def corrected(
    model: FlameModel,
    points: SurfacePoints,
    solved: np.ndarray,
    trust: np.ndarray,
    keys: Mapping[int, np.ndarray],
    span: int,
) -> np.ndarray:
    """Parameters (T, E + 18) that pass through the keys (row -> (E + 18,)) and return to `solved`
    within `span` rows.

    model: of the person, with expressions alone; trust (T,) from 0 to 1: in the rows as they were
    solved. The change is smooth, and moves the surface points of rows that are trusted as little as
    possible; less and less so towards a key, whose neighbors are likely to be wrong in the same
    way.
    """
    from scipy.sparse import block_diag, csc_matrix, diags, kron
    from scipy.sparse.linalg import spsolve

    count, size = solved.shape
    change = np.zeros_like(solved)
    if not keys:
        return solved.copy()
    distance = np.abs(np.arange(count)[:, None] - np.array(sorted(keys))).min(axis=1)
    free = (distance > 0) & (distance <= span)
    for row, values in keys.items():
        change[row] = change_between(solved[row], values)
    near = np.flatnonzero(distance <= span + 2)
    fractions = trust[near] * (distance[near] / (span + 1)) ** 2
    # The prior of a change: standard deviations of 1 for coefficients, 1 radian for joints, 1 meter
    # for translation.
    blocks = []
    posed = PosedPoints(model, points)
    for row, fraction in zip(near, fractions, strict=True):
        _, jacobian = posed.linearized(solved[row, :-RIGID_SIZE], solved[row, -RIGID_SIZE:])
        flat = jacobian.reshape(-1, size) @ by_change(solved[row]) / LANDMARK_SIGMA_M
        blocks.append(fraction * (flat.T @ flat) + np.eye(size))
    matrix = block_diag(blocks)
    # second differences of three rows that follow each other
    middle = 1 + np.flatnonzero((np.diff(near)[:-1] == 1) & (np.diff(near)[1:] == 1))
    at = np.tile(np.arange(len(middle)), 3), np.concatenate([middle - 1, middle, middle + 1])
    values = np.repeat([1.0, -2.0, 1.0], len(middle))
    second = csc_matrix((values, at), shape=(len(middle), len(near)))
    matrix = matrix + kron(second.T @ second, diags(acceleration_precision(model)))
    matrix = csc_matrix(matrix)
    open_ = np.repeat(free[near], size)
    if open_.any():
        right = -matrix[open_][:, ~open_] @ change[near].ravel()[~open_]
        flat = change[near].ravel()
        flat[open_] = spsolve(matrix[open_][:, open_], right)
        change[near] = flat.reshape(-1, size)
    return changed_by(solved, change)


def _solved(out: Path, sequence: FlameSequence) -> tuple[list[int], np.ndarray]:
    """Timesteps and parameters (T, E + 18) as they were tracked: those of the file that the first
    correction writes, or of the capture where there is none. Raises StgaError where the file is not
    of the capture's timesteps."""
    path = out / SOLVED_FILE
    timesteps = list(sequence.timesteps)
    if not os.path.lexists(path):
        return timesteps, np.stack([sequence.frame(timestep).parameters for timestep in timesteps])
    arrays = read_npz(path)
    shape = len(timesteps), sequence.model.n_expression + RIGID_SIZE
    if not _are_parameters(arrays.get("parameters"), shape):
        raise StgaError(f"{path}: parameters: expected {shape} finite numbers")
    if arrays.get("timesteps", np.zeros(0)).tolist() != timesteps:
        raise StgaError(f"{path}: timesteps: expected those of the capture")
    return timesteps, arrays["parameters"].astype(np.float64)


def _are_parameters(values: np.ndarray | None, shape: tuple[int, ...]) -> bool:
    """Whether these are parameters that FLAME can be posed with."""
    if values is None or values.shape != shape or values.dtype.kind not in "fiu":
        return False
    return bool((np.abs(values.astype(np.float64)) <= MAX_PARAMETER).all())  # not where one is NaN


def _misfit(report: Mapping[str, Any]) -> dict[str, dict[int, float]]:
    """Region -> timestep -> fraction of the images that is not explained, from the report, if it
    has one."""
    return {
        name: {int(t): float(value) for t, value in fractions.items()}
        for name, fractions in report.get("image_misfit", {}).items()
    }


def _trust(path: Path, report: Any, timesteps: Sequence[int]) -> np.ndarray:
    """(T,) from 0 to 1: fraction of the images that is explained in the timesteps' worst regions, 1
    where it is not known; 0 without landmarks. Raises StgaError where the report has neither."""
    without = report.get("interpolated") if isinstance(report, dict) else None
    if not isinstance(without, list) or not all(type(timestep) is int for timestep in without):
        raise StgaError(f"{path}: interpolated: expected timesteps, got {shorten(without)}")
    try:
        misfit = _misfit(report)
        worst = [
            max((fractions.get(t, 0.0) for fractions in misfit.values()), default=0.0)
            for t in timesteps
        ]
        if not np.isfinite(worst).all():
            raise ValueError
    except (ValueError, TypeError, AttributeError) as error:
        raise StgaError(
            f"{path}: image_misfit: expected fractions by region and timestep"
        ) from error
    return np.where(np.isin(timesteps, list(set(without))), 0.0, 1 - np.clip(worst, 0.0, 1.0))


def report_errors(out: Path, model: Path | None) -> float:
    """Measure the reprojection errors of a tracked capture whose parameters were replaced, and draw
    its contact sheet. Returns the median, in pixels. Raises StgaError for damaged landmarks."""
    capture = open_capture(out, model)
    places, used, footage, found = _landmarks(out, capture)
    errors: dict[str, dict[int, float]] = {camera.name: {} for camera in footage.cameras}
    cameras = {camera.name: camera.camera for camera in footage.cameras}
    for name, landmarks in found.items():
        rows = zip(
            landmarks.timesteps.tolist(), landmarks.points, landmarks.confidence, strict=True
        )
        for timestep, pixels, confidence in rows:
            use = used & (confidence > 0)
            if use.any():
                head = places.on(capture.mesh(timestep), capture.faces)
                distance = np.linalg.norm(cameras[name].project(head[use])[0] - pixels[use], axis=1)
                errors[name][timestep] = float(np.median(distance))
    median = float(np.median([px for error in errors.values() for px in error.values()]))
    report = read_json(out / REPORT_FILE)
    report["median_reprojection_px"] = round(median, 3)
    report["reprojection_px"] = rounded(errors)
    write_json(out / REPORT_FILE, report)
    misfit = _misfit(report)
    posed = PosedHead(cameras, capture.mesh, capture.faces)
    write_contact_sheet(out / SHEET_FILE, footage, posed, errors, misfit)
    return median


def _landmarks(
    out: Path, capture: Capture
) -> tuple[SurfacePoints, np.ndarray, Footage, dict[str, CameraLandmarks]]:
    """A tracked capture's places of landmarks, which of them are reliable, its cameras by name, and
    what was detected. Raises StgaError where there is no face."""
    places, used = read_places(out / LANDMARKS_FOLDER / PLACES_FILE, len(capture.faces))
    footage = open_footage(out)
    by_name = tuple(sorted(footage.cameras, key=lambda camera: camera.name))
    footage = replace(footage, cameras=by_name)
    found = read_landmarks(footage, out / LANDMARKS_FOLDER)
    check_count(found, places)
    if not any(each.confidence.any() and each.confidence[:, used].any() for each in found.values()):
        raise StgaError(f"{out / LANDMARKS_FOLDER}: has no landmarks of a face")
    return places, used, footage, found
