"""What the cameras saw of the tracked mesh: the colour of triangles in a few of the training views."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import binary_dilation, binary_erosion, map_coordinates, uniform_filter

from ..avatar.strain import face_strain, strain_basis
from ..capture.camera import Camera
from ..capture.images import read_view
from ..capture.model import Capture, View

MOST_VIEWS = 48
MOST_TIMESTEPS = 12
MOST_FACES = 3000
"""More of each would change no decision, and cost more than a few seconds."""
HEIGHT = 400
"""Images of more than half as many rows again are looked at in this many: a tracked head's triangles are then two or
three pixels wide."""
FACING = 0.35
"""Cosine between normal and line of sight below which a triangle is seen too much from the side to have a colour."""
RIM = 3
"""Pixels along the mask's edge whose colours are mixed with the background's."""
BESIDE = 0.01
"""How far, as a share of the image's height, foreground may lie beside the mesh and still count as tracking error."""
DEEP = 0.003
"""A triangle's centre may lie this share of its distance behind what is drawn there, and still be seen."""


@dataclass(frozen=True)
class Samples:
    """S views of K triangles.

    faces      (K,) the triangles
    camera, timestep  (S,) of the views
    color      (S, K, 3) float32 in 0…255, mean around the triangle's centre; NaN where it is not seen
    direction  (S, K, 3) unit vectors from the camera to the triangle, world axes
    strain     (S, K, 3) of the triangles (`avatar.strain`)
    pixels     (S, K) area of the triangle in pixels of the whole image; NaN where it is not seen
    ground     (S,) metres that a pixel is wide at the head
    covered    (S,) pixels of the whole image that the foreground has, and
    beside     (S,) how many of them lie beside the mesh; NaN without a mask
    mesh       (S,) pixels of the whole image that the mesh has, and
    outside    (S,) how many of them lie outside the foreground; NaN without a mask
    backdrop   (S, 3) mean colour outside the mask, and
    unevenness (S,) root mean square deviation from it in levels of 255; NaN without a mask
    """

    faces: np.ndarray
    camera: np.ndarray
    timestep: np.ndarray
    color: np.ndarray
    direction: np.ndarray
    strain: np.ndarray
    pixels: np.ndarray
    ground: np.ndarray
    covered: np.ndarray
    beside: np.ndarray
    mesh: np.ndarray
    outside: np.ndarray
    backdrop: np.ndarray
    unevenness: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """(S, K) bool."""
        return np.asarray(~np.isnan(self.color[..., 0]))


def sample_views(views: Sequence[View], seed: int = 0) -> list[View]:
    """At most MOST_VIEWS of them: timesteps evenly spread, cameras about equally often."""
    timesteps = sorted({view.timestep for view in views})
    if len(timesteps) > MOST_TIMESTEPS:
        timesteps = [timesteps[n] for n in np.linspace(0, len(timesteps) - 1, MOST_TIMESTEPS).round().astype(int)]
    rng = np.random.default_rng(seed)
    left: dict[int, list[View]] = {t: [view for view in views if view.timestep == t] for t in timesteps}
    used = dict.fromkeys((view.camera_index for view in views), 0)
    chosen: list[View] = []
    while len(chosen) < MOST_VIEWS and any(left.values()):
        for timestep in rng.permutation(timesteps).tolist():
            if left[timestep] and len(chosen) < MOST_VIEWS:
                shuffled = [left[timestep][n] for n in rng.permutation(len(left[timestep]))]
                view = min(shuffled, key=lambda view: used[view.camera_index])
                left[timestep].remove(view)
                used[view.camera_index] += 1
                chosen.append(view)
    return chosen


def take_samples(capture: Capture, seed: int = 0) -> Samples:
    """Look at a few training views of a capture. Raises StgaError where an image cannot be read."""
    views = sample_views(capture.views["train"], seed)
    rng = np.random.default_rng(seed)
    count = len(capture.faces)
    faces = np.sort(rng.permutation(count)[:MOST_FACES])
    basis = strain_basis(capture.neutral, capture.faces)
    strain = {t: face_strain(basis, capture.mesh(t))[faces] for t in {view.timestep for view in views}}
    looks = [_look(capture, view, faces) for view in views]
    return Samples(
        faces,
        np.array([view.camera_index for view in views]),
        np.array([view.timestep for view in views]),
        strain=np.stack([strain[view.timestep] for view in views]),
        **{name: np.stack([look[name] for look in looks]) for name in looks[0]},
    )


