"""From a head fitted to landmarks to one fitted to the skin that the cameras see, with the person's own offsets."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..capture.camera import Camera
from .fit import (
    HeadFit,
    TimestepLandmarks,
    by_visibility,
    observed_landmarks,
    rigid_start,
    spread_over,
    triangulated,
)
from .head_model import HeadModel
from .landmarks import Report
from .mesh_image import vertex_normals
from .photo_consistency import Sweep, facing, gray_view, in_sight, surface_offsets
from .posed_points import RIGID_SIZE, SurfacePoints
from .solve import LANDMARK_SIGMA_M, Observation, person, solve_identity, solve_take
from .write_capture import posed_mesh

IDENTITY_SWEEPS = (Sweep(0.010, 0.001, 0.0015), Sweep(0.004, 0.0005, 0.001), Sweep(0.003, 0.0005, 0.001))
TAKE_SWEEP = Sweep(0.004, 0.0005, 0.001)
IDENTITY_POINTS, TAKE_POINTS = 2000, 600
SURFACE_TIMESTEPS = 6
"""Timesteps, spread over the take, whose surfaces identity and offsets are solved from."""
SURFACE_SIGMA_M = 0.0005
INDEPENDENT_POINTS = 500
"""What all points of a surface count as together: patches of neighboring points share most of their pixels."""
LANDMARK_SHARE = 0.05
"""Weight of landmarks beside surface points: a detector's errors are the same in every frame and stay."""
MIN_SEEN_POINTS = 150
"""Points of the surface that have to be found at a timestep; below it, landmarks are the better evidence."""
MIN_PART_SHARE = 0.33
"""Connected parts smaller than this share of the head (eyeballs, teeth) have no surface points."""
OFFSET_DENSITY = 1.5e10
"""Weight of surface points at IDENTITY_POINTS, in 1/m⁴: the two priors below are relative to it."""
SMOOTHING_M = 0.005
"""Length over which offsets are smoothed."""
OFFSET_SIGMA_M = 0.03
"""Prior of an offset; it decides how fast offsets vanish where no surface is seen."""
OFFSET_ITERATIONS = 5

Images = Callable[[int], Sequence[tuple[Camera, np.ndarray]]]
"""Timestep -> cameras, in the footage's world, and their images (H, W, 3) uint8."""


@dataclass(frozen=True)
class SeenSurface:
    """Where cameras see N points of a surface: positions (N, 3) in meters, unit normals (N, 3) and weights (N,)."""

    position: np.ndarray
    normal: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class Take:
    """What was recorded: places of landmarks on the head, which are reliable, landmarks by timestep, and images."""

    places: SurfacePoints
    reliable: np.ndarray
    landmarks: Mapping[int, TimestepLandmarks]
    images: Images


