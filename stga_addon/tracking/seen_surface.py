"""Where images and masks show the surface of a fitted head."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ..capture.camera import Camera
from ..capture.mesh_geometry import connected_parts, rasterize, vertex_normals
from ..flame.model import FlameModel
from .fit import HeadFit, TimestepLandmarks
from .head_model import HeadModel
from .photo_consistency import Sweep, facing, gray_view, in_sight, surface_offsets
from .posed_points import SurfacePoints, head_rotation
from .write_capture import posed_mesh

POINT_SHARE = 0.25
"""Weight of a surface point: patches of neighboring points share most of their pixels."""
DIRECTIONS = 6
"""Steps of a direction's coordinates, about 10°: in one step, a head hides the same of itself."""
MIN_PART_SHARE = 0.33
"""Connected parts smaller than this share of the head (eyeballs, teeth) have no surface points."""

MAX_OUTLINE_DISTANCE_M = 0.0005
"""Median distance of the masks' outlines from the surface in the images, beyond which they are not
those of the skin: mattes are often a pixel or two too wide, and hair hangs over faces."""
MIN_OUTLINE_POINTS = 100
OUTLINE_RADIUS_M = 0.01
"""Distance from the landmarks beyond which outlines are those of hair, ears and clothes."""
MAX_COSINE = 0.25
"""Of the angle between normal and camera: points within 15° of the outline move it."""
RIM_COSINE = 0.5  # The same of a triangle: those farther from the outline are not drawn
PICTURE_SIDE, MAX_ENLARGEMENT = 600, 2
"""The mesh's own mask is drawn with about so many pixels, since it has no soft edge."""
SAMPLES_PER_PIXEL = 4
MAX_REACH_PX = 40.0
"""Pixels on either side of a point in which an edge is looked for; a close camera's are many."""


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
    """Centers of about `count` triangles, spread evenly over the area of the large parts."""
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
    extent = [np.ptp(vertices[part == number], axis=0).max() for number in range(len(numbers))]
    large = np.array(extent) > MIN_PART_SHARE * np.ptp(vertices, axis=0).max()
    return np.asarray(large[part[faces[:, 0]]])


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
    turn, cosines, views = head_rotation(fit.parameters[timestep]), [], []
    for camera, (_, image) in zip(cameras, images, strict=True):
        views.append(gray_view(camera, image, at.mean(0), sweep.spacing))
        direction = (camera.position - at.mean(0)) @ turn
        rounded = np.round(DIRECTIONS * direction / np.linalg.norm(direction))
        key = tuple(rounded.astype(int).tolist())
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
    """The surface with what masks say about points at the outline; near (N,) bool: of which."""
    vertices, faces = posed_mesh(fit, fit.parameters[timestep]), fit.head.model.faces
    at = points.on(vertices, faces)
    total, moved = seen.weight.copy(), seen.weight * ((seen.position - at) * seen.normal).sum(1)
    for camera, mask in masks:
        posed = fit.to_capture.camera(camera)
        places = at[near], seen.normal[near]
        offset, known = outline_offsets(posed, mask, vertices, faces, *places, reach)
        total[near] += POINT_SHARE * known
        moved[near] += POINT_SHARE * offset
    mean = moved / np.maximum(total, 1e-9)
    return replace(seen, position=at + mean[:, None] * seen.normal, weight=total)


def outlines_agree(
    fit: HeadFit, take: RecordedTake, points: SurfacePoints, near: np.ndarray, reach: float
) -> bool:
    """Whether masks, if any, end where the surface in the images does; reach: meters searched."""
    model, distances = fit.head.model, [np.zeros(0)]
    for timestep, parameters in fit.parameters.items():
        vertices = posed_mesh(fit, parameters)
        both = vertices, vertex_normals(vertices, model.faces)
        at, normals = (points.on(values, model.faces)[near] for values in both)
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
    landmarks = take.places.on(template, faces)[take.reliable]
    distance, _ = cKDTree(landmarks).query(points.on(template, faces))
    return np.asarray(distance < OUTLINE_RADIUS_M)


