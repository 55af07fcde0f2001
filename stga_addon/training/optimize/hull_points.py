"""Splats for what the mesh does not cover: hair, shoulders, clothes."""

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.spatial import cKDTree

from ...avatar.embedding import face_frames, to_local
from ...avatar.lattice import lattice_weights
from ...avatar.splats import Splats
from ...capture.camera import Camera
from ...capture.images import read_image, read_mask
from ...capture.model import Capture, View

VOXEL = 0.004
"""Metres between seeds, on a mesh of a head's size."""
FINEST = 1 / 200
"""Seeds are at least this share of the mesh's diagonal apart: a mesh in millimetres must not fill the memory."""
CLEARANCE = 0.006
"""Metres: nearer to the mesh than this, the mesh's own splats cover it."""
MARGIN = 0.25
"""How far around the mesh's bounding box to look, as a share of its diagonal."""
WITNESSES = 0.25
"""A voxel counts if at least this share of the views sees it at all (and all that do have it inside their mask)."""
EXPOSED = 0.125
"""... and if it shows beside the mesh in at least this share of the views. Without this, the hull's phantom volumes
behind the head, which nothing contradicts, become floaters in every other view."""
TRACKING_ERROR = 0.01
"""How far, as a share of the image height, a tracked silhouette may be off the mask."""


def hull_points(capture: Capture, views: Sequence[View], convention: str, sh_degree: int) -> Splats:
    """Loose splats on the shell of the visual hull of one timestep, outside the mesh.

    views: all of one timestep. The hull is carved on a grid of VOXEL metres (coarser on a larger mesh) from the masks
    (or, without masks, from what differs from white); each seed is bound to the nearest triangle, so it follows the
    head.
    """
    mesh = capture.mesh(views[0].timestep)
    voxel = max(VOXEL, FINEST * float(np.linalg.norm(np.ptp(mesh, axis=0))))
    points = _shell(mesh, capture.faces, views, voxel)
    distance, face = _nearest_triangle(points, mesh, capture.faces)
    outside = distance > CLEARANCE
    world = _seeds(points[outside], voxel, sh_degree)
    frames = face_frames(mesh, capture.faces, capture.neutral, convention)
    return to_local(world, frames, face[outside])


def _nearest_triangle(points: np.ndarray, mesh: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (N,) to the mesh and nearest triangle (N,), by a lattice of samples on every triangle."""
    weights = lattice_weights(4, inset=0.02)
    samples = np.einsum("pc,fci->fpi", weights, mesh[faces]).reshape(-1, 3)
    distance, nearest = cKDTree(samples).query(points)
    return distance, nearest // len(weights)


def _shell(mesh: np.ndarray, faces: np.ndarray, views: Sequence[View], voxel: float) -> np.ndarray:
    """Grid points (N, 3) on the surface of the visual hull that show beside the mesh."""
    low, high = mesh.min(0), mesh.max(0)
    margin = MARGIN * np.linalg.norm(high - low)
    axes = [np.arange(a - margin, b + margin, voxel) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = np.ones(len(grid), bool)
    witnesses, exposed = np.zeros(len(grid), np.int32), np.zeros(len(grid), np.int32)
    for view in views:
        mask, beside = _foreground(view), ~_silhouette(mesh, faces, view.camera)
        alive = np.flatnonzero(inside)
        x, y, seen = _pixels(grid[alive], view.camera)
        alive, x, y = alive[seen], x[seen], y[seen]
        witnesses[alive] += 1
        exposed[alive] += beside[y, x]
        inside[alive] = mask[y, x]
    solid = (inside & (witnesses >= max(2, WITNESSES * len(views)))).reshape([len(a) for a in axes])
    surface = (solid & ~binary_erosion(solid)).ravel()
    return np.asarray(grid[surface & (exposed >= np.maximum(1, EXPOSED * len(views)))])


def _silhouette(mesh: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) bool: pixels that the mesh covers, or that a small tracking error would make it cover."""
    pixels, depth = camera.project(mesh)
    picture = Image.new("1", (camera.width, camera.height))
    draw = ImageDraw.Draw(picture)
    for corners in pixels[faces[(depth > 0.01)[faces].all(1)]].reshape(-1, 6).tolist():
        draw.polygon(corners, fill=1)
    return np.asarray(binary_dilation(np.asarray(picture), iterations=max(1, round(TRACKING_ERROR * camera.height))))


def _foreground(view: View) -> np.ndarray:
    mask = read_mask(view)
    if mask is not None:
        return np.asarray(mask > 127)
    return np.asarray((read_image(view) < 247).any(axis=2))


def _pixels(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel columns and rows of world points (N, 3), and which of them lie in the image."""
    pixels, depth = camera.project(points)
    x, y = np.floor(pixels).T
    seen = (depth > 0.01) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    return np.where(seen, x, 0).astype(int), np.where(seen, y, 0).astype(int), seen


def _seeds(points: np.ndarray, voxel: float, sh_degree: int) -> Splats:
    n = len(points)
    return Splats(
        xyz=points.astype(np.float32),
        rotation=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        log_scale=np.full((n, 3), np.log(voxel / 2), np.float32),
        opacity=np.zeros(n, np.float32),
        sh=np.zeros((n, (sh_degree + 1) ** 2, 3), np.float32),
        face=np.zeros(n, np.int32),
        unbound=np.ones(n, bool),
    )
