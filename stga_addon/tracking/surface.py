"""From a head fitted to landmarks to one fitted to the skin that the cameras see, with the person's own offsets."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..capture.camera import Camera
from ..capture.model import evenly_spread
from .fit import (
    HeadFit,
    TimestepLandmarks,
    by_visibility,
    observed_landmarks,
    rigid_start,
    triangulated,
)
from .head_model import HeadModel
from .landmarks import Report
from .mesh_image import vertex_normals
from .outline import outline_offsets
from .photo_consistency import Sweep, facing, gray_view, in_sight, surface_offsets
from .posed_points import RIGID_SIZE, SurfacePoints, head_rotation
from .solve import LANDMARK_SIGMA_M, Observation, person, solve_identity, solve_take
from .write_capture import posed_mesh

IDENTITY_SWEEPS = Sweep(0.010, 0.001, 0.0015), Sweep(0.004, 0.0005, 0.001), Sweep(0.003, 0.0005, 0.001)
OUTLINE_SWEEPS = Sweep(0.003, 0.0005, 0.001), Sweep(0.003, 0.0005, 0.001)
"""After the others, where the masks' outlines are those of the skin."""
TAKE_SWEEPS = (Sweep(0.004, 0.0005, 0.001), 300), (Sweep(0.0015, 0.0005, 0.001), 1000)
"""At every timestep, and how many of the points that are usually found are looked for. The first starts at the pose of
the landmarks, from which patches do not lie on the skin that they are of yet."""
SURFACE_POINTS = 2000
"""Points over the whole head."""
SURFACE_TIMESTEPS = 6
"""Timesteps, spread over the take, whose surfaces identity and offsets are solved from."""
SURFACE_SIGMA_M = 0.0005
POINT_SHARE = 0.25
"""Weight of a surface point: patches of neighboring points share most of their pixels."""
LANDMARK_SHARE = 0.05
"""Weight of landmarks beside surface points: a detector's errors are the same in every frame and stay."""
MIN_SEEN_POINTS = 150
"""Points of the surface that have to be found at a timestep; below it, landmarks are the better evidence."""
MIN_SEEN_SHARE = 0.5
"""Share of the timesteps in which a point must be found to be looked for at every timestep."""
DIRECTIONS = 6
"""Steps of a direction's coordinates, about 10°: from within one step, a head hides the same of itself."""
MIN_PART_SHARE = 0.33
"""Connected parts smaller than this share of the head (eyeballs, teeth) have no surface points."""
OFFSET_DENSITY = 1.5e10
"""Weight of SURFACE_POINTS points over a head, in 1/m⁴: the two priors below are relative to it."""
SMOOTHING_M = 0.009
"""Length over which offsets are smoothed."""
OFFSET_SIGMA_M = 0.03
"""Prior of an offset; it decides how fast offsets vanish where no surface is seen."""
OFFSET_ITERATIONS = 5

MAX_OUTLINE_DISTANCE_M = 0.0005
"""Median distance of the masks' outlines from the surface in the images, beyond which they are not those of the skin:
mattes are often a pixel or two too wide, and hair hangs over faces."""
MIN_OUTLINE_POINTS = 100
MAX_OUTLINE_CAMERAS = 8
"""Cameras whose masks are compared at every timestep."""
OUTLINE_RADIUS_M = 0.01
"""Distance from the landmarks beyond which outlines are those of hair, ears and clothes."""

Images = Callable[[int], Sequence[tuple[Camera, np.ndarray]]]
"""Timestep -> cameras, in the footage's world, and their images (H, W, 3) or masks (H, W), uint8."""

Sights = dict[tuple[int, ...], np.ndarray]
"""Direction from the head, rounded -> (N,) bool: points that are not hidden from there."""


def no_masks(timestep: int) -> Sequence[tuple[Camera, np.ndarray]]:
    """The masks of footage without any."""
    return ()


