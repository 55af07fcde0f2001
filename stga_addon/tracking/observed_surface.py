"""Surface of a fitted head as images and masks show it."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..capture.camera import Camera
from ..capture.mesh_geometry import (
    connected_parts,
    facing,
    pixels_of,
    rasterize,
    triangle_normals,
    vertex_normals,
)
from ..flame.model import FlameModel
from ..flame.quaternions import unit
from .fit import HeadFit, Pictures, RecordedTake, posed_mesh
from .head_model import HeadModel
from .posed_points import SurfacePoints, head_rotation

PATCH_SAMPLES = 9
"""Samples along each side of a patch."""
MAX_CAMERAS = 6
"""Cameras that a patch is compared in: those that face it most squarely."""
MIN_COSINE = 0.35
"""Cosine between normal and camera below which a patch is too foreshortened (70°)."""
MIN_CORRELATION = 0.5
"""Correlation of two cameras' patches that counts."""
NOISE_LEVELS = 2.0
"""Standard deviation of noise, of 255: patches of less contrast do not correlate."""
OCCLUSION_M = 0.004
"""A point this far behind the nearest surface is hidden."""
DEPTH_IMAGE_SIDE = 300
"""Larger side in pixels of the depth image that shows which points are hidden."""
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
"""Weights of red, green and blue in the luma of ITU-R BT.601."""
POINT_FRACTION = 0.25
"""Weight of a surface point, whose patch has most pixels in common with its neighbors."""
DIRECTIONS = 6
"""Steps of a direction's coordinates, about 10°."""
MIN_PART_FRACTION = 0.33
"""Connected parts smaller than this fraction of the head (eyeballs, teeth) have no surface
points."""
MAX_OUTLINE_DISTANCE_M = 0.0005
"""Median distance of the masks' outlines from the surface in the images, beyond which they are not
those of the skin: mattes are often a pixel or two too wide, and hair hangs over faces."""
MIN_OUTLINE_POINTS = 100
"""Points of an outline without which it is not used."""
OUTLINE_RADIUS_M = 0.01
"""Distance from the landmarks beyond which outlines are those of hair, ears and clothes."""
MAX_COSINE = 0.25
"""Cosine between normal and camera up to which a point moves the outline (15°)."""
RIM_COSINE = 0.5
"""The same for a triangle: triangles farther from the outline are not drawn."""
PICTURE_SIDE = 600
"""Side in pixels with which the mesh's mask is drawn, since it has no soft edge."""
MAX_ENLARGEMENT = 2
"""Largest factor by which that enlarges an image."""
SAMPLES_PER_PIXEL = 4
"""Samples along the line on which an edge is looked for."""
MAX_REACH_PX = 40.0
"""Distance on either side of a point in which an edge is looked for; a close camera's pixels are
many."""


@dataclass(frozen=True)
class Sweep:
    """Offsets in meters, −reach to +reach, a step apart; a patch's samples are `spacing` apart."""

    reach: float
    step: float
    spacing: float

    @property
    def offsets(self) -> np.ndarray:
        count = round(self.reach / self.step)
        return self.step * np.arange(-count, count + 1)


@dataclass(frozen=True)
class SurfaceSearch:
    """Surface points (N) that are looked for, by a sweep; near (N,) bool: points near which masks
    are evidence."""

    points: SurfacePoints
    near: np.ndarray
    sweep: Sweep


class PosedSurface(NamedTuple):
    """A mesh at a timestep: vertices (V, 3) meters and faces (F, 3); N points on it, and their unit
    normals, (N, 3)."""

    vertices: np.ndarray
    faces: np.ndarray
    points: np.ndarray
    normals: np.ndarray


