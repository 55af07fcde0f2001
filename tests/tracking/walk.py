"""A still head in a room, filmed by a camera that walks around it."""

import numpy as np

from stga_addon.capture.camera import look_at
from stga_addon.capture.mesh_geometry import rasterize
from stga_addon.flame.parts import flame_model
from stga_addon.tracking.correspondence import head_colors, shaded_image

SIZE = 256
FOCAL = 400.0
ROOM_M = 1.6
WAVES = 40


def walk(count, degrees=70.0, distance=0.75):
    """Cameras on an arc around the head, the middle one in front, up and down by a step."""
    center = flame_model(None).v_template.mean(0)
    cameras = []
    for number, angle in enumerate(np.radians(np.linspace(-degrees / 2, degrees / 2, count))):
        eye = distance * np.array([np.sin(angle), 0.1 * np.sin(2.0 * number), np.cos(angle)])
        cameras.append(look_at(center + eye, center, SIZE, SIZE, FOCAL))
    return cameras


def _pattern(points, longest, seed):
    """0 to 1, (N,): waves of lengths between `longest` and an eighth of it."""
    random = np.random.default_rng(seed)
    lengths = longest / np.geomspace(1, 8, WAVES)
    waves = random.standard_normal((WAVES, 3))
    waves *= (2 * np.pi / lengths / np.linalg.norm(waves, axis=1))[:, None]
    phases = random.uniform(0, 2 * np.pi, WAVES)
    return np.clip(0.5 + 0.5 * np.sin(points @ waves.T + phases).sum(1) / np.sqrt(WAVES), 0, 1)


def picture(camera, turn=None, plain=False):
    """(H, W, 3) uint8: freckled skin before a room, a sphere of ROOM_M around the origin.

    turn: (3, 3) of the head alone; plain: without a pattern."""
    model = flame_model(None)
    center = model.v_template.mean(0)
    turn = np.eye(3) if turn is None else turn
    posed = (model.v_template - center) @ turn.T + center
    image = shaded_image(posed, model.faces, camera, head_colors(model)) / 255
    if plain:
        return (255 * image).astype(np.uint8)
    triangle, weights = rasterize(posed, model.faces, camera)
    seen = triangle >= 0
    on_skin = model.v_template[model.faces[triangle[seen]]] * weights[seen][..., None]
    image[seen] *= 0.75 + 0.4 * _pattern(on_skin.sum(1), 0.03, 1)[:, None]
    rows, columns = np.nonzero(~seen)
    pixels = np.stack([columns, rows], axis=1) + 0.5
    away = camera.unproject(pixels, np.ones(len(pixels))) - camera.position
    away /= np.linalg.norm(away, axis=1)[:, None]
    along = away @ camera.position
    far = -along + np.sqrt(along**2 + ROOM_M**2 - camera.position @ camera.position)
    wall = camera.position + far[:, None] * away
    image[rows, columns] = (0.2 + 0.6 * _pattern(wall, 0.5, 2))[:, None] * [0.4, 0.7, 1.0]
    return (255 * np.clip(image, 0, 1)).astype(np.uint8)