@dataclass(frozen=True)
class SeenSurface:
    """Where cameras see N points of a surface: positions (N, 3) in meters, unit normals (N, 3) and weights (N,)."""

    position: np.ndarray
    normal: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class Take:
    """What was recorded: places of landmarks on the head, which are reliable, landmarks by timestep, images, masks, and
    whether the world of the cameras is in meters."""

    places: SurfacePoints
    reliable: np.ndarray
    landmarks: Mapping[int, TimestepLandmarks]
    images: Images
    masks: Images = no_masks
    metric: bool = False


def fit_surface(head: HeadModel, fit: HeadFit, take: Take, report: Report = lambda stage, done, total: None) -> HeadFit:
    """The fit moved onto the surface that several cameras see; unchanged where no timestep has landmarks of several
    cameras, or where the images do not show enough of it.

    Rounds of finding the surface along the normals, and of solving scale, identity, expression and pose from it, then
    the person's smooth offsets; at last expression and pose of every timestep. Landmarks stay in at a small weight.
    `fit` is what `fit_head` returns for `head`.
    """
    timesteps = sorted(take.landmarks)
    several = [t for t in timesteps if len(take.landmarks[t].cameras) > 1]
    if not several:
        return fit
    chosen = evenly_spread(several, SURFACE_TIMESTEPS)
    visible = {
        t: by_visibility(own, fit.head, take.places, fit.parameters[t], fit.to_capture)
        for t, own in take.landmarks.items()
    }
    take = replace(take, landmarks=visible)
    early = (len(IDENTITY_SWEEPS) + len(OUTLINE_SWEEPS)) * len(chosen)
    steps = early + len(timesteps)
    points = surface_points(head, SURFACE_POINTS)
    near = near_landmarks(head, points, take)
    start, without = replace(fit, parameters={t: fit.parameters[t] for t in chosen}), replace(take, masks=no_masks)
    solved = _identity(head, start, without, points, near, IDENTITY_SWEEPS, lambda n: report("Surface", n, steps))
    if solved is None:
        return fit
    if outlines_agree(solved[0], take, points, near):
        start, begin = replace(solved[0], static_offset=None), len(IDENTITY_SWEEPS) * len(chosen)
        again = _identity(
            head, start, take, points, near, OUTLINE_SWEEPS, lambda n: report("Surface", begin + n, steps)
        )
        solved = again or solved
    else:
        take = without
    often = [_often_seen(points, solved[1], count) for _, count in TAKE_SWEEPS]
    return _whole_take(solved[0], fit, take, often, lambda left: report("Surface", steps - left, steps))


def _identity(
    head: HeadModel,
    found: HeadFit,
    take: Take,
    points: SurfacePoints,
    near: np.ndarray,
    sweeps: Sequence[Sweep],
    report: Callable[[int], None],
) -> tuple[HeadFit, dict[int, SeenSurface]] | None:
    """Identity, scale and offsets from the timesteps of `found`, and the surfaces that they were solved from.

    near: as of `with_outlines`. None where the images do not show enough of the surface.
    """
    offset, seen = np.zeros_like(head.model.v_template), dict[int, SeenSurface]()
    for number, sweep in enumerate(sweeps):
        for row, t in enumerate(found.parameters):
            report(number * len(found.parameters) + row)
            surface = seen_surface(found, t, points, take.images(t), sweep, {})
            seen[t] = with_outlines(surface, found, t, points, take.masks(t), near, sweep.reach)
        if np.median([(own.weight > 0).sum() for own in seen.values()]) < MIN_SEEN_POINTS:
            return None
        found, seen = _solved(with_offset(head, offset), found, take, points, seen)
        if number:
            offset = offset + _offsets(found, points, seen)
            found = replace(found, head=person(with_offset(head, offset), found.shape), static_offset=offset)
    return found, seen


def with_offset(head: HeadModel, offset: np.ndarray) -> HeadModel:
    """The head model with vertex offsets (V, 3) added to its template."""
    return replace(head, model=replace(head.model, v_template=head.model.v_template + offset))


