"""From a head fitted to landmarks to one fitted to the skin that the cameras see, with smooth
personal offsets."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..capture.mesh_geometry import triangle_normals, vertex_normals
from ..capture.model import evenly_spread, parts_of
from ..flame.forward import RIGID_SIZE
from ..flame.model import faces_within
from ..worker.helpers import Step
from . import fit as head_fit
from .fit import HeadFit, RecordedTake, posed_mesh
from .head_model import HeadModel
from .observed_surface import (
    ObservedSurface,
    SurfaceSearch,
    Sweep,
    VisiblePoints,
    near_landmarks,
    observed_surface,
    outlines_agree,
    surface_points,
)
from .posed_points import PosedPoints, SurfacePoints, head_rotation, split
from .solve import LANDMARK_SIGMA_M, Observation, person, solve_identity, solve_take
from .stages import Stage, Workers

IDENTITY_SWEEPS = (
    Sweep(0.010, 0.001, 0.0015),
    Sweep(0.004, 0.0005, 0.001),
    Sweep(0.003, 0.0005, 0.001),
)
"""Sweeps in which identity is solved from the surface."""
OUTLINE_SWEEPS = Sweep(0.003, 0.0005, 0.001), Sweep(0.003, 0.0005, 0.001)
"""Sweeps after the others where the masks' outlines are those of the skin."""
TAKE_SWEEPS = (Sweep(0.004, 0.0005, 0.001), 300), (Sweep(0.0015, 0.0005, 0.001), 1000)
"""Sweeps at every timestep, and the number of mostly found points that they look for. The first
starts at the pose of the landmarks, where patches do not yet lie on their skin."""
SURFACE_POINTS = 2000
"""Points over the whole head."""
SURFACE_TIMESTEPS = 6
"""Timesteps, spread over the take, whose surfaces identity and offsets are solved from."""
LANDMARK_FRACTION = 0.1
"""Weight of landmarks beside surface points: a detector's errors are the same in every frame and
stay."""
TAKE_LANDMARK_FRACTION = 0.2
"""The same once these errors are taken off, which takes several timesteps: where skin slides along
itself, as brows do, only landmarks show it."""
LIPS_LANDMARK_FRACTION = 1.0
"""Weight of the lips' landmarks, beside which the surface does not show whether lips touch."""
MIN_OBSERVED_POINTS = 150
"""Points of the surface that have to be found at a timestep; below it, landmarks are the better
evidence."""
MIN_OBSERVED_FRACTION = 0.5
"""Fraction of the timesteps in which a point must be found to be looked for at every timestep."""

PART_TIMESTEPS = 24
"""Timesteps of a take that are searched at once, at most."""
FEW_CAMERAS = 3
"""Median over the timesteps of the cameras that show a face, up to which expressions and poses of
dense tracking are nearer to the truth than those of the surface."""
OFFSET_DENSITY = 1.5e10
"""Weight of SURFACE_POINTS points over a head, in 1/m⁴: the two priors below are relative to it."""
SMOOTHING_M = 0.009
"""Length over which offsets are smoothed."""
OFFSET_SIGMA_M = 0.03
"""Prior of an offset: how fast offsets vanish where no surface is seen."""
OFFSET_ITERATIONS = 5
"""Iterations of reweighted least squares: points that the last one missed count less."""
MAX_COTANGENT = 5.0
"""Largest cotangent of an angle, 11°: needles would outweigh all other triangles."""
SURFACE_SIGMA_M = 0.0005
MAX_OUTLINE_CAMERAS = 8  # Cameras whose masks are compared at every timestep