def _look(capture: Capture, view: View, faces: np.ndarray) -> dict[str, np.ndarray]:
    """One view's row of every array of `Samples` that depends on the image."""
    scale = HEIGHT / view.camera.height
    small, image, mask = read_view(view, scale if scale < 2 / 3 else 1.0)
    camera, mesh = small.camera, np.asarray(capture.mesh(view.timestep))
    corners, depth = camera.project(mesh)
    depths = depth[capture.faces].mean(1)
    towards = _facing(mesh, capture.faces, camera)
    nearest = _nearest(corners[capture.faces], depths, (towards > 0) & (depth[capture.faces] > 0.01).all(1), camera)
    centre = corners[capture.faces[faces]].mean(1)
    x, y = np.round(centre - 0.5).astype(int).T
    inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    in_front = np.where(nearest[y, x] >= 0, depths[nearest[y, x]], np.inf)
    clean = np.ones(image.shape[:2], bool) if mask is None else binary_erosion(mask > 127, iterations=RIM)
    seen = inside & (towards[faces] > FACING) & (depths[faces] < in_front * (1 + DEEP)) & clean[y, x]
    direction = mesh[capture.faces[faces]].mean(1) - camera.position
    grown = view.camera.width * view.camera.height / (camera.width * camera.height)
    return {
        "color": np.where(seen[:, None], _colors(image, centre), np.nan).astype(np.float32),
        "direction": direction / np.linalg.norm(direction, axis=1, keepdims=True),
        "pixels": np.where(seen, grown * _areas(corners[capture.faces[faces]]), np.nan),
        "ground": np.array(np.median(depth) / view.camera.fl_x),  # of the image as it was taken
        **_around(image, mask, nearest >= 0, grown),
    }


def _facing(mesh: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """(F,) cosine between each triangle's normal and the way to the camera."""
    corners = mesh[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    way = camera.position - corners.mean(1)
    lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(way, axis=1)
    return np.asarray(np.einsum("fi,fi->f", normal, way) / np.maximum(lengths, 1e-30))


def _nearest(corners: np.ndarray, depth: np.ndarray, shown: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) the nearest triangle in each pixel, −1 for none; corners (F, 3, 2), depth (F,), shown (F,) bool."""
    picture = Image.new("I", (camera.width, camera.height), -1)
    draw = ImageDraw.Draw(picture)
    drawn = np.flatnonzero(shown)
    drawn = drawn[np.argsort(-depth[drawn], kind="stable")]  # the painter's order, far to near
    for face, polygon in zip(drawn.tolist(), (corners[drawn].reshape(-1, 6) - 0.5).tolist(), strict=True):
        draw.polygon(polygon, fill=face)
    return np.asarray(picture)


def _colors(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(K, 3) mean colour of 3 x 3 pixels around positions (K, 2)."""
    smooth = uniform_filter(image.astype(np.float32), (3, 3, 0))
    rows = np.stack([at[:, 1], at[:, 0]]) - 0.5
    return np.stack([map_coordinates(smooth[..., c], rows, order=1, mode="nearest") for c in range(3)], -1)


def _areas(corners: np.ndarray) -> np.ndarray:
    """(K,) areas of triangles (K, 3, 2)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.asarray(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2)


def _around(image: np.ndarray, mask: np.ndarray | None, mesh: np.ndarray, grown: float) -> dict[str, np.ndarray]:
    """What a view shows outside the mesh (H, W) bool and the mask; grown: pixels of the whole image in one of these."""
    unknown = np.array(np.nan)
    if mask is None:
        names = ("covered", "beside", "mesh", "outside", "unevenness")
        return {"backdrop": np.full(3, np.nan), **dict.fromkeys(names, unknown)}
    near = binary_dilation(mesh, iterations=max(1, round(BESIDE * len(image))))
    foreground = mask > 127
    clear = image[binary_erosion(mask == 0, iterations=RIM, border_value=1)].astype(np.float64)
    backdrop = clear.mean(0) if len(clear) else np.full(3, np.nan)
    return {
        "covered": np.array(grown * foreground.sum()),
        "beside": np.array(grown * (foreground & ~near).sum()),
        "mesh": np.array(grown * mesh.sum()),
        "outside": np.array(grown * (mesh & ~binary_dilation(foreground, np.ones((3, 3)))).sum()),
        "backdrop": backdrop,
        "unevenness": np.array(np.sqrt(((clear - backdrop) ** 2).mean())) if len(clear) else unknown,
    }
