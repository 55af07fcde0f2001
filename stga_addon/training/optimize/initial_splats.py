"""The splats that training starts with: a lattice on the mesh, colored as the images show it, and
visual-hull points for what the mesh does not cover (hair, shoulders, clothes); a flat layer for a
single camera."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_cdt
from scipy.spatial import cKDTree

from ...avatar.embedding import face_frames, to_local, to_world
from ...avatar.lattice import lattice_splats, lattice_weights
from ...avatar.splats import SH_C0, Splats, in_world, joined
from ...capture.camera import Camera
from ...capture.images import WHITE_LEVEL, read_image, read_mask, read_view
from ...capture.mesh_geometry import (
    MIN_DEPTH_M,
    connected_parts,
    pixels_of,
    rasterize,
    silhouette,
    triangle_normals,
)
from ...capture.model import Capture, View, evenly_spread, views_by_timestep
from ...flame.model import faces_within, torso_faces
from ...flame.parts import PARTS
from ...flame.sequence import below_neck
from ...tracking.folder import read_torso_points
from ..settings import TrainingSettings
from .semantic_regions import Region, head_regions

SAMPLED_HEIGHT_PIXELS = 400
"""Images higher than this are shrunk to it: triangles are then two or three pixels wide."""
MASK_EDGE_PIXELS = 3
"""Along the mask's edge, colors are mixed with the background."""
MAX_LATER_TIMESTEPS = 6
"""Timesteps that are read after the first."""
MAX_LATER_VIEWS = 2
"""Views of each of these timesteps."""
MIDDLE_GRAY = 0.5
"""Brightness, 0…1, of splats that no view shows."""
MIN_ONE_SIDED_FRACTION = 0.05
"""Area of the triangles that no view shows, but whose mirror images are visible, as a fraction of
the mesh; below it, the cameras stand on both sides of the head."""
MAX_ASYMMETRY_FRACTION = 0.015
"""Largest median distance of a symmetric mesh from its mirror image, of its diagonal."""
VOXEL_SIZE_M = 0.004
"""Distance between visual-hull points, on a mesh of a head's size."""
MIN_VOXEL_SIZE_FRACTION = 1 / 200
"""Least size of a voxel as a fraction of the mesh's diagonal, so that the grid of a mesh in
millimeters fits into memory."""
MIN_MESH_DISTANCE_M = 0.006
"""Points nearer to the mesh are covered by the mesh's own splats."""
GRID_MARGIN_FRACTION = 0.25
"""Margin of the grid around the mesh's bounding box, as a fraction of its diagonal."""
BLOCK_VOXELS = 5
"""Edge of the blocks that are carved before single voxels are, in voxels."""
MIN_VISIBLE_FRACTION = 0.25
"""Fraction of the views in whose image a voxel must lie; it must be foreground in all of these."""
MIN_EXPOSED_FRACTION = 0.125
"""Fraction of the views in which a voxel must be visible beside the mesh. Otherwise, volumes behind
the head that no view contradicts would become floaters in other views."""
SILHOUETTE_TOLERANCE_FRACTION = 0.01
"""Error of the tracked silhouette, as a fraction of the image height."""
FEW_CAMERAS = 4
"""Largest number of cameras with which a torso's visual hull bulges by centimeters: `TorsoPoints`
are better."""
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


