"""Where images and masks show the surface of a fitted head."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ..capture.camera import Camera
from ..capture.mesh_geometry import connected_parts, vertex_normals
from ..flame.model import FlameModel
from .fit import HeadFit, TimestepLandmarks
from .head_model import HeadModel
from .outline import outline_offsets
from .photo_consistency import Sweep, facing, gray_view, in_sight, surface_offsets
from .posed_points import SurfacePoints, head_rotation
from .write_capture import posed_mesh

POINT_SHARE = 0.25
"""Weight of a surface point: patches of neighboring points share most of their pixels."""
DIRECTIONS = 6
"""Steps of a direction's coordinates, about 10°: from within one step, a head hides the same of
itself."""
MIN_PART_SHARE = 0.33
"""Connected parts smaller than this share of the head (eyeballs, teeth) have no surface points."""

MAX_OUTLINE_DISTANCE_M = 0.0005
"""Median distance of the masks' outlines from the surface in the images, beyond which they are not
those of the skin: mattes are often a pixel or two too wide, and hair hangs over faces."""
MIN_OUTLINE_POINTS = 100
OUTLINE_RADIUS_M = 0.01
"""Distance from the landmarks beyond which outlines are those of hair, ears and clothes."""


class Images(Protocol):
    """Gives, of a timestep, cameras in the footage's world and their images (H, W, 3) or masks (H,
    W), uint8; at most so many, spread over the rig."""

    def __call__(
        self, timestep: int, most: int | None = None
    ) -> Sequence[tuple[Camera, np.ndarray]]: ...


VisiblePoints = dict[tuple[int, ...], np.ndarray]
"""Direction from the head, rounded -> (N,) bool: points that are not hidden from there."""


def no_masks(timestep: int, most: int | None = None) -> Sequence[tuple[Camera, np.ndarray]]:
    """The masks of footage without any."""
    return ()


@dataclass(frozen=True)
class SeenSurface:
    """Where cameras see N points of a surface: positions (N, 3) in meters, unit normals (N, 3) and
    weights (N,)."""

    position: np.ndarray
    normal: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class RecordedTake:
    """What was recorded: places of landmarks on the head, which are reliable, landmarks by
    timestep, images, masks, and whether the world of the cameras is in meters."""

    places: SurfacePoints
    reliable: np.ndarray
    landmarks: Mapping[int, TimestepLandmarks]
    images: Images
    masks: Images = no_masks
    metric: bool = False


def excerpt(
    fit: HeadFit, take: RecordedTake, timesteps: Sequence[int]
) -> tuple[HeadFit, RecordedTake]:
    """The fit and the take at some timesteps."""
    own = replace(fit, parameters={t: fit.parameters[t] for t in timesteps})
    return own, replace(take, landmarks={t: take.landmarks[t] for t in timesteps})


def surface_points(head: HeadModel, count: int) -> SurfacePoints:
    """Centers of about `count` triangles, spread evenly over the area of the head's large connected
    parts."""
    vertices, faces = head.model.v_template, head.model.faces
    large = large_parts(head.model)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.cumsum(np.where(large, np.linalg.norm(np.cross(b - a, c - a), axis=1), 0.0))
    face = np.unique(np.searchsorted(area, (np.arange(count) + 0.5) / count * area[-1]))
    return SurfacePoints(face, np.full((len(face), 3), 1 / 3))


def large_parts(model: FlameModel) -> np.ndarray:
    """(F,) bool: triangles of connected parts larger than eyeballs and teeth."""
    vertices, faces = model.v_template, model.faces
    numbers, part = np.unique(connected_parts(len(vertices), faces), return_inverse=True)
    extent = np.array(
        [np.ptp(vertices[part == number], axis=0).max() for number in range(len(numbers))]
    )
    return np.asarray((extent > MIN_PART_SHARE * np.ptp(vertices, axis=0).max())[part[faces[:, 0]]])


def seen_surface(
    fit: HeadFit,
    timestep: int,
    points: SurfacePoints,
    images: Sequence[tuple[Camera, np.ndarray]],
    sweep: Sweep,
    visible: VisiblePoints,
) -> SeenSurface:
    """Where the images show the surface near the fitted head, along its normals; weight 0 for what
    they do not show.

    `visible` is filled with what is in sight from where, and read for directions that are in it
    already.
    """
    faces = fit.head.model.faces
    vertices = posed_mesh(fit, fit.parameters[timestep])
    at, normals = points.on(vertices, faces), points.on(vertex_normals(vertices, faces), faces)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    cameras = [fit.to_capture.camera(camera) for camera, _ in images]
    views = [
        gray_view(camera, image, at.mean(0), sweep.spacing)
        for camera, (_, image) in zip(cameras, images, strict=True)
    ]
    turn, cosines = head_rotation(fit.parameters[timestep]), []
    for camera in cameras:
        direction = (camera.position - at.mean(0)) @ turn
        key = tuple(
            np.round(DIRECTIONS * direction / np.linalg.norm(direction)).astype(int).tolist()
        )
        if key not in visible:
            visible[key] = in_sight(camera, vertices, faces, at)
        cosines.append(facing(camera, at, normals) * visible[key])
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
    """The surface with what masks say about points at the head's outline; near (N,) bool: points
    that this is for."""
    vertices, faces = posed_mesh(fit, fit.parameters[timestep]), fit.head.model.faces
    at = points.on(vertices, faces)
    total, moved = seen.weight.copy(), seen.weight * ((seen.position - at) * seen.normal).sum(1)
    for camera, mask in masks:
        posed = fit.to_capture.camera(camera)
        offset, known = outline_offsets(
            posed, mask, vertices, faces, at[near], seen.normal[near], reach
        )
        total[near] += POINT_SHARE * known
        moved[near] += POINT_SHARE * offset
    mean = moved / np.maximum(total, 1e-9)
    return replace(seen, position=at + mean[:, None] * seen.normal, weight=total)


def outlines_agree(
    fit: HeadFit, take: RecordedTake, points: SurfacePoints, near: np.ndarray, reach: float
) -> bool:
    """Whether the masks end where the surface in the images does; False without masks. reach:
    meters searched."""
    model, distances = fit.head.model, [np.zeros(0)]
    for timestep, parameters in fit.parameters.items():
        vertices = posed_mesh(fit, parameters)
        at, normals = (
            points.on(values, model.faces)[near]
            for values in (vertices, vertex_normals(vertices, model.faces))
        )
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        for camera, mask in take.masks(timestep):
            posed = fit.to_capture.camera(camera)
            offset, known = outline_offsets(posed, mask, vertices, model.faces, at, normals, reach)
            distances.append(np.abs(offset[known]))
    every = np.concatenate(distances)
    return len(every) >= MIN_OUTLINE_POINTS and float(np.median(every)) < MAX_OUTLINE_DISTANCE_M


def near_landmarks(head: HeadModel, points: SurfacePoints, take: RecordedTake) -> np.ndarray:
    """(N,) bool: points within OUTLINE_RADIUS_M of a reliable landmark."""
    from scipy.spatial import cKDTree

    template, faces = head.model.v_template, head.model.faces
    distance, _ = cKDTree(take.places.on(template, faces)[take.reliable]).query(
        points.on(template, faces)
    )
    return np.asarray(distance < OUTLINE_RADIUS_M)
