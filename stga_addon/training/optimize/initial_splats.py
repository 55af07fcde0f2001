"""The splats that training starts with: a lattice on the mesh, colored as the images show it, and
visual-hull points for what the mesh does not cover (hair, shoulders, clothes); a flat layer for a
single camera."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from ...avatar.embedding import face_frames, to_local, to_world
from ...avatar.lattice import lattice_splats, lattice_weights
from ...avatar.splats import SH_C0, Splats, in_world, joined
from ...capture.camera import Camera
from ...capture.image_colors import colors_within, triangle_colors
from ...capture.images import read_image
from ...capture.mesh_geometry import pixels_of
from ...capture.model import Capture, View
from ...capture.visual_hull import (
    FEW_CAMERAS,
    foreground_of,
    hull_surface,
    voxel_size,
    wide_silhouette,
)
from ...flame.model import faces_within, torso_faces
from ...flame.parts import PARTS
from ...flame.sequence import below_neck
from ...tracking.folder import read_torso_points
from ..settings import TrainingSettings
from .semantic_regions import Region, head_regions

MIN_MESH_DISTANCE_M = 0.006
"""Points nearer to the mesh are covered by the mesh's own splats."""
CONTINUED_FRACTION = 0.4
"""Length by which a torso is continued beyond the image of a single camera, as a fraction of the
image's width."""
CONTINUED_OPACITY = 3.0
"""Logit of these splats' opacity, which may never be trained."""
POINT_COPIES = 3
"""Splats for each of the observed points."""
POINT_SPREAD = 0.5
"""Standard deviation in voxels of these splats from their point."""


def initial_splats(
    capture: Capture, settings: TrainingSettings, has_long_hair: bool = False
) -> Splats:
    """The lattice on the neutral mesh and, if the settings say so, visual-hull points of the first
    training timestep (`flat_points` where a single camera shows it). has_long_hair: as `Surface`
    finds it."""
    convention = settings.convention
    degree = settings.sh_degree
    views = capture.views["train"]
    order = settings.first_lattice_order(len(capture.faces))
    lattice = lattice_splats(capture.neutral, capture.faces, order, degree, convention=convention)
    masks = {} if capture.flame is None else capture.flame.model.masks
    for name in PARTS:
        if name in masks and not getattr(settings, name):
            lattice = lattice.rows(~faces_within(capture.faces, masks[name])[lattice.face])
    lattice.sh[:, 0] = (triangle_colors(capture, views)[lattice.face] - 0.5) / SH_C0
    parts = [lattice]
    first = [view for view in views if view.timestep == views[0].timestep]
    if settings.hull_points and len(first) == 1:
        parts.append(
            flat_points(capture, first[0], convention, degree, settings.torso, has_long_hair)
        )
    elif settings.hull_points:
        parts.append(visual_hull_points(capture, first, convention, degree, settings.torso))
    return joined(parts)


def unseen_fraction(capture: Capture, convention: str, splats: Splats) -> np.ndarray:
    """Fraction (N,) of the first training timestep's cameras in whose image an unbound splat does
    not lie.

    0 for bound splats. A visual-hull point outside of most images is held by few masks only, and
    often in the air.
    """
    fraction = np.zeros(len(splats), np.float32)
    free = np.flatnonzero(splats.unbound)
    if not len(free):
        return fraction
    first = capture.views["train"][0].timestep
    views = [view for view in capture.views["train"] if view.timestep == first]
    frames = face_frames(capture.mesh(first), capture.faces, capture.neutral, convention)
    points = to_world(splats.rows(free), frames).xyz.astype(np.float64)
    fraction[free] = 1 - np.mean([pixels_of(points, view.camera)[2] for view in views], axis=0)
    return fraction


