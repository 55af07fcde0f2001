"""Mattes of a still person from all around keep the person and lose the room."""

import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_dilation

from stga_addon.capture.camera import look_at
from stga_addon.capture.mesh_geometry import silhouette
from stga_addon.capture.model import View
from stga_addon.tracking.footage.model import Footage, FootageCamera, ImageFrames, write_png
from stga_addon.tracking.visual_hull import cut_to_visual_hull

CAMERAS = 20
AWAY_PX = 12
"""Distance in pixels, 3 cm at the head, from which furniture must be gone."""
BALL = trimesh.creation.icosphere(subdivisions=3)
HEAD = np.asarray(BALL.vertices) * [0.08, 0.12, 0.1]
HAIR = np.asarray(BALL.vertices) * [0.1, 0.13, 0.12] + [0.0, 0.03, -0.02]


def camera_of(number):
    angle = 2 * np.pi * number / CAMERAS
    eye = (0.6 * np.sin(angle), 0.05, 0.6 * np.cos(angle))
    return look_at(eye, (0.0, 0.0, 0.0), 180, 240, 250.0)


def filmed(folder, with_mask=()):
    """Footage whose mattes have a box beside the head, and every tenth one no crown; where each
    matte shows the person, and where it shows furniture away from the person. with_mask: cameras
    whose mask is the footage's own."""
    rng = np.random.default_rng(3)
    cameras = []
    people = []
    boxes = []
    for number in range(CAMERAS):
        camera = camera_of(number)
        person = silhouette(HEAD, BALL.faces, camera) | silhouette(HAIR, BALL.faces, camera)
        box = np.zeros_like(person)
        row, column = rng.integers([20, 0], [180, 130])
        box[row : row + 40, column : column + 50] = True
        boxes.append(box & ~binary_dilation(person, np.ones((3, 3)), AWAY_PX))
        if number % 10 == 4:
            person[:70] = False
        people.append(person)
        path = folder / f"{number}.png"
        write_png(path, np.where(person | box, 255, 0).astype(np.uint8))
        frames = ImageFrames({0: View(0, number, camera, path.name, path)})
        mattes = {} if number in with_mask else {0: path}
        cameras.append(FootageCamera(path.stem, camera, frames, mattes=mattes))
    return Footage(folder, tuple(cameras)), people, boxes


def stored(folder):
    """Contents of the mattes in the folder."""
    paths = sorted(folder.glob("*.png"), key=lambda path: int(path.stem))
    return [path.read_bytes() for path in paths]


def test_furniture_beside_the_head_is_nobody(tmp_path):
    """Catches boxes of the room that stay in mattes, and a person that is cut with them, or where
    some mattes lack the crown."""
    footage, people, boxes = filmed(tmp_path)
    assert cut_to_visual_hull(footage, lambda camera: camera, HEAD) == ()
    shown = [camera.mask(0) > 127 for camera in footage.cameras]
    assert all((matte >= person).all() for matte, person in zip(shown, people, strict=True))
    left = sum((matte & box).sum() for matte, box in zip(shown, boxes, strict=True))
    assert left < 0.02 * sum(box.sum() for box in boxes)


@pytest.mark.parametrize(
    ("with_mask", "camera_for", "warned"),
    [
        ((), lambda camera: camera_of(0), True),
        ((3,), lambda camera: camera, False),
    ],
    ids=["wrong cameras", "masks of its own"],
)
def test_mattes_stay(tmp_path, with_mask, camera_for, warned):
    """Catches mattes that wrong cameras empty without a warning, and changes to those of footage
    with masks."""
    footage, _, _ = filmed(tmp_path, with_mask)
    before = stored(tmp_path)
    warnings = cut_to_visual_hull(footage, camera_for, np.add(HEAD, (0.0, 0.0, 0.3 * warned)))
    assert stored(tmp_path) == before
    assert any("do not agree" in warning for warning in warnings) == warned
