"""Samples of a capture: colors, sizes and coverage of triangles in a few training views."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import binary_dilation, binary_erosion, map_coordinates, uniform_filter

from ...avatar.strain import color_range, face_strain, smoothed_strain, strain_basis
from ...capture.camera import Camera
from ...capture.images import WHITE_LEVEL, read_view
from ...capture.model import Capture, View, evenly_spread

MAX_VIEWS = 48
MAX_TIMESTEPS = 12
MAX_FACES = 3000
"""More of each would change no decision, and take more than a few seconds; of more cameras, each
gives one view."""
SAMPLED_HEIGHT_PIXELS = 400
"""Images at least half as high again are shrunk to this height: triangles are then two or three
pixels wide."""
MIN_NEAR_DEPTH_M = 0.01
MIN_FACING_COSINE = 0.35
"""Between normal and line of sight; below it, a triangle is too oblique to have a color."""
MASK_EDGE_PIXELS = 3
"""Along the mask's edge, colors are mixed with the background."""
TRACKING_ERROR_SHARE = 0.01
"""Foreground up to this share of the image's height beside the mesh counts as tracking error."""
DEPTH_TOLERANCE_SHARE = 0.003
"""A triangle is visible if its center lies at most this share of its distance behind the nearest
triangle there."""


@dataclass(frozen=True)
class Samples:
    """S views of K triangles.

    faces      (K,) the triangles
    camera, timestep  (S,) of the views
    color      (S, K, 3) float32 from 0 to 255, mean around the triangle's center; NaN where it is
               not visible
    direction  (S, K, 3) unit vectors from the camera to the triangle, world axes
    strain     (S, K, 3) of the triangles, as far as colors follow it (`avatar.strain`)
    smoothed_strain  (S, K, 3) strain around the triangles, as positions follow it
                     (`avatar.strain.smoothed_strain`)
    pixels     (S, K) area of the triangle in pixels; NaN where it is not visible
    pixel_width  (S,) meters that a pixel spans at the head; NaN for a head behind the camera
    foreground (S,) pixels inside the mask; NaN without one, like the following
    uncovered  (S,) those of them that lie beside the mesh
    mesh       (S,) pixels of the mesh
    outside    (S,) those of them that lie outside the mask
    background (S, 3) mean color outside the mask
    background_spread  (S,) root mean square deviation from it in levels of 255
    white      (S,) share of the pixels beside the mesh that are white, with or without a mask
    Pixels are those of the image at its own size.
    """

    faces: np.ndarray
    camera: np.ndarray
    timestep: np.ndarray
    color: np.ndarray
    direction: np.ndarray
    strain: np.ndarray
    smoothed_strain: np.ndarray
    pixels: np.ndarray
    pixel_width: np.ndarray
    foreground: np.ndarray
    uncovered: np.ndarray
    mesh: np.ndarray
    outside: np.ndarray
    background: np.ndarray
    background_spread: np.ndarray
    white: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """(S, K) bool."""
        return np.asarray(~np.isnan(self.color[..., 0]))


def sample_views(views: Sequence[View], seed: int = 0) -> list[View]:
    """MAX_VIEWS of them, or one of each camera where that is more: timesteps evenly spread, cameras
    equally often."""
    cameras = len({view.camera_index for view in views})
    timesteps = evenly_spread(
        sorted({view.timestep for view in views}), max(MAX_TIMESTEPS, MAX_VIEWS // cameras)
    )
    rng = np.random.default_rng(seed)
    left: dict[int, list[View]] = {
        t: [view for view in views if view.timestep == t] for t in timesteps
    }
    used = dict.fromkeys((view.camera_index for view in views), 0)
    chosen: list[View] = []
    count = max(MAX_VIEWS, len(used))
    while len(chosen) < count and any(left.values()):
        for timestep in rng.permutation(timesteps).tolist():
            if left[timestep] and len(chosen) < count:
                shuffled = [left[timestep][n] for n in rng.permutation(len(left[timestep]))]
                view = min(shuffled, key=lambda view: used[view.camera_index])
                left[timestep].remove(view)
                used[view.camera_index] += 1
                chosen.append(view)
    return [
        *chosen,
        *{view.camera_index: view for view in views if not used[view.camera_index]}.values(),
    ]


def take_samples(capture: Capture, seed: int = 0) -> Samples:
    """Sample a few training views of a capture, one image at a time. Raises StgaError where one
    cannot be read."""
    views = sample_views(capture.views["train"], seed)
    rng = np.random.default_rng(seed)
    count = len(capture.faces)
    faces = np.sort(rng.permutation(count)[:MAX_FACES])
    basis = strain_basis(capture.neutral, capture.faces, color_range(count))
    strain = {t: face_strain(basis, capture.mesh(t)) for t in {view.timestep for view in views}}
    smoothed = {t: smoothed_strain(basis, found)[faces] for t, found in strain.items()}
    rows = [_sample_view(capture, view, faces) for view in views]
    return Samples(
        faces,
        np.array([view.camera_index for view in views]),
        np.array([view.timestep for view in views]),
        strain=np.stack([strain[view.timestep][faces] for view in views]),
        smoothed_strain=np.stack([smoothed[view.timestep] for view in views]),
        **{name: np.stack([row[name] for row in rows]) for name in rows[0]},
    )


def _sample_view(capture: Capture, view: View, faces: np.ndarray) -> dict[str, np.ndarray]:
    """One view's row of every array of `Samples` that depends on the image."""
    scale = SAMPLED_HEIGHT_PIXELS / view.camera.height
    small, image, mask = read_view(view, scale if scale < 2 / 3 else 1.0)
    camera, mesh = small.camera, np.asarray(capture.mesh(view.timestep))
    corners, depth = camera.project(mesh)
    depths = depth[capture.faces].mean(1)
    towards = _facing(mesh, capture.faces, camera)
    nearest = _nearest(
        corners[capture.faces],
        depths,
        (towards > 0) & (depth[capture.faces] > MIN_NEAR_DEPTH_M).all(1),
        camera,
    )
    center = corners[capture.faces[faces]].mean(1)
    x, y = np.round(center - 0.5).astype(int).T
    inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    in_front = np.where(nearest[y, x] >= 0, depths[nearest[y, x]], np.inf)
    clean = (
        np.ones(image.shape[:2], bool)
        if mask is None
        else binary_erosion(mask > 127, iterations=MASK_EDGE_PIXELS)
    )
    seen = (
        inside
        & (towards[faces] > MIN_FACING_COSINE)
        & (depths[faces] < in_front * (1 + DEPTH_TOLERANCE_SHARE))
        & clean[y, x]
    )
    direction = mesh[capture.faces[faces]].mean(1) - camera.position
    area = view.camera.width * view.camera.height / (camera.width * camera.height)
    distance = float(np.median(depth))
    return {
        "color": np.where(seen[:, None], _colors(image, center), np.nan).astype(np.float32),
        "direction": direction
        / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12),
        "pixels": np.where(seen, area * _areas(corners[capture.faces[faces]]), np.nan),
        "pixel_width": np.array(distance / view.camera.fl_x if distance > 0 else np.nan),
        **_coverage(image, mask, nearest >= 0, area),
    }