def surface_points(head: HeadModel, count: int) -> SurfacePoints:
    """Centers of about `count` triangles, spread evenly over the area of the head's large connected parts."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    vertices, faces = head.model.v_template, head.model.faces
    edges = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = coo_array((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2)
    _, part = connected_components(graph, directed=False)
    extent = np.array([np.ptp(vertices[part == number], axis=0).max() for number in range(part.max() + 1)])
    large = (extent > MIN_PART_SHARE * np.ptp(vertices, axis=0).max())[part[faces[:, 0]]]
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.cumsum(np.where(large, np.linalg.norm(np.cross(b - a, c - a), axis=1), 0.0))
    face = np.unique(np.searchsorted(area, (np.arange(count) + 0.5) / count * area[-1]))
    return SurfacePoints(face, np.full((len(face), 3), 1 / 3))


def seen_surface(
    fit: HeadFit,
    timestep: int,
    points: SurfacePoints,
    images: Sequence[tuple[Camera, np.ndarray]],
    sweep: Sweep,
    sights: Sights,
) -> SeenSurface:
    """Where the images show the surface near the fitted head, along its normals; weight 0 for what they do not show.

    `sights` is filled with what is in sight from where, and read for directions that are in it already.
    """
    faces = fit.head.model.faces
    vertices = posed_mesh(fit, fit.parameters[timestep])
    at, normals = points.on(vertices, faces), points.on(vertex_normals(vertices, faces), faces)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    cameras = [fit.to_capture.camera(camera) for camera, _ in images]
    views = [
        gray_view(camera, image, at.mean(0), sweep.spacing) for camera, (_, image) in zip(cameras, images, strict=True)
    ]
    turn, cosines = head_rotation(fit.parameters[timestep]), []
    for camera in cameras:
        direction = (camera.position - at.mean(0)) @ turn
        key = tuple(np.round(DIRECTIONS * direction / np.linalg.norm(direction)).astype(int).tolist())
        if key not in sights:
            sights[key] = in_sight(camera, vertices, faces, at)
        cosines.append(facing(camera, at, normals) * sights[key])
    offset, correlation = surface_offsets(views, np.stack(cosines), at, normals, sweep)
    return SeenSurface(at + offset[:, None] * normals, normals, POINT_SHARE * correlation)


def with_outlines(
    seen: SeenSurface,
    fit: HeadFit,
    timestep: int,
    points: SurfacePoints,
    masks: Sequence[tuple[Camera, np.ndarray]],
    near: np.ndarray,
    reach: float,
) -> SeenSurface:
    """The surface with what masks say about points at the head's outline; near (N,) bool: points that this is for."""
    vertices, faces = posed_mesh(fit, fit.parameters[timestep]), fit.head.model.faces
    at = points.on(vertices, faces)
    total, moved = seen.weight.copy(), seen.weight * ((seen.position - at) * seen.normal).sum(1)
    for camera, mask in masks:
        posed = fit.to_capture.camera(camera)
        offset, known = outline_offsets(posed, mask, vertices, faces, at[near], seen.normal[near], reach)
        total[near] += POINT_SHARE * known
        moved[near] += POINT_SHARE * offset
    mean = moved / np.maximum(total, 1e-9)
    return replace(seen, position=at + mean[:, None] * seen.normal, weight=total)


def outlines_agree(fit: HeadFit, take: Take, points: SurfacePoints, near: np.ndarray) -> bool:
    """Whether the masks end where the surface in the images does; False without masks."""
    model, distances = fit.head.model, [np.zeros(0)]
    for timestep, parameters in fit.parameters.items():
        vertices = posed_mesh(fit, parameters)
        at, normals = (
            points.on(values, model.faces)[near] for values in (vertices, vertex_normals(vertices, model.faces))
        )
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        for camera, mask in take.masks(timestep):
            posed = fit.to_capture.camera(camera)
            offset, known = outline_offsets(posed, mask, vertices, model.faces, at, normals, OUTLINE_SWEEPS[0].reach)
            distances.append(np.abs(offset[known]))
    every = np.concatenate(distances)
    return len(every) >= MIN_OUTLINE_POINTS and float(np.median(every)) < MAX_OUTLINE_DISTANCE_M


def near_landmarks(head: HeadModel, points: SurfacePoints, take: Take) -> np.ndarray:
    """(N,) bool: points within OUTLINE_RADIUS_M of a reliable landmark."""
    from scipy.spatial import cKDTree

    template, faces = head.model.v_template, head.model.faces
    distance, _ = cKDTree(take.places.on(template, faces)[take.reliable]).query(points.on(template, faces))
    return np.asarray(distance < OUTLINE_RADIUS_M)


