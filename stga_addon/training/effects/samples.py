"""Samples of a capture: colors, sizes and coverage of triangles in a few training views."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, map_coordinates, uniform_filter

from ...avatar.embedding import face_frames
from ...avatar.offsets import SIGNALS
from ...avatar.strain import strain_basis, trained_range
from ...capture.images import WHITE_LEVEL, read_view
from ...capture.mesh_geometry import facing, rasterize, triangle_normals
from ...capture.model import Capture, View, evenly_spread
from ...flame.quaternions import unit

MAX_VIEWS = 48
"""Views that are sampled at most, one of each camera where there are more."""
MAX_TIMESTEPS = 12
"""Timesteps that are sampled at most."""
MAX_FACES = 3000
"""Triangles that are sampled at most; more would take long and change no decision."""
IMAGES_AT_A_TIME = 2
"""Images that are in memory together, as they may be large."""
SAMPLED_HEIGHT_PIXELS = 400
"""Height to which images half as high again are shrunk: triangles are then two or three pixels
wide."""
MIN_FACING_COSINE = 0.35
"""Least cosine between normal and line of sight; below it, a triangle is too oblique to have a
color."""
MASK_EDGE_PIXELS = 3
"""Along the mask's edge, colors are mixed with the background."""
TRACKING_ERROR_FRACTION = 0.01
"""Foreground up to this fraction of the image's height beside the mesh counts as tracking error."""
DEPTH_TOLERANCE_FRACTION = 0.003
"""Depth of a visible triangle's center behind the nearest one, as a fraction of its depth, up to
which it is visible."""


@dataclass(frozen=True)
class Samples:
    """S views of K triangles. Pixels are those of the image at its own size.

    faces, camera, timestep  (K,) the triangles, (S,) and (S,) of the views
    color      (S, K, 3) float32 from 0 to 255, mean around the triangle's center; NaN where it is
               not visible
    direction  (S, K, 3) unit vectors from the camera to the triangle, world axes
    signals    name of `avatar.offsets.SIGNALS` -> (S, K, 3), in the range that is trained
    pixels     (S, K) area of the triangle in pixels; NaN where it is not visible
    pixel_width  (S,) meters that a pixel spans at the head; NaN for a head behind the camera
    foreground, uncovered  (S,) pixels inside the mask, and those of them that lie beside the mesh;
               NaN without a mask, like the following
    mesh, outside  (S,) pixels of the mesh, and those of them that lie outside the mask
    background, background_spread  (S, 3) mean color outside the mask, and (S,) root mean square
               deviation from it in levels of 255
    white      (S,) fraction of the pixels beside the mesh that are white, with or without a mask
    """

    faces: np.ndarray
    camera: np.ndarray
    timestep: np.ndarray
    color: np.ndarray
    direction: np.ndarray
    signals: dict[str, np.ndarray]
    pixels: np.ndarray
    pixel_width: np.ndarray
    foreground: np.ndarray
    uncovered: np.ndarray
    mesh: np.ndarray
    outside: np.ndarray
    background: np.ndarray
    background_spread: np.ndarray
    white: np.ndarray

    def of_views(self, rows: np.ndarray) -> "Samples":
        """Samples of some of the views, (S,) bool."""
        of_views = {name: array for name, array in vars(self).items() if name != "faces"}
        signals = {name: signal[rows] for name, signal in of_views.pop("signals").items()}
        arrays = {name: array[rows] for name, array in of_views.items()}
        return Samples(self.faces, signals=signals, **arrays)