def _facing(mesh: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """(F,) cosine between each triangle's normal and its direction to the camera."""
    corners = mesh[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    to_camera = camera.position - corners.mean(1)
    lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(to_camera, axis=1)
    return np.asarray(np.einsum("fi,fi->f", normal, to_camera) / np.maximum(lengths, 1e-30))


def _nearest(
    corners: np.ndarray, depth: np.ndarray, shown: np.ndarray, camera: Camera
) -> np.ndarray:
    """(H, W) index of the nearest triangle in each pixel, -1 for none; corners (F, 3, 2), depth
    (F,), shown (F,) bool.

    Painter's algorithm: triangles are drawn whole, from far to near.
    """
    picture = Image.new("I", (camera.width, camera.height), -1)
    draw = ImageDraw.Draw(picture)
    drawn = np.flatnonzero(shown)
    drawn = drawn[np.argsort(-depth[drawn], kind="stable")]
    for face, polygon in zip(
        drawn.tolist(), (corners[drawn].reshape(-1, 6) - 0.5).tolist(), strict=True
    ):
        draw.polygon(polygon, fill=face)
    return np.asarray(picture)


def _colors(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(K, 3) mean color of 3 x 3 pixels around positions (K, 2)."""
    smooth = uniform_filter(image.astype(np.float32), (3, 3, 0))
    rows = np.stack([at[:, 1], at[:, 0]]) - 0.5
    return np.stack(
        [map_coordinates(smooth[..., c], rows, order=1, mode="nearest") for c in range(3)], -1
    )


def _areas(corners: np.ndarray) -> np.ndarray:
    """(K,) areas of triangles (K, 3, 2)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.asarray(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2)


def _coverage(
    image: np.ndarray, mask: np.ndarray | None, mesh: np.ndarray, area: float
) -> dict[str, np.ndarray]:
    """How mesh (H, W) bool and mask cover each other, and the background; area: of a pixel, in
    original pixels."""
    unknown = np.array(np.nan)
    near = binary_dilation(mesh, iterations=max(1, round(TRACKING_ERROR_SHARE * len(image))))
    white = np.array((image >= WHITE_LEVEL).all(axis=2)[~near].mean() if not near.all() else 1.0)
    if mask is None:
        names = ("foreground", "uncovered", "mesh", "outside", "background_spread")
        return {"background": np.full(3, np.nan), "white": white, **dict.fromkeys(names, unknown)}
    foreground = mask > 127
    clear = image[binary_erosion(mask == 0, iterations=MASK_EDGE_PIXELS, border_value=1)].astype(
        np.float64
    )
    background = clear.mean(0) if len(clear) else np.full(3, np.nan)
    return {
        "foreground": np.array(area * foreground.sum()),
        "uncovered": np.array(area * (foreground & ~near).sum()),
        "mesh": np.array(area * mesh.sum()),
        "outside": np.array(area * (mesh & ~binary_dilation(foreground, np.ones((3, 3)))).sum()),
        "background": background,
        "background_spread": np.array(np.sqrt(((clear - background) ** 2).mean()))
        if len(clear)
        else unknown,
        "white": white,
    }