def gray_view(
    camera: Camera, image: np.ndarray, center: np.ndarray, spacing: float
) -> tuple[Camera, np.ndarray]:
    """Camera and luma (H, W) float32, 0 to 255, of an image (H, W, 3) uint8, reduced as far as its
    pixels at `center` (3,) stay smaller than `spacing` meters."""
    pixel = float(camera.project(center[None])[1][0]) / camera.fl_x
    factor = int(np.clip(spacing / max(pixel, 1e-9), 1, min(image.shape[:2])))
    height, width = (side // factor for side in image.shape[:2])
    gray = image[: height * factor, : width * factor].astype(np.float32) @ LUMA
    small = gray.reshape(height, factor, width, factor).mean((1, 3))
    intrinsics = {name: getattr(camera, name) / factor for name in ("fl_x", "fl_y", "cx", "cy")}
    return replace(camera, width=width, height=height, **intrinsics), small


def in_sight(
    camera: Camera, vertices: np.ndarray, faces: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """(N,) bool: points (N, 3) that the mesh does not hide, by a depth image of reduced size."""
    small = camera.scaled(min(1.0, DEPTH_IMAGE_SIDE / max(camera.width, camera.height)))
    triangle, inside = rasterize(vertices, faces, small)
    covered = triangle >= 0
    closeness = np.zeros(triangle.shape)
    corners = faces[triangle[covered]]
    closeness[covered] = (inside[covered] / small.project(vertices)[1][corners]).sum(1)
    x, y, in_image = pixels_of(points, small)
    return in_image & (closeness[y, x] * (small.project(points)[1] - OCCLUSION_M) < 1)


def surface_offsets(
    views: Pictures, cosines: np.ndarray, points: np.ndarray, normals: np.ndarray, sweep: Sweep
) -> tuple[np.ndarray, np.ndarray]:
    """Offset (N,) in meters along the normals at which the images agree best, and their correlation
    (N,) there.

    views: of `gray_view`; points, normals (N, 3); cosines (C, N): `facing`, 0 for what a camera
    does not see. The correlation is 0 where fewer than two cameras see a point, where they agree
    too little, and where no offset is a maximum.
    """
    usable = np.where(cosines > MIN_COSINE, cosines, 0.0)
    worst = np.zeros(len(points))
    if len(views) > MAX_CAMERAS:
        worst = -np.sort(-usable, axis=0)[: MAX_CAMERAS + 1][-1]
    usable = np.where(usable > worst, usable, 0.0)
    # samples (N, P, 3) in the tangent planes; weights (P,), largest at the center
    axis = np.where(np.abs(normals[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    across = unit(np.cross(axis, normals))
    steps = np.arange(PATCH_SAMPLES) - (PATCH_SAMPLES - 1) / 2
    u, v = (part.ravel() for part in np.meshgrid(steps, steps, indexing="ij"))
    away = u[:, None] * across[:, None] + v[:, None] * np.cross(normals, across)[:, None]
    patches = points[:, None] + sweep.spacing * away
    window = np.exp(-(u**2 + v**2) / (2 * (0.3 * PATCH_SAMPLES) ** 2))
    window = (window / window.sum()).astype(np.float32)
    offsets = sweep.offsets.astype(np.float32)
    total = np.zeros((len(points), len(offsets), len(window)), np.float32)
    alone = np.zeros(total.shape[:2], np.float32)  # what patches add by agreeing with themselves
    for view, cosine in zip(views, usable, strict=True):
        rows = np.flatnonzero(cosine)
        if len(rows):
            weight = cosine[rows, None].astype(np.float32)
            patch = _patch_levels(*view, patches[rows], normals[rows], offsets)
            patch = (patch - (patch @ window)[..., None]) * np.sqrt(window)
            patch = patch / np.sqrt((patch**2).sum(-1, keepdims=True) + NOISE_LEVELS**2)
            total[rows] += weight[..., None] * patch
            alone[rows] += weight**2 * (patch**2).sum(2)
    pairs = np.maximum(usable.sum(0) ** 2 - (usable**2).sum(0), 1e-6)
    # the mean of all pairs of patches, weighted by the cosines of both cameras
    correlation = ((total**2).sum(2) - alone) / pairs[:, None]
    rows = np.arange(len(points))
    best = correlation.argmax(1)
    middle = np.clip(best, 1, len(offsets) - 2)
    before, at, after = (correlation[rows, middle + shift] for shift in (-1, 0, 1))
    bend = np.maximum(2 * at - before - after, 1e-6)
    peak = np.clip((after - before) / (2 * bend), -0.5, 0.5)
    vertex = sweep.offsets[middle] + sweep.step * peak
    return vertex, np.where((best == middle) & (at > MIN_CORRELATION), at, 0.0)


def _patch_levels(
    camera: Camera, image: np.ndarray, patches: np.ndarray, normals: np.ndarray, offsets: np.ndarray
) -> np.ndarray:
    """Levels (M, D, P) of patches (M, P, 3) moved along their normals by offsets (D,)."""
    import cv2

    turn = camera.rotation
    local = (patches @ turn.T + camera.translation).astype(np.float32)
    moved = offsets[None, :, None] * (normals @ turn.T).astype(np.float32)[:, None, :]  # (M, D, 3)
    x, y, depth = (local[:, None, :, axis] + moved[..., axis : axis + 1] for axis in range(3))
    x = x / depth * np.float32(camera.fl_x) + np.float32(camera.cx - 0.5)
    y = y / depth * np.float32(camera.fl_y) + np.float32(camera.cy - 0.5)
    found = np.empty(x.shape, np.float32)
    # Coordinates apart, unlike `appearance.sampled`: to pair them takes five times as long as to
    # look them up.
    for row in range(len(x)):
        cv2.remap(image, x[row], y[row], cv2.INTER_LINEAR, found[row], cv2.BORDER_REPLICATE)
    return found


VisiblePoints = dict[tuple[int, ...], np.ndarray]
"""Direction from the head, rounded -> (N,) bool: points that are not hidden from there."""


@dataclass(frozen=True)
class ObservedSurface:
    """N visible points of a surface: positions (N, 3) in meters, unit normals (N, 3) and weights
    (N,)."""

    position: np.ndarray
    normal: np.ndarray
    weight: np.ndarray


def surface_points(head: HeadModel, count: int) -> SurfacePoints:
    """Centers of about `count` triangles, spread evenly over the area of the large parts."""
    faces = head.model.faces
    large = large_parts(head.model)
    area = np.linalg.norm(triangle_normals(head.model.v_template[faces]), axis=1)
    area = np.cumsum(np.where(large, area, 0.0))
    face = np.unique(np.searchsorted(area, (np.arange(count) + 0.5) / count * area[-1]))
    return SurfacePoints(face, np.full((len(face), 3), 1 / 3))


def large_parts(model: FlameModel) -> np.ndarray:
    """(F,) bool: triangles of connected parts larger than eyeballs and teeth."""
    vertices = model.v_template
    faces = model.faces
    numbers, part = np.unique(connected_parts(len(vertices), faces), return_inverse=True)
    extent = [np.ptp(vertices[part == number], axis=0).max() for number in range(len(numbers))]
    large = np.array(extent) > MIN_PART_FRACTION * np.ptp(vertices, axis=0).max()
    return large[part[faces[:, 0]]]


def observed_surface(
    fit: HeadFit,
    timestep: int,
    sought: SurfaceSearch,
    images: Pictures,
    masks: Pictures,
    visible: VisiblePoints,
) -> ObservedSurface:
    """Where images show the surface near the fitted head, along its normals, and masks its outline;
    weight 0 for what they do not show.

    `visible` is filled with what is in sight from where, and read for directions that are in it
    already.
    """
    surface = _posed(fit, timestep, sought.points)
    at = surface.points
    normals = surface.normals
    near = sought.near
    sweep = sought.sweep
    turn = head_rotation(fit.parameters[timestep])
    cosines = []
    views = []
    for recording, image in images:
        camera = fit.to_capture.camera(recording)
        views.append(gray_view(camera, image, at.mean(0), sweep.spacing))
        key = rounded_direction((camera.position - at.mean(0)) @ turn, DIRECTIONS)
        if key not in visible:
            visible[key] = in_sight(camera, surface.vertices, surface.faces, at)
        cosines.append(facing(camera, at, normals) * visible[key])
    offset, correlation = surface_offsets(views, np.stack(cosines), at, normals, sweep)
    weight = POINT_FRACTION * correlation
    moved = weight * offset
    close = surface._replace(points=at[near], normals=normals[near])
    for recording, mask in masks:
        camera = fit.to_capture.camera(recording)
        offset, known = outline_offsets(camera, mask, close, sweep.reach)
        weight[near] += POINT_FRACTION * known
        moved[near] += POINT_FRACTION * offset
    mean = moved / np.maximum(weight, 1e-9)
    return ObservedSurface(at + mean[:, None] * normals, normals, weight)


def rounded_direction(direction: np.ndarray, steps: int) -> tuple[int, ...]:
    """A direction (3,), rounded to steps within which a head hides the same parts of itself."""
    return tuple(np.round(steps * direction / np.linalg.norm(direction)).astype(int).tolist())


def _posed(fit: HeadFit, timestep: int, points: SurfacePoints) -> PosedSurface:
    vertices = posed_mesh(fit, fit.parameters[timestep])
    faces = fit.head.model.faces
    normals = unit(points.on(vertex_normals(vertices, faces), faces))
    return PosedSurface(vertices, faces, points.on(vertices, faces), normals)


def outlines_agree(fit: HeadFit, take: RecordedTake, sought: SurfaceSearch) -> bool:
    """Whether masks, if any, end where the surface in the images does."""
    distances = [np.zeros(0)]
    chosen = sought.points[sought.near]
    reach = sought.sweep.reach
    for timestep in fit.parameters:
        surface = _posed(fit, timestep, chosen)
        for recording, mask in take.masks(timestep):
            camera = fit.to_capture.camera(recording)
            offset, known = outline_offsets(camera, mask, surface, reach)
            distances.append(np.abs(offset[known]))
    every = np.concatenate(distances)
    return len(every) >= MIN_OUTLINE_POINTS and float(np.median(every)) < MAX_OUTLINE_DISTANCE_M


def near_landmarks(head: HeadModel, points: SurfacePoints, take: RecordedTake) -> np.ndarray:
    """(N,) bool: points within OUTLINE_RADIUS_M of a reliable landmark."""
    from scipy.spatial import cKDTree

    template = head.model.v_template
    faces = head.model.faces
    landmarks = take.places.on(template, faces)[take.reliable]
    distance, _ = cKDTree(landmarks).query(points.on(template, faces))
    return distance < OUTLINE_RADIUS_M


def outline_offsets(
    camera: Camera, mask: np.ndarray, surface: PosedSurface, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Meters (N,) by which points would have to move along their normals for the mesh to fill the
    mask; and (N,) bool for which points this is known: those near the outline of the mesh, with one
    edge of the mask near them.

    mask (H, W) uint8, 255 inside; reach: the largest move, in meters. Both outlines are crossed
    along the projected normal, so that a point need not lie on the outline itself.
    """
    from scipy.spatial import cKDTree

    points = surface.points
    normals = surface.normals
    vertices = surface.vertices
    faces = surface.faces
    found = np.zeros(len(points))
    known = np.zeros(len(points), bool)
    rows = np.flatnonzero(np.abs(facing(camera, points, normals)) < MAX_COSINE)
    begin, depth = camera.project(points[rows])
    end, _ = camera.project(points[rows] + 1e-3 * normals[rows])
    along = 1e3 * (end - begin)  # pixels per meter
    length = np.linalg.norm(along, axis=1)
    usable = (depth > 0) & (length * reach > 1)
    if not usable.any():
        return found, known
    rows = rows[usable]
    begin = begin[usable]
    along = along[usable]
    length = length[usable]
    pixels = min(float(length.max()) * reach, MAX_REACH_PX)
    steps = np.linspace(-pixels, pixels, 2 * math.ceil(SAMPLES_PER_PIXEL * pixels) + 1)
    at = begin[:, None] + steps[:, None] * (along / length[:, None])[:, None]
    factor = int(np.clip(PICTURE_SIDE / max(camera.width, camera.height), 1, MAX_ENLARGEMENT))
    # of the mesh, few triangles are drawn: those of the outline near the points
    triangles = vertices[faces]
    normal = unit(triangle_normals(triangles), 1e-20)
    rim = faces[np.abs(facing(camera, triangles.mean(1), normal)) < RIM_COSINE]
    corners = camera.project(vertices)[0][rim]
    center = corners.mean(1)
    radius = np.linalg.norm(corners - center[:, None], axis=2).max(1)
    distance, _ = cKDTree(begin).query(np.nan_to_num(center, nan=1e9))
    rim = rim[distance < pixels + radius]
    drawn = (rasterize(vertices, rim, camera.scaled(factor))[0] >= 0).astype(np.float32)
    # the mask's edge, where there is one; the last one of the drawn mesh, which has holes
    level = _sampled(mask / np.float32(255), at)
    coverage = _sampled(drawn, factor * at)
    crossings = (level[:, :-1] > 0) != (level[:, 1:] > 0)
    once = (crossings.sum(1) == 1) & (level[:, 0] > 0)
    leaves = (coverage[:, :-1] > 0) & (coverage[:, 1:] <= 0)
    last = leaves.shape[1] - 1 - leaves[:, ::-1].argmax(1)
    move = _crossed(level, crossings.argmax(1), steps, once)
    move = (move - _crossed(coverage, last, steps, leaves.any(1) & (coverage[:, -1] <= 0))) / length
    inside = np.abs(np.nan_to_num(move, nan=np.inf)) <= reach
    found[rows[inside]] = move[inside]
    known[rows[inside]] = True
    return found, known


def _sampled(mask: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Mask (H, W) at pixels (N, S, 2), minus a half."""
    from scipy.ndimage import map_coordinates

    places = [at[..., 1] - 0.5, at[..., 0] - 0.5]
    return map_coordinates(mask, places, np.float32, order=1, mode="nearest") - 0.5


def _crossed(
    level: np.ndarray, last: np.ndarray, steps: np.ndarray, valid: np.ndarray
) -> np.ndarray:
    """Step (N,) at which levels (N, S) pass zero after `last` (N,); NaN where not valid."""
    row = np.arange(len(level))
    before = level[row, last]
    after = level[row, last + 1]
    fraction = before / np.where(valid, before - after, 1)
    return np.where(valid, steps[last] + fraction * (steps[1] - steps[0]), np.nan)
