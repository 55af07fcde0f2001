"""Captures whose mesh misses their images: told, and read in the way that fits."""

import numpy as np
import pytest
from PIL import Image
from refusal import refusal

from stga_addon.capture.camera import GL_TO_CV
from stga_addon.capture.images import read_mask
from stga_addon.capture.open import open_capture, repair_capture
from stga_addon.capture.repairs import REPAIRS_FILE
from stga_addon.files import write_json

BOX_FACES = [
    *([0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4]),
    *([2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]),
]
SIZE = 60


def box():
    """(8, 3): a tall box in front of the origin, with which no turn by 90 degrees agrees."""
    # by x, y, z: the corners that BOX_FACES name
    grid = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)
    return grid * [0.1, 0.3, 0.16] + [-0.02, -0.05, 0.02]


def drawn(points, camera_to_world):
    """(H, W) bool: the convex hull of the points, by the pinhole's formula."""
    import cv2

    local = (points - camera_to_world[:3, 3]) @ camera_to_world[:3, :3]
    flat = local[:, :2] / -local[:, 2:] * [120, -120] + [33, 27]
    mask = np.zeros((SIZE, SIZE), np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.round(flat).astype(np.int32)), 1)
    return mask.astype(bool)


def orbit(angle):
    """Camera-to-world with OpenGL axes, looking at the box from one meter."""
    pose = np.eye(4)
    pose[:3, :3] = [
        [np.cos(angle), 0, np.sin(angle)],
        [0, 1, 0],
        [-np.sin(angle), 0, np.cos(angle)],
    ]
    pose[:3, 3] = 0.7 * pose[:3, 2]
    return pose


def write_capture(folder, change=lambda pose: pose, vertices=None, inverted=False, unit=1.0):
    """Four cameras around a box; the files say something else, as the arguments do."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for number, angle in enumerate((-0.5, 0.0, 0.4, 1.2)):
        pose = orbit(angle)
        mask = drawn(box(), pose)
        pixels = np.where(mask[..., None], np.uint8([180, 90, 40]), np.uint8(255))
        Image.fromarray(pixels).save(folder / f"images/{number}.png")
        Image.fromarray(np.uint8(255) * (mask ^ inverted)).save(folder / f"images/m{number}.png")
        written = change(pose)
        written[:3, 3] *= unit
        files = {"file_path": f"images/{number}.png", "fg_mask_path": f"images/m{number}.png"}
        timed = {"timestep_index": 0, "camera_index": number, "mesh_path": "head.obj"}
        frames.append({**files, **timed, "transform_matrix": written.tolist()})
    vertices = box() if vertices is None else vertices
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in unit * vertices]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in BOX_FACES]
    (folder / "head.obj").write_text("\n".join(lines) + "\n")
    lens = {"w": SIZE, "h": SIZE, "fl_x": 120, "cx": 33, "cy": SIZE - 27}
    write_json(folder / "transforms.json", {**lens, "frames": frames})
    return folder


def shows_box(capture):
    """Whether each view's mask is the box that its camera sees."""
    for view in capture.all_views:
        flat, _ = view.camera.project(capture.mesh(0))
        column, row = np.floor(flat).astype(int).T
        mask = read_mask(view)
        assert (mask[np.clip(row, 0, SIZE - 1), np.clip(column, 0, SIZE - 1)] > 0).mean() >= 0.5
        assert 0.02 < (mask > 127).mean() < 0.4


FILES = {
    "opencv-axes": {"change": lambda pose: pose @ GL_TO_CV},
    "world-to-camera": {"change": np.linalg.inv},
    "world-to-camera-opencv": {"change": lambda pose: np.linalg.inv(pose @ GL_TO_CV)},
    "masks-inverted": {"inverted": True},
    "z-up": {"vertices": box() @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])},
    "z-down": {"vertices": box() @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])},
    "y-down": {"vertices": box() * [1, -1, -1]},
}
"""Repair -> files that need it, written by formulas of this test."""


@pytest.mark.parametrize("name", FILES)
def test_a_mesh_that_misses_its_images(tmp_path, name):
    """Catches a capture of other axes, inverse matrices, another up or inverted masks that trains
    to nothing, without a warning; a repair that is not named, not kept, or not the right one."""
    root = write_capture(tmp_path / "capture", **FILES[name])
    (warning,) = [text for text in open_capture(root).warnings if "--repair" in text]
    assert f"({name})" in warning
    assert name in (repair_capture(root) and (root / REPAIRS_FILE).read_text())
    again = open_capture(root)
    assert any("read as repaired" in text for text in again.warnings)
    assert repair_capture(root) is None
    shows_box(again)


@pytest.mark.parametrize(("unit", "word"), [(100.0, "centimeters"), (1000.0, "millimeters")])
def test_other_units(tmp_path, unit, word):
    """Catches a head in centimeters that is trained as one of 30 m: thresholds are in meters."""
    capture = open_capture(write_capture(tmp_path / "capture", unit=unit))
    assert any(f"read as {word}" in text for text in capture.warnings)
    np.testing.assert_allclose(np.ptp(capture.neutral, axis=0), [0.1, 0.3, 0.16], atol=1e-5)
    np.testing.assert_allclose(capture.all_views[1].camera.position, [0, 0, 0.7], atol=1e-6)
    shows_box(capture)


@pytest.mark.parametrize("size", [(30, 30), (121, 120)])
def test_images_of_another_size_than_the_cameras(tmp_path, size):
    """Catches a calibration at another size that is refused, or trained with its own focal length;
    images of another shape that are scaled to it."""
    root = write_capture(tmp_path / "capture")
    before = open_capture(root).all_views[0].camera
    for path in (root / "images").iterdir():
        Image.open(path).resize(size).save(path)
    capture = open_capture(root)
    (warning,) = [text for text in capture.warnings if "its camera" in text]
    assert f"has {size[0]} x {size[1]} pixels, its camera 60 x 60" in warning
    camera = capture.all_views[0].camera
    points = capture.mesh(0)
    expected = (before.project(points)[0]) * np.array(size) / SIZE
    np.testing.assert_allclose(camera.project(points)[0], expected)
    assert read_mask(capture.all_views[0]).shape == size[::-1]
    for path in (root / "images").iterdir():
        Image.open(path).resize((80, 60)).save(path)
    with refusal("has 80 x 60 pixels"):
        read_mask(open_capture(root).all_views[0])


def test_what_fits_is_left_as_it_is(tmp_path):
    """Catches a warning about a capture in order, and repairs of other names taken for none."""
    root = write_capture(tmp_path / "capture")
    assert repair_capture(root) is None
    assert not (root / REPAIRS_FILE).exists()
    assert not any("beside the mesh" in text for text in open_capture(root).warnings)
    write_json(root / REPAIRS_FILE, {"repairs": ["magic"]})
    with refusal("repairs: expected some of opencv-axes"):
        open_capture(root)