def visual_hull_points(
    capture: Capture, views: Sequence[View], convention: str, sh_degree: int, torso: bool = False
) -> Splats:
    """Unbound splats on the surface of the visual hull of one timestep, outside the mesh, in the
    colors of its views.

    views: all of one timestep. The hull is carved on a grid of VOXEL_SIZE_M (coarser on a larger
    mesh) from the masks or, without masks, from pixels that differ from white. Each splat is
    embedded in the nearest triangle and follows it; torso: below the base of FLAME's neck, in the
    nearest one of the torso, and of few cameras where `stga track` has seen it instead of on the
    hull.
    """
    torso_points = read_torso_points(capture.root) if torso and len(views) <= FEW_CAMERAS else None
    mesh = capture.mesh(views[0].timestep)
    voxel = voxel_size(mesh)
    points = hull_surface(mesh, capture.faces, views, voxel)
    distance, face = _followed(capture, views[0].timestep, points, torso)
    outside = distance > MIN_MESH_DISTANCE_M
    world = _new_splats(points[outside], voxel, sh_degree)
    frames = face_frames(mesh, capture.faces, capture.neutral, convention)
    hull = to_local(world, frames, face[outside])
    beside = [~wide_silhouette(mesh, capture.faces, view.camera) for view in views]
    hull.sh[:, 0] = (colors_within(world.xyz, views, beside) - 0.5) / SH_C0
    if (
        torso_points is None
        or capture.flame is None
        or torso_points.timestep not in capture.timesteps
    ):
        return hull
    triangles = np.flatnonzero(torso_faces(capture.flame.model))
    if not len(triangles):
        return hull
    rest = hull.rows(~below_neck(capture.flame, views[0].timestep, points[outside]))
    # around the points at which the torso is seen, in its triangles
    mesh = capture.mesh(torso_points.timestep)
    voxel = voxel_size(capture.mesh(torso_points.timestep))
    spread = np.random.default_rng(0).normal(
        0, POINT_SPREAD * voxel, (POINT_COPIES, *torso_points.at.shape)
    )
    points = (torso_points.at + spread).reshape(-1, 3)
    _, among = _nearest_triangle(points, mesh, capture.faces[triangles])
    world = _new_splats(points, voxel, sh_degree)
    frames = face_frames(mesh, capture.faces, capture.neutral, convention)
    seen = to_local(world, frames, triangles[among])
    views = [view for view in capture.views["train"] if view.timestep == torso_points.timestep]
    within = [foreground_of(view) for view in views]
    seen.sh[:, 0] = (colors_within(world.xyz, views, within) - 0.5) / SH_C0
    return joined([rest, seen])


def flat_points(
    capture: Capture,
    view: View,
    convention: str,
    sh_degree: int,
    torso: bool = False,
    has_long_hair: bool = False,
) -> Splats:
    """Unbound splats for what a single camera shows beside the mesh: one layer at the depth of the
    mesh's outline.

    A single camera does not show how far away hair or shoulders are. Each splat lies on the ray of
    its pixel, as deep as the part of the mesh that is nearest in the image, but for the face: hair
    and collars are behind the jaw that they are seen beside. It follows the same triangle as a hull
    point there, and has its size and distance. torso: what the image cuts off below the neck is
    continued beyond it, as its border looks, for other timesteps that show more; where none does,
    it stays so. has_long_hair: what is beside the head, down to the base of the neck, is as deep as
    ears and scalp, not as the shoulders above which it is seen.
    """
    mesh = capture.mesh(view.timestep)
    camera = view.camera
    voxel = voxel_size(mesh)
    samples = _mesh_samples(mesh, capture.faces)
    distance = float(np.median(camera.project(samples)[1]))
    step = max(1.0, voxel * (camera.fl_x + camera.fl_y) / 2 / distance)
    neck = capture.flame if torso else None
    beyond = 0.0 if neck is None else round(CONTINUED_FRACTION * camera.width / step) * step
    rows, columns = np.meshgrid(
        np.arange(step / 2, camera.height + beyond, step),
        np.arange(step / 2 - beyond, camera.width + beyond, step),
        indexing="ij",
    )
    pixel = (
        np.clip(rows.astype(int), 0, camera.height - 1),
        np.clip(columns.astype(int), 0, camera.width - 1),
    )
    beside = (foreground_of(view) & ~wide_silhouette(mesh, capture.faces, camera))[pixel]
    centers = np.stack([columns[beside], rows[beside]], axis=1)
    if not len(centers):
        return _new_splats(np.zeros((0, 3)), voxel, sh_degree)
    behind_face = _without_face(capture)
    points = _at_depth_of(behind_face, camera, samples, centers)
    if has_long_hair:
        beside_hair = _ears_and_scalp(capture)
        hanging = _at_depth_of(beside_hair, camera, samples, centers)
        above = ~below_neck(neck, view.timestep, hanging) if neck else np.ones(len(hanging), bool)
        points[above] = hanging[above]
    _, face = _followed(capture, view.timestep, points, torso)
    splats = _new_splats(points, voxel, sh_degree)
    frames = face_frames(mesh, capture.faces, capture.neutral, convention)
    if neck is None:
        return to_local(splats, frames, face)
    cut = ~pixels_of(points, camera)[2]
    splats.sh[cut, 0] = (read_image(view)[pixel][beside][cut] / 255 - 0.5) / SH_C0
    splats.log_scale[cut] = np.log(voxel)
    splats.opacity[cut] = CONTINUED_OPACITY
    below = below_neck(neck, view.timestep, points)
    return to_local(splats, frames, face).rows(~cut | below)


