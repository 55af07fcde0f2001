"""Captures of a ball that deforms, painted by known causes of its triangles' colors."""

from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.random import default_rng
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

from stga_addon.avatar.strain import deformation, strain_basis
from stga_addon.capture.camera import look_at
from stga_addon.capture.model import Capture, View

SIZE = 100
FOCAL = 420.0
SUPERSAMPLED = 3
NOISE = 1.5  # levels
WINDOW = np.array([0.9, 0.1, 0.42])
"""Unit vector toward the window."""


def nothing(deformed, direction, place):
    """What a scene is painted by: of deformations (F, 6), unit directions from the camera (F, 3)
    and unit places on the ball (F, 3), levels (F,) that are added to the triangles' own colors."""
    return np.zeros(len(deformed))


def wrinkles(deformed, direction, place):
    """Darker where the first edge shrinks, but no lighter where it grows."""
    return 60 * np.minimum(deformed[:, 0], 0)


def sliding(deformed, direction, place):
    """Stripes that move over triangles which shrink."""
    return 30 * np.sin(12 * (place[:, 0] + 0.3 * np.minimum(deformed[:, 0] + deformed[:, 1], 0)))


def gloss(deformed, direction, place):
    """A light beside the cameras, mirrored where the ball is polished."""
    mirrored = direction - 2 * np.einsum("fi,fi->f", direction, place)[:, None] * place
    light = np.array([0.3, 0.4, 0.86])
    return 60 * np.clip(mirrored @ light, 0, 1) ** 3


def unlike_cameras():
    """Gain and offset (8, 3) of eight cameras, against their mean."""
    rng = default_rng(5)
    gain = rng.uniform(0.92, 1.08, (8, 3))
    offset = rng.normal(0, 3, (8, 3))
    return gain / gain.mean(0), offset - offset.mean(0)


@dataclass(frozen=True)
class Scene:
    """What to paint: gain (cameras, 3) and offset (cameras, 3) in levels, gain over time
    (timesteps, 3), what else colors depend on, the color behind the ball, how far timesteps deform
    it, by how many radians (timesteps,) they turn it, and by which share a window beside it lights
    what faces it more."""

    cameras: int = 8
    timesteps: int = 8
    paint: object = nothing
    gain: np.ndarray | None = None
    offset: np.ndarray | None = None
    drift: np.ndarray | None = None
    background: tuple[int, int, int] = (255, 255, 255)
    deformed: float = 1.0
    masks: bool = True
    turned: np.ndarray | None = None
    window: float = 0.0


def photograph(folder, scene):
    """Write the scene's images; every camera and timestep is for training."""
    ball = trimesh.creation.icosphere(3, 0.1)
    vertices = np.array(ball.vertices)
    faces = np.array(ball.faces, np.int32)
    rng = default_rng(0)
    place = vertices[faces].mean(1) / 0.1
    colors = _own_colors(place, rng)
    meshes = {t: _deform(vertices, t, scene.deformed) for t in range(scene.timesteps)}
    if scene.turned is not None:
        turns = Rotation.from_rotvec(np.outer(scene.turned, [0, 1, 0])).as_matrix()
        meshes = {t: mesh @ turns[t].T for t, mesh in meshes.items()}
    basis = strain_basis(vertices, faces)
    views = []
    for t, mesh in meshes.items():
        deformed = deformation(basis, mesh)
        for c in range(scene.cameras):
            camera = _camera(c, scene.cameras)
            away = mesh[faces].mean(1) - camera.position
            away /= np.linalg.norm(away, axis=1, keepdims=True)
            seen = colors + scene.paint(deformed, away, place)[:, None]
            a, b, c3 = mesh[faces].swapaxes(0, 1)
            normal = np.cross(b - a, c3 - a)
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            seen = seen * (1 + scene.window * normal @ WINDOW)[:, None]
            if scene.drift is not None:
                seen = seen * scene.drift[t]
            if scene.gain is not None:
                seen = seen * scene.gain[c]
            if scene.offset is not None:
                seen = seen + scene.offset[c]
            picture, mask = _draw(mesh, faces, camera, seen)
            noisy = picture + rng.normal(0, NOISE, picture.shape)
            image = np.where(mask[..., None] > 0, noisy, np.array(scene.background))
            views.append(_keep(folder, t, c, camera, image, mask if scene.masks else None))
    return Capture(
        folder,
        "mesh",
        faces,
        vertices,
        {"train": tuple(views)},
        tuple(meshes),
        {},
        meshes.__getitem__,
        lambda timestep, zero_pose: meshes[timestep],
    )


def own_colors(capture):
    """Levels (F, 3) of a painted capture's triangles, before whatever else colors depend on."""
    return _own_colors(capture.neutral[capture.faces].mean(1) / 0.1, default_rng(0))


def _own_colors(place, rng):
    return np.asarray(
        120 + 40 * np.sin(place @ rng.normal(0, 4, (3, 3))) + rng.uniform(-8, 8, (len(place), 1))
    )


def _deform(vertices, timestep, amount):
    """Waves along the surface, of another length and phase in every timestep."""
    rng = default_rng([7, timestep])
    moved = vertices.copy()
    for axis in range(3):
        waves = np.sin(vertices @ rng.normal(0, 30, 3) + rng.uniform(0, 6))
        moved[:, axis] += 0.004 * amount * waves * rng.uniform(0.5, 1)
    return moved


def _camera(number, count):
    angle = np.linspace(-0.9, 0.9, count)[number] if count > 1 else 0.0
    height = 0.3 * (-1) ** number
    x, z = np.cos(height) * np.array([np.sin(angle), np.cos(angle)])
    return look_at((x, np.sin(height), z), (0, 0, 0), SIZE, SIZE, FOCAL)


def _draw(mesh, faces, camera, colors):
    """Picture (SIZE, SIZE, 3) float and mask (SIZE, SIZE) uint8, drawn large and shrunk."""
    pixels, depth = camera.project(mesh)
    pixels = SUPERSAMPLED * pixels - 0.5
    large = (SUPERSAMPLED * SIZE, SUPERSAMPLED * SIZE)
    picture = Image.new("RGB", large)
    mask = Image.new("L", large)
    draw = ImageDraw.Draw(picture)
    cover = ImageDraw.Draw(mask)
    levels = np.clip(colors, 0, 255).round().astype(int)
    for face in np.argsort(-depth[faces].mean(1)).tolist():
        corners = pixels[faces[face]].ravel().tolist()
        draw.polygon(corners, fill=tuple(levels[face].tolist()))
        cover.polygon(corners, fill=255)
    blocks = (SIZE, SUPERSAMPLED, SIZE, SUPERSAMPLED)
    coverage = np.asarray(mask, float).reshape(blocks).mean((1, 3))
    color = np.asarray(picture, float).reshape(*blocks, 3).sum((1, 3))
    weight = np.maximum(coverage / 255 * SUPERSAMPLED**2, 1e-9)
    return color / weight[..., None], np.where(coverage > 127, 255, 0).astype(np.uint8)


def _keep(folder, t, c, camera, image, mask):
    name = f"{t:05d}_{c:02d}.png"
    Image.fromarray(np.clip(image, 0, 255).round().astype(np.uint8)).save(folder / name)
    view = View(t, c, camera, name, folder / name)
    if mask is None:
        return view
    Image.fromarray(mask).save(folder / f"mask_{name}")
    return replace(view, mask=folder / f"mask_{name}")