def fit_surface(
    head: HeadModel,
    fit: HeadFit,
    take: RecordedTake,
    workers: Workers,
    dense: bool = False,
) -> HeadFit:
    """The fit moved onto the surface that several cameras see; unchanged where no timestep has
    landmarks of several cameras, or where the images do not show enough of it.

    Rounds of finding the surface along the normals, and of solving scale, identity, expression and
    pose from it, then the person's smooth offsets; at last expression and pose of every timestep.
    Landmarks stay in at a small weight. Timesteps are searched at once, by helping processes. `fit`
    is what `fit_head` returns for `head`, or, with `dense`,
    `fit_dense`: landmarks are then where that fit has them, because it knows how skin slides along
    itself, which the surface does not show; with up to FEW_CAMERAS cameras, its expressions and
    poses are kept.
    """
    timesteps = sorted(take.landmarks)
    several = [t for t in timesteps if len(take.landmarks[t].cameras) > 1]
    if not several:
        return fit
    chosen = evenly_spread(several, SURFACE_TIMESTEPS)
    visibility = head_fit.LandmarkVisibility(fit.head, take.places)
    visible = {
        t: visibility.weighted(landmarks, fit.parameters[t], fit.to_capture)
        for t, landmarks in take.landmarks.items()
    }
    take = replace(take, landmarks=visible)
    points = surface_points(head, SURFACE_POINTS)
    early = (len(IDENTITY_SWEEPS) + len(OUTLINE_SWEEPS)) * len(chosen)
    search = _Search(workers, early + len(timesteps))
    start = replace(fit, parameters={t: fit.parameters[t] for t in chosen})
    solved = _solved_subject(head, start, take, points, search)
    if solved is None:
        return fit
    (take, found, surfaces) = solved
    search.done = early
    if not dense:
        marks = take.landmarks
        observed = {t: head_fit.landmarks_in_capture(marks[t], take, found) for t in timesteps}
    else:
        observed = _fitted_landmarks(found, fit, take)
        if np.median([len(each.cameras) for each in take.landmarks.values()]) <= FEW_CAMERAS:
            # the landmarks where they are on `fit`, whose own parameters are of another identity
            poses = np.stack([fit.parameters[t] for t in observed])
            poses = solve_take(found.head, take.places, list(observed.values()), poses, fit.ordered)
            return replace(found, parameters=dict(zip(observed, poses, strict=True)))
    often = (
        np.mean([each.weight > 0 for each in surfaces.values()], axis=0) >= MIN_OBSERVED_FRACTION
    )
    rows = np.flatnonzero(often)
    sought = []
    for sweep, count in TAKE_SWEEPS:
        on = points[rows[:: 1 + len(rows) // count]]
        sought.append(SurfaceSearch(on, near_landmarks(found.head, on, take), sweep))
    return _whole_take(found, fit, take, observed, sought, search)


class _Search:
    """Parts of a search for the surface, worked on at once by helping processes, and reported as
    so many timesteps of `total`."""

    def __init__(self, workers: Workers, total: int) -> None:
        self.done = 0
        self._workers = workers
        self._total = total

    def __call__(self, work: Callable[..., list], parts: Sequence[tuple]) -> list:
        """The results of the parts' timesteps, in order."""
        at = Stage.SURFACE, self.done, self._total
        found = [one for result in self._workers.map(work, parts, at) for one in result]
        self.done += len(found)
        return found


def _solved_subject(
    head: HeadModel, start: HeadFit, take: RecordedTake, points: SurfacePoints, search: _Search
) -> tuple[RecordedTake, HeadFit, dict[int, ObservedSurface]] | None:
    """Result of `_identity` by the skin, and by the masks' outlines where these agree with the
    skin; and the take, without masks where they do not."""
    near = near_landmarks(head, points, take)
    by_skin, by_outline = (
        [SurfaceSearch(points, near, sweep) for sweep in sweeps]
        for sweeps in (IDENTITY_SWEEPS, OUTLINE_SWEEPS)
    )
    without = replace(take, masks=head_fit.no_pictures)
    solved = _identity(head, start, without, by_skin, search)
    if solved is None:
        return None
    if not outlines_agree(solved[0], take, by_outline[0]):
        return without, *solved
    again = replace(solved[0], static_offset=None)
    return take, *(_identity(head, again, take, by_outline, search) or solved)


def _observed_part(
    fit: HeadFit, take: RecordedTake, sought: SurfaceSearch, step: Step
) -> list[ObservedSurface]:
    """The surface at each of the fit's timesteps, from images and masks."""
    surfaces = []
    for t in fit.parameters:
        surfaces.append(observed_surface(fit, t, sought, take.images(t), take.masks(t), {}))
        step()
    return surfaces


def with_offset(head: HeadModel, offset: np.ndarray) -> HeadModel:
    """The head model with vertex offsets (V, 3) added to its template."""
    return replace(head, model=replace(head.model, v_template=head.model.v_template + offset))


def _identity(
    head: HeadModel,
    fit: HeadFit,
    take: RecordedTake,
    sought: Sequence[SurfaceSearch],
    search: _Search,
) -> tuple[HeadFit, dict[int, ObservedSurface]] | None:
    """Identity, scale and offsets from the timesteps of the fit, in rounds of what is sought, and
    the surfaces that they were solved from; None where the images do not show enough of the
    surface."""
    offset = np.zeros_like(head.model.v_template)
    surfaces = dict[int, ObservedSurface]()
    for number, on in enumerate(sought):
        parts = [(*head_fit.excerpt(fit, take, [t]), on) for t in fit.parameters]
        surfaces = dict(zip(fit.parameters, search(_observed_part, parts), strict=True))
        if np.median([(each.weight > 0).sum() for each in surfaces.values()]) < MIN_OBSERVED_POINTS:
            return None
        base = with_offset(head, offset)
        fraction = _landmark_fractions(base, take.places)
        together = [
            _joined(head_fit.landmarks_in_capture(take.landmarks[t], take, fit), fraction, surface)
            for t, surface in surfaces.items()
        ]
        starts = np.stack([fit.parameters[t][-RIGID_SIZE:] for t in surfaces])
        found = solve_identity(base, take.places + on.points, together, starts, take.metric)
        fit = replace(
            fit,
            head=person(base, found.shape),
            shape=found.shape,
            parameters=dict(zip(surfaces, found.frames, strict=True)),
            to_capture=head_fit.scaled_down(fit.to_capture, found.scale),
        )
        surfaces = {
            t: replace(each, position=each.position / found.scale) for t, each in surfaces.items()
        }
        if number:  # what is left between the person's template and the surfaces, along its normals
            model = fit.head.model
            missing = []
            for t, surface in surfaces.items():
                at = on.points.on(posed_mesh(fit, fit.parameters[t]), model.faces)
                missing.append(((surface.position - at) * surface.normal).sum(1))
            repeated = on.points[np.tile(np.arange(len(on.points)), len(surfaces))]
            weight = np.concatenate([each.weight for each in surfaces.values()]) / len(surfaces)
            left = repeated, np.concatenate(missing), weight
            values = smooth_offsets(model.v_template, model.faces, *left)
            offset = offset + values[:, None] * vertex_normals(model.v_template, model.faces)
            subject = person(with_offset(head, offset), fit.shape)
            fit = replace(fit, head=subject, static_offset=offset)
    return fit, surfaces


def _whole_take(
    fit: HeadFit,
    first: HeadFit,
    take: RecordedTake,
    observed: Mapping[int, Observation],
    sought: Sequence[SurfaceSearch],
    search: _Search,
) -> HeadFit:
    """Expression and pose of every timestep, from landmarks and then from the surface beside them.

    observed: the landmarks; sought: for each of TAKE_SWEEPS. What a landmark misses at the
    timesteps of `fit`, it misses in all: it is taken off.
    """
    timesteps = list(observed)
    model = fit.head.model
    missed = [
        (observed[t].position - take.places.on(posed_mesh(fit, values), model.faces))
        @ head_rotation(values)
        for t, values in fit.parameters.items()
    ]
    bias = np.median(missed, axis=0)  # (N, 3) in the turned head's axes
    corrected = {
        t: replace(
            observation, position=observation.position - bias @ head_rotation(first.parameters[t]).T
        )
        for t, observation in observed.items()
    }
    landmarks = list(corrected.values())
    at = take.places.on(model.v_template, model.faces)
    start = np.zeros((len(timesteps), model.n_expression + RIGID_SIZE))
    start[:, -RIGID_SIZE:] = [head_fit.rigid_start(at, observation) for observation in landmarks]
    start = solve_take(fit.head, take.places, landmarks, start, fit.ordered)
    rough = replace(fit, parameters=dict(zip(timesteps, start, strict=True)))
    fraction = np.full(len(take.reliable), TAKE_LANDMARK_FRACTION)
    if len(fit.parameters) == 1:
        fraction = _landmark_fractions(fit.head, take.places)
    parts = [
        (*head_fit.excerpt(rough, take, part), [corrected[t] for t in part], fraction, sought)
        for part in parts_of(timesteps, PART_TIMESTEPS)
    ]
    found, together = zip(*search(_found_part, parts), strict=True)
    every = take.places + sought[-1].points
    solved = solve_take(fit.head, every, together, np.stack(found), fit.ordered)
    return replace(fit, parameters=dict(zip(timesteps, solved, strict=True)))


def _found_part(
    fit: HeadFit,
    take: RecordedTake,
    landmarks: Sequence[Observation],
    fraction: np.ndarray,
    sought: Sequence[SurfaceSearch],
    step: Step,
) -> list[tuple[np.ndarray, Observation]]:
    """Parameters (E + 18,) of each of the fit's timesteps, and landmarks and surface that they were
    solved from."""
    results = []
    visible_points: list[VisiblePoints] = [{} for _ in sought]
    for (t, here), observation in zip(fit.parameters.items(), landmarks, strict=True):
        pictures = take.images(t), take.masks(t, MAX_OUTLINE_CAMERAS)
        for on, visible in zip(sought, visible_points, strict=True):
            rough = replace(fit, parameters={t: here})
            joined = _joined(
                observation, fraction, observed_surface(rough, t, on, *pictures, visible)
            )
            places = take.places + on.points
            (here,) = solve_take(fit.head, places, [joined], here[None], ordered=False)
        results.append((here, joined))
        step()
    return results


def _fitted_landmarks(fit: HeadFit, first: HeadFit, take: RecordedTake) -> dict[int, Observation]:
    """The landmarks of the fit `first` at every timestep, in the world of the fit."""
    points = PosedPoints(first.head.model, take.places)
    count = len(take.reliable)
    scale = fit.to_capture.scale / first.to_capture.scale
    found = {}
    for t in sorted(take.landmarks):
        at = scale * points.positions(*split(first.parameters[t]))
        found[t] = Observation(at, np.tile(np.eye(3), (count, 1, 1)), np.ones(count))
    return found


def _landmark_fractions(head: HeadModel, places: SurfacePoints) -> np.ndarray:
    """(N,) of the landmarks' weights: LIPS_LANDMARK_FRACTION where the model's lips are, else
    LANDMARK_FRACTION."""
    lips = faces_within(head.model.faces, head.model.masks.get("lips", np.zeros(0, np.int64)))
    return np.where(lips[places.face], LIPS_LANDMARK_FRACTION, LANDMARK_FRACTION)


def _joined(landmarks: Observation, fraction: np.ndarray, surface: ObservedSurface) -> Observation:
    """Both as one observation, landmarks at fractions (N,) of their weight; the surface counts
    along its normal."""
    along = surface.normal[:, :, None] * surface.normal[:, None, :]
    root = LANDMARK_SIGMA_M / SURFACE_SIGMA_M * along
    return Observation(
        np.concatenate([landmarks.position, surface.position]),
        np.concatenate([landmarks.root, root]),
        np.concatenate([fraction * landmarks.weight, surface.weight]),
    )


def smooth_offsets(
    vertices: np.ndarray,
    faces: np.ndarray,
    points: SurfacePoints,
    residual: np.ndarray,
    weight: np.ndarray,
) -> np.ndarray:
    """Smooth values (V,) of the vertices that take the values `residual` (N,) meters at the points,
    robustly.

    weight (N,). Least squares with the squared Laplacian as prior; values vanish where no point is
    near.
    """
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.linalg import spsolve

    count = len(vertices)
    rows = np.repeat(np.arange(len(points)), 3)
    places = rows, faces[points.face].ravel()
    at = coo_array((points.barycentric.ravel(), places), shape=(len(points), count)).tocsr()
    fraction = np.linalg.norm(triangle_normals(vertices[faces]), axis=1) / 6
    area = np.bincount(faces.ravel(), np.repeat(fraction, 3), count)
    laplacian = _laplacian(vertices, faces, area)
    smooth = SMOOTHING_M**4 * laplacian.T @ diags_array(area) @ laplacian
    small = diags_array((SMOOTHING_M / OFFSET_SIGMA_M) ** 4 * np.maximum(area, 1e-9))
    prior = OFFSET_DENSITY * (smooth + small)
    values = np.zeros(count)
    trust = weight / SURFACE_SIGMA_M**2
    for _ in range(OFFSET_ITERATIONS):
        miss = (residual - at @ values) / (2 * SURFACE_SIGMA_M)
        robust = trust / (1 + miss**2) ** 2 if values.any() else trust / np.sqrt(1 + miss**2)
        matrix = (at.T @ diags_array(robust) @ at + prior).tocsc()
        values = spsolve(matrix, at.T @ (robust * residual))
    return values


def _laplacian(vertices: np.ndarray, faces: np.ndarray, area: np.ndarray) -> Any:
    """Sparse (V, V), in 1/m²: the cotangent Laplacian (Pinkall and Polthier 1993), which depends on
    the surface alone, not on its triangles; 0 at the mesh's edge. area (V,) of the vertices."""
    from scipy.sparse import coo_array, diags_array

    size = (len(vertices),) * 2
    corners = vertices[faces]
    ends = corners[:, [1, 2, 0]] - corners, corners[:, [2, 0, 1]] - corners
    sine = np.linalg.norm(np.cross(*ends), axis=2)
    cotangent = (ends[0] * ends[1]).sum(2) / np.maximum(sine, 1e-20)
    weight = np.clip(cotangent, -MAX_COTANGENT, MAX_COTANGENT) / 2
    across = np.stack([faces[:, [1, 2, 0]].ravel(), faces[:, [2, 0, 1]].ravel()])  # from its angle
    half = coo_array((weight.ravel(), across), shape=size).tocsr()
    around = half + half.T
    edges, count = np.unique(np.sort(across, axis=0), axis=1, return_counts=True)
    inner = ~np.isin(np.arange(len(vertices)), edges[:, count == 1])
    difference = around - diags_array(around.sum(axis=1))
    return (diags_array(inner / np.maximum(area, 1e-9)) @ difference).tocsr()