def _at_depth_of(
    triangles: np.ndarray, camera: Camera, samples: np.ndarray, pixels: np.ndarray
) -> np.ndarray:
    """World points (N, 3) on the rays of these pixels (N, 2), each as deep as the nearest in the
    image of those `_mesh_samples` that lie on the triangles (F,) bool."""
    places, depth = camera.project(samples[np.repeat(triangles, len(samples) // len(triangles))])
    return camera.unproject(pixels, depth[cKDTree(places).query(pixels)[1]])


def _ears_and_scalp(capture: Capture) -> np.ndarray:
    """(F,) bool: triangles beside which hair grows; `_without_face` where none are known."""
    head = head_regions(capture).within(Region.EAR, Region.SCALP)
    return head if head.any() else _without_face(capture)


def _without_face(capture: Capture) -> np.ndarray:
    """(F,) bool: triangles outside the face; all of a mesh that consists of a face or whose face is
    not known."""
    others = ~head_regions(capture).face
    return others if others.any() else ~others


def _nearest_triangle(
    points: np.ndarray, mesh: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distance (N,) to the mesh and nearest triangle (N,), by samples of every triangle."""
    samples = _mesh_samples(mesh, faces)
    distance, nearest = cKDTree(samples).query(points)
    return distance, nearest // (len(samples) // len(faces))


def _followed(
    capture: Capture, timestep: int, points: np.ndarray, torso: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Distance (N,) to the mesh, and the nearest triangle (N,) of each point. With `torso`, points
    below the base of the neck take the torso's nearest triangle."""
    mesh = capture.mesh(timestep)
    distance, face = _nearest_triangle(points, mesh, capture.faces)
    if torso and capture.flame is not None:
        rows = np.flatnonzero(torso_faces(capture.flame.model))
        below = below_neck(capture.flame, timestep, points)
        if len(rows) and below.any():
            face[below] = rows[_nearest_triangle(points[below], mesh, capture.faces[rows])[1]]
    return distance, face


def _mesh_samples(mesh: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Points (F · S, 3) of a lattice on every triangle, triangle by triangle."""
    samples = np.einsum("pc,fci->fpi", lattice_weights(4, inset=0.02), mesh[faces])
    return np.asarray(samples.reshape(-1, 3))


def _new_splats(points: np.ndarray, voxel: float, sh_degree: int) -> Splats:
    """Gray unbound spheres of one voxel's size at world points (N, 3)."""
    n = len(points)
    rotation = np.eye(1, 4).repeat(n, axis=0)
    log_scale = np.full((n, 3), np.log(voxel / 2))
    sh = np.zeros((n, (sh_degree + 1) ** 2, 3))
    return in_world(points, rotation, log_scale, np.zeros(n), sh, is_free=True)
