"""Colors that splats start with, on a ball whose triangles' colors are known."""

from dataclasses import replace

import numpy as np
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image, ImageDraw

from stga_addon.avatar.splats import SH_C0
from stga_addon.capture.camera import Camera
from stga_addon.capture.image_colors import triangle_colors
from stga_addon.capture.model import Capture, View
from stga_addon.training.optimize.initial_splats import initial_splats
from stga_addon.training.settings import make_settings

from .scenes import own_colors


def test_splats_start_with_the_colors_of_the_images(painted, monkeypatch):
    """Catches other triangles' colors, mixed channels, and one side's colors on the other."""
    capture = painted()
    splats = initial_splats(capture, make_settings(iterations=1, lattice=1, hull_points=False))
    found = 255 * (0.5 + SH_C0 * splats.sh[:, 0])
    error = np.abs(found - own_colors(capture)[splats.face]).max(axis=1)
    front = capture.neutral[capture.faces[splats.face]].mean(1)[:, 2] > 0.03
    assert front.mean() > 0.3
    assert np.median(error[front]) < 3
    assert np.percentile(error[front], 95) < 15
    assert not splats.sh[:, 1:].any()
    colors = triangle_colors(capture, capture.views["train"])
    monkeypatch.setattr("stga_addon.capture.image_colors.MIN_ONE_SIDED_FRACTION", 2.0)
    assert_array_equal(colors, triangle_colors(capture, capture.views["train"]))


def test_what_no_view_shows_has_the_nearest_color(painted):
    """Catches a gray back of the head, and a division by zero where nothing is seen."""
    capture = painted()
    colors = triangle_colors(capture, capture.views["train"][:1])
    center = capture.neutral[capture.faces].mean(1)
    direction = center - capture.views["train"][0].camera.position
    hidden = (direction * center).sum(1) > 0.005  # well behind the ball's outline
    assert hidden.mean() > 0.2
    shown = colors[~hidden]
    gap = np.abs(colors[hidden][:, None] - shown[None]).max(axis=2).min(axis=1)
    assert gap.max() < 1e-6  # a color that some visible triangle has
    assert np.abs(255 * colors[hidden] - 127.5).max() > 20
    views = [
        replace(view, camera=replace(view.camera, cx=-1000.0))
        for view in capture.views["train"][:2]
    ]
    assert_array_equal(triangle_colors(capture, views), 0.5)


def test_the_side_that_no_camera_sees_has_the_colors_of_its_mirror_image(painted):
    """Catches a far side of the outline's color, where the camera sees it worst."""
    capture = painted()
    views = [view for view in capture.views["train"] if view.camera_index == 0]
    center = capture.neutral[capture.faces].mean(1)
    towards = center @ views[0].camera.position / norm(center, axis=1)
    towards /= norm(views[0].camera.position)
    mirrored = norm(center[:, None] * [-1, 1, 1] - center[None], axis=2).argmin(axis=1)
    other = (towards < -0.2) & (towards[mirrored] > 0.5)
    assert other.mean() > 0.1
    colors = triangle_colors(capture, views)
    error = np.abs(255 * colors - own_colors(capture)[mirrored]).max(axis=1)
    assert np.median(error[other]) < 3


PLATES = {
    "lip": (0, 0, 60, 0.00, (200, 80, 80)),
    "tooth": (0, -10, 8, 0.02, (250, 240, 220)),
    "molar": (0, 12, 8, 0.004, (0, 0, 255)),
}
"""Center x, y and half the width in millimeters, depth behind the lip in meters, color."""


def test_teeth_behind_closed_lips_have_their_own_color(tmp_path):
    """Catches teeth that start, and where no image shows them stay, in the color of the lips."""
    capture = _mouth(tmp_path)
    found = np.split(255 * triangle_colors(capture, capture.views["train"]), 3)
    for colors, plate in zip(found, ("lip", "tooth", "tooth"), strict=True):
        assert_allclose(colors.mean(0), PLATES[plate][-1], atol=2)
    # without later timesteps, what is hidden has the nearest color
    colors = triangle_colors(capture, capture.views["train"][:1])
    assert_allclose(255 * colors, np.tile(PLATES["lip"][-1], (len(colors), 1)), atol=2)


def _mouth(folder):
    """Plates of two triangles each: a lip in front of a tooth, which is lifted in the second
    timestep far enough to show the tooth but not the molar, which is nearer to the lip than to the
    tooth."""
    camera = Camera(200, 200, 400.0, 400.0, 100.0, 100.0, np.eye(4))
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    plates = [
        np.column_stack([0.001 * (half * corner + (x, y)), np.full(4, 0.5 + behind)])
        for x, y, half, behind, _ in PLATES.values()
    ]
    neutral = np.concatenate(plates)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    lifted = neutral + np.array([[0, 0.06, 0]]) * (np.arange(12) < 4)[:, None]
    meshes = (neutral, lifted)
    views = []
    for timestep, mesh in enumerate(meshes):
        picture = Image.new("RGB", (200, 200), "white")
        for plate, (*_, color) in sorted(
            zip(np.split(mesh, 3), PLATES.values(), strict=True), key=lambda p: -p[0][0, 2]
        ):
            ImageDraw.Draw(picture).polygon(
                (camera.project(plate)[0] - 0.5).ravel().tolist(), fill=color
            )
        picture.save(folder / f"{timestep}.png")
        views.append(View(timestep, 0, camera, f"{timestep}.png", folder / f"{timestep}.png"))
    faces = np.concatenate([faces + 4 * n for n in range(3)]).astype(np.int32)
    return Capture(
        folder,
        "mesh",
        faces,
        neutral,
        {"train": tuple(views)},
        (0, 1),
        {},
        meshes.__getitem__,
        lambda timestep, zero_pose: meshes[timestep],
    )