def sample_views(views: Sequence[View], seed: int = 0) -> list[View]:
    """MAX_VIEWS, or one of each camera: timesteps evenly spread, cameras equally often."""
    used = dict.fromkeys((view.camera_index for view in views), 0)
    every = sorted({view.timestep for view in views})
    timesteps = evenly_spread(every, max(MAX_TIMESTEPS, MAX_VIEWS // len(used)))
    rng = np.random.default_rng(seed)
    chosen = list[View]()
    count = max(MAX_VIEWS, len(used))
    left = {t: [view for view in views if view.timestep == t] for t in timesteps}
    while len(chosen) < count and any(left.values()):
        for timestep in rng.permutation(timesteps).tolist():
            if left[timestep] and len(chosen) < count:
                shuffled = [left[timestep][n] for n in rng.permutation(len(left[timestep]))]
                view = min(shuffled, key=lambda view: used[view.camera_index])
                left[timestep].remove(view)
                used[view.camera_index] += 1
                chosen.append(view)
    rest = {view.camera_index: view for view in views if not used[view.camera_index]}
    return [*chosen, *rest.values()]


def take_samples(capture: Capture, seed: int = 0) -> Samples:
    """Samples of a few training views, two images at a time. Raises StgaError where one cannot be
    read."""
    views = sample_views(capture.views["train"], seed)
    rng = np.random.default_rng(seed)
    count = len(capture.faces)
    faces = np.sort(rng.permutation(count)[:MAX_FACES])
    neutral = capture.neutral
    triangles = capture.faces
    basis = strain_basis(neutral, triangles, trained_range(count))
    posed = {
        timestep: face_frames(capture.mesh(timestep), triangles, neutral, strain=basis)
        for timestep in {view.timestep for view in views}
    }
    signals = {
        name: {timestep: signal(basis, frames)[faces] for timestep, frames in posed.items()}
        for name, signal in SIGNALS.items()
    }
    with ThreadPoolExecutor(IMAGES_AT_A_TIME) as pool:
        rows = list(pool.map(lambda view: sample_view(capture, view, faces), views))
    return Samples(
        faces,
        np.array([view.camera_index for view in views]),
        np.array([view.timestep for view in views]),
        signals={
            name: np.stack([by_timestep[view.timestep] for view in views])
            for name, by_timestep in signals.items()
        },
        **{name: np.stack([row[name] for row in rows]) for name in rows[0]},
    )


def sample_view(capture: Capture, view: View, faces: np.ndarray) -> dict[str, np.ndarray]:
    """One view's row of every array of `Samples` that depends on the image."""
    scale = SAMPLED_HEIGHT_PIXELS / view.camera.height
    small, image, mask = read_view(view, scale if scale < 2 / 3 else 1.0)
    camera = small.camera
    mesh = capture.mesh(view.timestep)
    corners, depth = camera.project(mesh)
    depths = depth[capture.faces].mean(1)
    places = mesh[capture.faces]
    towards = facing(camera, places.mean(1), unit(triangle_normals(places), 1e-20))
    nearest, _ = rasterize(mesh, capture.faces, camera)
    triangles = corners[capture.faces[faces]]
    center = triangles.mean(1)
    x, y = np.round(center - 0.5).astype(int).T
    inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    x = np.where(inside, x, 0)
    y = np.where(inside, y, 0)
    in_front = np.where(nearest[y, x] >= 0, depths[nearest[y, x]], np.inf)
    visible = inside & (towards[faces] > MIN_FACING_COSINE)
    visible &= depths[faces] < in_front * (1 + DEPTH_TOLERANCE_FRACTION)
    if mask is not None:
        visible &= binary_erosion(mask > 127, iterations=MASK_EDGE_PIXELS)[y, x]
    smooth = uniform_filter(image.astype(np.float32), (3, 3, 0))
    at = center.T[::-1] - 0.5
    colors = [map_coordinates(smooth[..., c], at, order=1, mode="nearest") for c in range(3)]
    direction = mesh[capture.faces[faces]].mean(1) - camera.position
    distance = np.linalg.norm(direction, axis=1, keepdims=True)
    area = view.camera.width * view.camera.height / (camera.width * camera.height)
    a = triangles[:, 1] - triangles[:, 0]
    b = triangles[:, 2] - triangles[:, 0]
    head = float(np.median(depth))
    pixels = area * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    return {
        "color": np.where(visible[:, None], np.stack(colors, -1), np.nan).astype(np.float32),
        "direction": direction / np.maximum(distance, 1e-12),
        "pixels": np.where(visible, pixels, np.nan),
        "pixel_width": np.array(head / view.camera.fl_x if head > 0 else np.nan),
        **_coverage(image, mask, nearest >= 0, area),
    }


def _coverage(
    image: np.ndarray, mask: np.ndarray | None, covered: np.ndarray, area: float
) -> dict[str, np.ndarray]:
    """What `Samples` holds of an image's mask and of its mesh, which covers pixels (H, W) bool;
    area: pixels of the image at its own size in one of these."""
    near = binary_dilation(covered, iterations=max(1, round(TRACKING_ERROR_FRACTION * len(image))))
    white = (image >= WHITE_LEVEL).all(axis=2)[~near].mean() if not near.all() else 1.0
    row = {"white": np.array(white), "background": np.full(3, np.nan)}
    if mask is None:
        names = ("foreground", "uncovered", "mesh", "outside", "background_spread")
        return {**row, **dict.fromkeys(names, np.array(np.nan))}
    parts = {**_areas(mask > 127, covered, near), "mesh": covered}
    row |= {name: np.array(area * part.sum()) for name, part in parts.items()}
    beside = binary_erosion(mask == 0, iterations=MASK_EDGE_PIXELS, border_value=1)
    clear = image[beside].astype(np.float64)
    spread = np.nan
    if len(clear):
        row["background"] = clear.mean(0)
        spread = np.sqrt(((clear - row["background"]) ** 2).mean())
    return {**row, "background_spread": np.array(spread)}


def _areas(foreground: np.ndarray, covered: np.ndarray, near: np.ndarray) -> dict[str, np.ndarray]:
    """(H, W) the mask's foreground, what of it is not `near` the mesh, within the tracking's error,
    and where the mesh, which is `covered`, lies outside of it."""
    return {
        "foreground": foreground,
        "uncovered": foreground & ~near,
        "outside": covered & ~binary_dilation(foreground, np.ones((3, 3))),
    }