def triangle_colors(capture: Capture, views: Sequence[View]) -> np.ndarray:
    """Mean color (F, 3) from 0 to 1 of each triangle in the first view's timestep or, if hidden
    there, in later ones.

    Teeth that the lips hide at first have their own color, not that of the lips. Where cameras
    stand on one side of the head only, a triangle of the other side has the color of its mirror
    image. Any other that no view shows has the color of the nearest one of the neutral mesh that is
    connected with it: the back of a head that is seen from the front has the color of its sides.
    Where all connected ones are hidden too, as a back tooth, it is the nearest of those that only
    later timesteps show or, without any, of all. Gray if no view shows any.
    """
    by_timestep = views_by_timestep(views)
    color, pixels = mean_colors(capture, by_timestep.pop(views[0].timestep))
    visible = pixels > 0
    later: list[View] = []  # a few, of timesteps that are evenly spread, by other cameras in each
    for n, timestep in enumerate(evenly_spread(sorted(by_timestep), MAX_LATER_TIMESTEPS)):
        step = -(-len(by_timestep[timestep]) // MAX_LATER_VIEWS)
        later += by_timestep[timestep][n % step :: step]
    late_color, pixels = mean_colors(capture, later)
    late = (pixels > 0) & ~visible
    color[late] = late_color[late]
    visible |= late
    if not visible.any():
        return np.full(color.shape, MIDDLE_GRAY)
    hidden, mirrored = mirror_images(capture, ~visible, visible)
    area = np.linalg.norm(triangle_normals(capture.neutral[capture.faces]), axis=1)
    if area[hidden].sum() >= MIN_ONE_SIDED_FRACTION * area.sum():
        color[hidden] = color[mirrored]
        visible[hidden] = True
    centers = capture.neutral[capture.faces].mean(1)
    others = late if late.any() else visible
    nearest = np.flatnonzero(others)[cKDTree(centers[others]).query(centers)[1]]
    part = connected_parts(len(capture.neutral), capture.faces)[capture.faces[:, 0]]
    for number in np.unique(part[visible]):
        members = np.flatnonzero(part == number)
        known = np.flatnonzero((part == number) & visible)
        nearest[members] = known[cKDTree(centers[known]).query(centers[members])[1]]
    return np.asarray(color[nearest])


def mean_colors(capture: Capture, views: Sequence[View]) -> tuple[np.ndarray, np.ndarray]:
    """Mean color (F, 3) in 0…1 of each triangle in the views; (F,) how many pixels show it."""
    total = np.zeros((len(capture.faces), 3))
    count = np.zeros(len(capture.faces))
    for view in views:
        small, image, mask = read_view(view, min(1.0, SAMPLED_HEIGHT_PIXELS / view.camera.height))
        triangle, _ = rasterize(capture.mesh(view.timestep), capture.faces, small.camera)
        inside = triangle >= 0
        if mask is not None:
            inside &= binary_erosion(mask > 127, iterations=MASK_EDGE_PIXELS)
        pixels = image[inside]
        found = triangle[inside]
        count += np.bincount(found, minlength=len(count))
        for channel in range(3):
            total[:, channel] += np.bincount(found, pixels[:, channel], len(count))
    return total / np.maximum(count, 1)[:, None] / 255, count


def mirrored(points: np.ndarray) -> np.ndarray:
    """Points (N, 3) of a head, on its other side."""
    return points * [-1, 1, 1] + [2 * points[:, 0].mean(), 0, 0]


def mirror_images(
    capture: Capture, hidden: np.ndarray, visible: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles that are `hidden` (F,) bool and whose mirror images are `visible`, and these; none
    where the mesh is not symmetric."""
    centers = capture.neutral[capture.faces].mean(1)
    distance, partner = cKDTree(centers).query(mirrored(centers))
    rows = np.flatnonzero(hidden & visible[partner])
    if np.median(distance) > MAX_ASYMMETRY_FRACTION * np.linalg.norm(
        np.ptp(capture.neutral, axis=0)
    ):
        rows = rows[:0]
    return rows, partner[rows]


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
    mesh = capture.mesh(views[0].timestep)
    voxel = voxel_size(mesh)
    points = _hull_surface(mesh, capture.faces, views, voxel)
    distance, face = _followed(capture, views[0].timestep, points, torso)
    outside = distance > MIN_MESH_DISTANCE_M
    world = _new_splats(points[outside], voxel, sh_degree)
    beside = [~_silhouette(mesh, capture.faces, view.camera) for view in views]
    world.sh[:, 0] = (_colors_within(world.xyz, views, beside) - 0.5) / SH_C0
    frames = face_frames(mesh, capture.faces, capture.neutral, convention)
    hull = to_local(world, frames, face[outside])
    torso_points = read_torso_points(capture.root) if torso and len(views) <= FEW_CAMERAS else None
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
    frames = face_frames(mesh, capture.faces, capture.neutral, convention)
    world = _new_splats(points, voxel, sh_degree)
    views = [view for view in capture.views["train"] if view.timestep == torso_points.timestep]
    within = [_foreground(view) for view in views]
    world.sh[:, 0] = (_colors_within(world.xyz, views, within) - 0.5) / SH_C0
    return joined([rest, to_local(world, frames, triangles[among])])


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
    beside = (_foreground(view) & ~_silhouette(mesh, capture.faces, camera))[pixel]
    centers = np.stack([columns[beside], rows[beside]], axis=1)
    if not len(centers):
        return _new_splats(np.zeros((0, 3)), voxel, sh_degree)
    points = _at_depth_of(_without_face(capture), camera, samples, centers)
    if has_long_hair:
        hanging = _at_depth_of(_ears_and_scalp(capture), camera, samples, centers)
        above = ~below_neck(neck, view.timestep, hanging) if neck else np.ones(len(hanging), bool)
        points[above] = hanging[above]
    _, face = _followed(capture, view.timestep, points, torso)
    frames = face_frames(mesh, capture.faces, capture.neutral, convention)
    splats = _new_splats(points, voxel, sh_degree)
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


def voxel_size(mesh: np.ndarray) -> float:
    """Distance in meters between visual-hull points around a mesh (V, 3)."""
    return max(VOXEL_SIZE_M, MIN_VOXEL_SIZE_FRACTION * float(np.linalg.norm(np.ptp(mesh, axis=0))))


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


def _hull_surface(
    mesh: np.ndarray, faces: np.ndarray, views: Sequence[View], voxel: float
) -> np.ndarray:
    """Grid points (N, 3) on the surface of the visual hull that are visible beside the mesh."""
    low = mesh.min(0)
    high = mesh.max(0)
    margin = GRID_MARGIN_FRACTION * np.linalg.norm(high - low)
    axes = [np.arange(a - margin, b + margin, voxel) for a, b in zip(low, high, strict=True)]
    foreground = [_foreground(view) for view in views]
    min_visible = max(2, MIN_VISIBLE_FRACTION * len(views))
    # first blocks are carved, whose bounding sphere lies in the background of an image, or outside
    # of too many images
    centers = [axis[::BLOCK_VOXELS] + (BLOCK_VOXELS - 1) / 2 * voxel for axis in axes]
    points = np.stack(np.meshgrid(*centers, indexing="ij"), axis=-1).reshape(-1, 3)
    radius = np.sqrt(3) / 2 * (BLOCK_VOXELS - 1) * voxel
    kept = np.ones(len(points), bool)
    outside = np.zeros(len(points), int)
    for view, mask in zip(views, foreground, strict=True):
        camera = view.camera
        pixels, depth = camera.project(points)
        before = depth - radius > MIN_DEPTH_M
        nearest = np.maximum(depth - radius, MIN_DEPTH_M)
        # Over a sphere, x / z differs from the center's by at most radius · |(x, z)| / (z · (z −
        # radius)).
        focal = [camera.fl_x, camera.fl_y]
        slope = np.hypot(1, (pixels - [camera.cx, camera.cy]) / focal)
        reach = np.ceil((slope * focal).max(1) * radius / nearest) + 1
        beyond = np.maximum(-pixels, pixels - [camera.width, camera.height]).max(1)
        outside += np.where(before, beyond > reach, depth + radius <= MIN_DEPTH_M)
        # Beyond an image, what is background is not known.
        clear = distance_transform_cdt(np.pad(~mask, 1), "chessboard")[1:-1, 1:-1]
        x, y, in_image = pixels_of(points, camera)
        kept &= ~(before & in_image & (clear[y, x] > reach))
    kept &= len(views) - outside >= min_visible
    within = kept.reshape([len(along) for along in centers])
    for number, axis in enumerate(axes):
        within = within.repeat(BLOCK_VOXELS, number).take(range(len(axis)), number)
    # then voxels
    rows = np.nonzero(within)
    points = np.stack([axis[row] for axis, row in zip(axes, rows, strict=True)], axis=1)
    inside = np.ones(len(points), bool)
    visible, exposed = np.zeros((2, len(points)), np.int32)
    for view, mask in zip(views, foreground, strict=True):
        beside = ~_silhouette(mesh, faces, view.camera)
        remaining = np.flatnonzero(inside)
        x, y, in_image = pixels_of(points[remaining], view.camera)
        remaining = remaining[in_image]
        x = x[in_image]
        y = y[in_image]
        visible[remaining] += 1
        exposed[remaining] += beside[y, x]
        inside[remaining] = mask[y, x]
    solid = within.copy()
    solid[within] = inside & (visible >= min_visible)
    surface = (solid & ~binary_erosion(solid))[within]
    return np.asarray(
        points[surface & (exposed >= np.maximum(1, MIN_EXPOSED_FRACTION * len(views)))]
    )


def _colors_within(
    points: np.ndarray, views: Sequence[View], masks: Sequence[np.ndarray]
) -> np.ndarray:
    """Mean color (N, 3) in 0…1 of points (N, 3) in the views in which they lie within the masks (H,
    W) bool; gray where there is none."""
    total = np.zeros((len(points), 3))
    count = np.zeros(len(points))
    for view, mask in zip(views, masks, strict=True):
        x, y, inside = pixels_of(points, view.camera)
        rows = np.flatnonzero(inside & mask[y, x])
        total[rows] += read_image(view)[y[rows], x[rows]] / 255
        count[rows] += 1
    mean = total / np.maximum(count, 1)[:, None]
    return np.where(count[:, None] > 0, mean, MIDDLE_GRAY)


def _silhouette(mesh: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) bool: pixels that the mesh covers, dilated by the tolerance."""
    tolerance = max(1, round(SILHOUETTE_TOLERANCE_FRACTION * camera.height))
    return np.asarray(binary_dilation(silhouette(mesh, faces, camera), iterations=tolerance))


def _foreground(view: View) -> np.ndarray:
    """(H, W) bool from the mask or, without one, from the image's difference to white."""
    mask = read_mask(view)
    if mask is not None:
        return np.asarray(mask > 127)
    return np.asarray((read_image(view) < WHITE_LEVEL).any(axis=2))


def _new_splats(points: np.ndarray, voxel: float, sh_degree: int) -> Splats:
    """Gray unbound spheres of one voxel's size at world points (N, 3)."""
    n = len(points)
    rotation = np.eye(1, 4).repeat(n, axis=0)
    log_scale = np.full((n, 3), np.log(voxel / 2))
    sh = np.zeros((n, (sh_degree + 1) ** 2, 3))
    return in_world(points, rotation, log_scale, np.zeros(n), sh, is_free=True)