def smooth_offsets(
    vertices: np.ndarray, faces: np.ndarray, points: SurfacePoints, residual: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """Smooth values (V,) of the vertices that take the values `residual` (N,) meters at the points, robustly.

    weight (N,). Least squares with the squared Laplacian as prior; values vanish where no point is near.
    """
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.linalg import spsolve

    count = len(vertices)
    rows = np.repeat(np.arange(len(points)), 3)
    at = coo_array((points.barycentric.ravel(), (rows, faces[points.face].ravel())), shape=(len(points), count)).tocsr()
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    share = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    area = np.bincount(faces.ravel(), np.repeat(share, 3), count)
    laplacian = _laplacian(vertices, faces)
    prior = OFFSET_DENSITY * (
        SMOOTHING_M**4 * laplacian.T @ diags_array(area) @ laplacian
        + diags_array((SMOOTHING_M / OFFSET_SIGMA_M) ** 4 * np.maximum(area, 1e-9))
    )
    values, trust = np.zeros(count), weight / SURFACE_SIGMA_M**2
    for _ in range(OFFSET_ITERATIONS):
        miss = (residual - at @ values) / (2 * SURFACE_SIGMA_M)
        robust = trust / (1 + miss**2) ** 2 if values.any() else trust / np.sqrt(1 + miss**2)
        values = spsolve((at.T @ diags_array(robust) @ at + prior).tocsc(), at.T @ (robust * residual))
    return np.asarray(values)


def _laplacian(vertices: np.ndarray, faces: np.ndarray) -> Any:
    """Sparse (V, V), in 1/m²: difference from the mean of a vertex's neighbors, over their mean squared distance."""
    from scipy.sparse import coo_array, diags_array, eye_array

    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    size = (len(vertices),) * 2
    length = ((vertices[edges[:, 0]] - vertices[edges[:, 1]]) ** 2).sum(1)
    degree = np.maximum(np.bincount(edges[:, 0], minlength=size[0]), 1)
    squared = np.maximum(np.bincount(edges[:, 0], length, size[0]) / degree, 1e-8)
    mean = coo_array((1 / degree[edges[:, 0]], edges.T), shape=size)
    return (diags_array(4 / squared) @ (mean - eye_array(size[0]))).tocsr()


def _solved(
    base: HeadModel, fit: HeadFit, take: Take, points: SurfacePoints, seen: Mapping[int, SeenSurface]
) -> tuple[HeadFit, dict[int, SeenSurface]]:
    """Scale, identity, expressions and poses that fit surface and landmarks; and the surface in the new scale."""
    together = [_joined(_landmarks(fit, t, take), LANDMARK_SHARE, own) for t, own in seen.items()]
    starts = np.stack([fit.parameters[t][-RIGID_SIZE:] for t in seen])
    identity = solve_identity(base, _both(take.places, points), together, starts, take.metric)
    world = fit.to_capture
    moved = HeadFit(
        person(base, identity.shape),
        identity.shape,
        dict(zip(seen, identity.frames, strict=True)),
        replace(world, scale=world.scale / identity.scale, translation=world.translation / identity.scale),
        fit.static_offset,
    )
    return moved, {t: replace(own, position=own.position / identity.scale) for t, own in seen.items()}


def _offsets(fit: HeadFit, points: SurfacePoints, seen: Mapping[int, SeenSurface]) -> np.ndarray:
    """(V, 3) along the normals of the person's template, from what is left between it and the surfaces."""
    model = fit.head.model
    missing = [
        ((own.position - points.on(posed_mesh(fit, fit.parameters[t]), model.faces)) * own.normal).sum(1)
        for t, own in seen.items()
    ]
    repeated = SurfacePoints(np.tile(points.face, len(seen)), np.tile(points.barycentric, (len(seen), 1)))
    weight = np.concatenate([own.weight for own in seen.values()]) / len(seen)
    values = smooth_offsets(model.v_template, model.faces, repeated, np.concatenate(missing), weight)
    return np.asarray(values[:, None] * vertex_normals(model.v_template, model.faces))


def _often_seen(points: SurfacePoints, seen: Mapping[int, SeenSurface], count: int) -> SurfacePoints:
    """Up to `count` of the points that are found at most timesteps."""
    often = np.flatnonzero(np.mean([own.weight > 0 for own in seen.values()], axis=0) >= MIN_SEEN_SHARE)
    rows = often[:: 1 + len(often) // count]
    return SurfacePoints(points.face[rows], points.barycentric[rows])


def _whole_take(
    fit: HeadFit, first: HeadFit, take: Take, points: Sequence[SurfacePoints], report: Callable[[int], None]
) -> HeadFit:
    """Expression and pose of every timestep, from landmarks and then from the surface beside them.

    points: for each of TAKE_SWEEPS. What a landmark misses at the timesteps of `fit`, it misses in all: it is taken
    off.
    """
    timesteps, model = sorted(take.landmarks), fit.head.model
    bias = _landmark_bias(fit, take)
    landmarks = []
    for t in timesteps:
        own = _landmarks(fit, t, take)
        landmarks.append(replace(own, position=own.position - bias @ head_rotation(first.parameters[t]).T))
    start = np.zeros((len(timesteps), model.n_expression + RIGID_SIZE))
    start[:, -RIGID_SIZE:] = [rigid_start(take.places.on(model.v_template, model.faces), own) for own in landmarks]
    start = solve_take(fit.head, take.places, landmarks, start)
    together, near = [], [near_landmarks(fit.head, on, take) for on in points]
    sights: list[Sights] = [{} for _ in points]
    for number, (t, own) in enumerate(zip(timesteps, landmarks, strict=True)):
        report(len(timesteps) - number)
        images, masks = take.images(t), evenly_spread(take.masks(t), MAX_OUTLINE_CAMERAS)
        for stage, ((sweep, _), on) in enumerate(zip(TAKE_SWEEPS, points, strict=True)):
            rough = replace(fit, parameters={t: start[number]})
            seen = seen_surface(rough, t, on, images, sweep, sights[stage])
            seen = with_outlines(seen, rough, t, on, masks, near[stage], sweep.reach)
            joined = _joined(own, LANDMARK_SHARE, seen)
            start[number] = solve_take(fit.head, _both(take.places, on), [joined], start[number : number + 1])[0]
        together.append(joined)
    solved = solve_take(fit.head, _both(take.places, points[-1]), together, start)
    report(0)
    return replace(fit, parameters=dict(zip(timesteps, solved, strict=True)))


def _landmark_bias(fit: HeadFit, take: Take) -> np.ndarray:
    """(N, 3) in the turned head's axes: median distance of the landmarks from their places over the timesteps."""
    missed = [
        (_landmarks(fit, t, take).position - take.places.on(posed_mesh(fit, values), fit.head.model.faces))
        @ head_rotation(values)
        for t, values in fit.parameters.items()
    ]
    return np.asarray(np.median(missed, axis=0))


def _landmarks(fit: HeadFit, timestep: int, take: Take) -> Observation:
    world, at = fit.to_capture, take.places.on(fit.head.model.v_template, fit.head.model.faces)
    return observed_landmarks(
        triangulated(take.landmarks[timestep], take.reliable, at, world.scale), world, take.reliable
    )


def _joined(landmarks: Observation, share: float, surface: SeenSurface) -> Observation:
    """Both as one observation, landmarks at a share of their weight; the surface counts along its normal."""
    root = LANDMARK_SIGMA_M / SURFACE_SIGMA_M * surface.normal[:, :, None] * surface.normal[:, None, :]
    return Observation(
        np.concatenate([landmarks.position, surface.position]),
        np.concatenate([landmarks.root, root]),
        np.concatenate([share * landmarks.weight, surface.weight]),
    )


def _both(a: SurfacePoints, b: SurfacePoints) -> SurfacePoints:
    return SurfacePoints(np.concatenate([a.face, b.face]), np.concatenate([a.barycentric, b.barycentric]))