def outline_offsets(
    camera: Camera, mask: np.ndarray, vertices: np.ndarray, faces: np.ndarray, points: np.ndarray,
    normals: np.ndarray, reach: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Meters (N,) by which points would have to move along their normals for the mesh to fill the
    mask; and (N,) bool for which points this is known: those near the outline of the mesh, with one
    edge of the mask near them.

    mask (H, W) uint8, 255 inside; points on the mesh and unit normals (N, 3); reach: the largest
    move, in meters. Both outlines are crossed along the projected normal, so that a point need not
    lie on the outline itself.
    """
    found, known = np.zeros(len(points)), np.zeros(len(points), bool)
    rows = np.flatnonzero(np.abs(facing(camera, points, normals)) < MAX_COSINE)
    begin, depth = camera.project(points[rows])
    end, _ = camera.project(points[rows] + 1e-3 * normals[rows])
    along = 1e3 * (end - begin)  # pixels per meter
    length = np.linalg.norm(along, axis=1)
    usable = (depth > 0) & (length * reach > 1)
    if not usable.any():
        return found, known
    rows, begin, along, length = rows[usable], begin[usable], along[usable], length[usable]
    pixels = min(float(length.max()) * reach, MAX_REACH_PX)
    steps = np.linspace(-pixels, pixels, 2 * math.ceil(SAMPLES_PER_PIXEL * pixels) + 1)
    at = begin[:, None] + steps[:, None] * (along / length[:, None])[:, None]
    factor = int(np.clip(PICTURE_SIDE / max(camera.width, camera.height), 1, MAX_ENLARGEMENT))
    rim = _rim(camera, vertices, faces, begin, pixels)
    drawn = (rasterize(vertices, rim, camera.scaled(factor))[0] >= 0).astype(np.float32)
    wanted, own = _edge(mask / np.float32(255), at, steps), _last_edge(drawn, factor * at, steps)
    move = (wanted - own) / length
    inside = np.abs(np.nan_to_num(move, nan=np.inf)) <= reach
    found[rows[inside]], known[rows[inside]] = move[inside], True
    return found, known


def _rim(
    camera: Camera, vertices: np.ndarray, faces: np.ndarray, around: np.ndarray, pixels: float
) -> np.ndarray:
    """Triangles (R, 3) of the outline near pixels `around` (N, 2): few of the mesh's are drawn."""
    from scipy.spatial import cKDTree

    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    rows = np.flatnonzero(np.abs(facing(camera, (a + b + c) / 3, normal)) < RIM_COSINE)
    corners = camera.project(vertices)[0][faces[rows]]
    center = corners.mean(1)
    radius = np.linalg.norm(corners - center[:, None], axis=2).max(1)
    distance, _ = cKDTree(around).query(np.nan_to_num(center, nan=1e9))
    return np.asarray(faces[rows[distance < pixels + radius]])


def _edge(mask: np.ndarray, at: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Step (N,) at which lines `at` (N, S, 2) leave a mask (H, W), 0 to 1, once; else NaN."""
    level = _sampled(mask, at)
    crossings = (level[:, :-1] > 0) != (level[:, 1:] > 0)
    return _crossed(level, crossings.argmax(1), steps, (crossings.sum(1) == 1) & (level[:, 0] > 0))


def _last_edge(mask: np.ndarray, at: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """As `_edge`, of a mask with holes: the last step; NaN where a line ends inside."""
    level = _sampled(mask, at)
    leaves = (level[:, :-1] > 0) & (level[:, 1:] <= 0)
    last = leaves.shape[1] - 1 - leaves[:, ::-1].argmax(1)
    return _crossed(level, last, steps, leaves.any(1) & (level[:, -1] <= 0))


def _sampled(mask: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Mask (H, W) at pixels (N, S, 2), minus a half."""
    from scipy.ndimage import map_coordinates

    places = [at[..., 1] - 0.5, at[..., 0] - 0.5]
    return np.asarray(map_coordinates(mask, places, np.float32, order=1, mode="nearest") - 0.5)


def _crossed(
    level: np.ndarray, last: np.ndarray, steps: np.ndarray, valid: np.ndarray
) -> np.ndarray:
    """Step (N,) at which levels (N, S) pass zero after `last` (N,); NaN where not valid."""
    row = np.arange(len(level))
    before, after = level[row, last], level[row, last + 1]
    share = before / np.where(valid, before - after, 1)
    return np.where(valid, steps[last] + share * (steps[1] - steps[0]), np.nan)