def fit_surface(head: HeadModel, fit: HeadFit, take: Take, report: Report = lambda stage, done, total: None) -> HeadFit:
    """The fit moved onto the surface that several cameras see; unchanged where no moment has
    several, or where their images do not show enough of it.

    Rounds of finding the surface along the normals, and of solving scale, identity, expression and pose from it, then
    the person's smooth offsets; at last expression and pose of every timestep. Landmarks stay in at a small weight.
    `fit` is what `fit_head` returns for `head`.
    """
    timesteps = sorted(take.landmarks)
    several = [t for t in timesteps if len(take.landmarks[t].cameras) > 1]
    if not several:
        return fit
    chosen = spread_over(several, SURFACE_TIMESTEPS)
    steps = len(IDENTITY_SWEEPS) * len(chosen) + len(timesteps)
    points, offset = surface_points(head, IDENTITY_POINTS), np.zeros_like(head.model.v_template)
    found = replace(fit, parameters={t: fit.parameters[t] for t in chosen})
    for number, sweep in enumerate(IDENTITY_SWEEPS):
        seen: dict[int, SeenSurface] = {}
        for t in chosen:
            report("Surface", number * len(chosen) + len(seen), steps)
            seen[t] = seen_surface(found, t, points, take.images(t), sweep)
        if np.median([(own.weight > 0).sum() for own in seen.values()]) < MIN_SEEN_POINTS:
            return fit
        found, seen = _solved(with_offset(head, offset), found, take, points, seen)
        if number:
            offset = offset + _offsets(found, points, seen)
            found = replace(found, head=person(with_offset(head, offset), found.shape), static_offset=offset)
    return _whole_take(
        found, take, surface_points(head, TAKE_POINTS), lambda left: report("Surface", steps - left, steps)
    )


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
    fit: HeadFit, timestep: int, points: SurfacePoints, images: Sequence[tuple[Camera, np.ndarray]], sweep: Sweep
) -> SeenSurface:
    """Where the images show the surface near the fitted head, along its normals; weight 0 for what they do not show."""
    faces = fit.head.model.faces
    vertices = posed_mesh(fit, fit.parameters[timestep])
    at, normals = points.on(vertices, faces), points.on(vertex_normals(vertices, faces), faces)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    cameras = [fit.to_capture.camera(camera) for camera, _ in images]
    views = [
        gray_view(camera, image, at.mean(0), sweep.spacing) for camera, (_, image) in zip(cameras, images, strict=True)
    ]
    cosines = [facing(camera, at, normals) * in_sight(camera, vertices, faces, at) for camera in cameras]
    offset, correlation = surface_offsets(views, np.stack(cosines), at, normals, sweep)
    return SeenSurface(
        at + offset[:, None] * normals, normals, min(1.0, INDEPENDENT_POINTS / len(points)) * correlation
    )


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
    together = [_joined(_landmarks(fit, t, take), own) for t, own in seen.items()]
    starts = np.stack([fit.parameters[t][-RIGID_SIZE:] for t in seen])
    identity = solve_identity(base, _both(take.places, points), together, starts)
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


def _whole_take(fit: HeadFit, take: Take, points: SurfacePoints, report: Callable[[int], None]) -> HeadFit:
    """Expression and pose of every timestep, from landmarks and then from the surface beside them."""
    timesteps, world = sorted(take.landmarks), fit.to_capture
    at = take.places.on(fit.head.model.v_template, fit.head.model.faces)
    landmarks = [
        observed_landmarks(triangulated(take.landmarks[t], take.reliable, at, world.scale), world, take.reliable)
        for t in timesteps
    ]
    start = np.zeros((len(timesteps), fit.head.model.n_expression + RIGID_SIZE))
    start[:, -RIGID_SIZE:] = [rigid_start(at, own) for own in landmarks]
    start = solve_take(fit.head, take.places, landmarks, start)
    rough = replace(fit, parameters=dict(zip(timesteps, start, strict=True)))
    together = []
    for number, t in enumerate(timesteps):
        report(len(timesteps) - number)
        seen = seen_surface(rough, t, points, take.images(t), TAKE_SWEEP)
        together.append(_joined(_landmarks(rough, t, take), seen))
    solved = solve_take(fit.head, _both(take.places, points), together, start)
    report(0)
    return replace(fit, parameters=dict(zip(timesteps, solved, strict=True)))


def _landmarks(fit: HeadFit, timestep: int, take: Take) -> Observation:
    """The timestep's landmarks, of each camera by the angle at which it sees them, at the weight of LANDMARK_SHARE."""
    world, at = fit.to_capture, take.places.on(fit.head.model.v_template, fit.head.model.faces)
    visible = by_visibility(take.landmarks[timestep], fit.head, take.places, fit.parameters[timestep], world)
    found = observed_landmarks(triangulated(visible, take.reliable, at, world.scale), world, take.reliable)
    return replace(found, weight=LANDMARK_SHARE * found.weight)


def _joined(landmarks: Observation, surface: SeenSurface) -> Observation:
    """Both as one observation; the surface's position counts along its normal, in units of SURFACE_SIGMA_M."""
    root = LANDMARK_SIGMA_M / SURFACE_SIGMA_M * surface.normal[:, :, None] * surface.normal[:, None, :]
    return Observation(
        np.concatenate([landmarks.position, surface.position]),
        np.concatenate([landmarks.root, root]),
        np.concatenate([landmarks.weight, surface.weight]),
    )


def _both(a: SurfacePoints, b: SurfacePoints) -> SurfacePoints:
    return SurfacePoints(np.concatenate([a.face, b.face]), np.concatenate([a.barycentric, b.barycentric]))
