"""What stands still behind a person: clean plates, splats, renderings, figures."""

import json
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from capture import factory
from command_line import refused, stga
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

from stga_addon.capture.camera import look_at
from stga_addon.capture.open import open_capture
from stga_addon.render.render import render
from stga_addon.training import world
from stga_addon.training.world import (
    CleanPlate,
    clean_plates,
    first_splats,
    shell_radius,
    trained_on,
)

WALL_M = 1.0
"""Behind the person, who is at the origin."""


def wall(camera, texture):
    """(H, W, 3): a textured wall at z = −WALL_M, one texel to a centimeter, by rays."""
    y, x = np.mgrid[: camera.height, : camera.width]
    origin = camera.position
    toward = camera.unproject(np.stack([x.ravel(), y.ravel()], 1) + 0.5, np.ones(x.size)) - origin
    at = origin + (-WALL_M - origin[2]) / toward[:, 2:] * toward
    texel = 100 * at[:, [1, 0]].T + 256
    colors = [map_coordinates(channel, texel, order=1, mode="wrap") for channel in texture.T]
    return np.stack(colors, 1).reshape(camera.height, camera.width, 3).astype(np.float32)


def camera_at(degrees):
    angle = np.radians(degrees)
    eye = (1.1 * np.sin(angle), 0.05, 1.1 * np.cos(angle))
    return look_at(eye, (0, 0, 0), width=120, height=160, focal_length=280)


def plates_of(texture):
    cameras = [camera_at(degrees) for degrees in (-24, -8, 8, 24)]
    seen = np.ones((160, 120), bool)
    return [CleanPlate(camera, wall(camera, texture), seen) for camera in cameras]


def test_a_wall_from_a_camera_that_did_not_see_it():
    """Catches a wall at a wrong distance, or right from the plates' cameras alone."""
    noise = np.random.default_rng(0).random((512, 512, 3))
    texture = gaussian_filter(noise, (4, 4, 0), mode="wrap")
    texture = (texture - texture.min()) / (texture.max() - texture.min())
    plates = plates_of(texture)
    center = np.zeros(3)
    assert shell_radius(plates, center) == pytest.approx(WALL_M, rel=0.1)
    splats = trained_on(plates, center)
    for camera, least in ((plates[0].camera, 27.0), (camera_at(0), 24.0)):
        error = render(splats, camera).transpose(1, 2, 0) - wall(camera, texture)
        assert -10 * np.log10((error**2).mean()) > least


def test_a_wall_of_one_color():
    """Catches a distance that is read from noise, a wall that is darker between its splats or at
    its border, and a search for larger blocks that never ends."""
    plates = plates_of(np.full((512, 512, 3), 0.6))
    assert shell_radius(plates, np.zeros(3)) == pytest.approx(3 * 1.1, rel=0.01)
    splats = trained_on(plates, np.zeros(3))
    assert all(abs(render(splats, plate.camera) - 0.6).max() < 0.02 for plate in plates)
    # a search for larger blocks ends where they are as large as they may be
    busy = plates_of(np.random.default_rng(0).random((512, 512, 3)))[:1] * 3
    with patch.object(world, "MAX_FIRST_SPLATS", 10):
        assert 10 < len(first_splats(busy, np.zeros(3))) < 500


WAVES = 50 * np.cos(np.arange(factory.WIDTH)[None, :, None] / 3)
STRIPES = (np.array([110, 90, 150]) + WAVES).round().astype(np.uint8)
"""(1, W, 3): what stands behind the ball, the same for every camera."""


@pytest.fixture(scope="module")
def walled(tmp_path_factory):
    """The toy's capture, its ball before stripes."""
    root = factory.write_mesh_capture(tmp_path_factory.mktemp("walled"), (0, 1, 3, 4), range(4))
    inside = factory.silhouette()[..., None]
    for path in (root / "images").iterdir():
        image = np.asarray(Image.open(path).convert("RGB"))
        Image.fromarray(np.where(inside, image, STRIPES)).save(path)
    return root


EFFECTS = ("--effect", "world=on", "--effect", "exposure=off")


@pytest.fixture(scope="module")
def run(walled, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "run"
    assert stga("train", walled, "--out", folder, "--iterations 60", *EFFECTS) == 0
    return folder


def test_plates_without_the_person(walled):
    """Catches a person who remains, a blurred wall, and holes without a color."""
    for plate in clean_plates(open_capture(walled)):
        stripes = np.broadcast_to(STRIPES, plate.image.shape) / 255
        assert 0.3 < plate.observed.mean() < 1
        assert not plate.observed[factory.silhouette()].any()
        np.testing.assert_allclose(plate.image[plate.observed], stripes[plate.observed], atol=1e-6)
        hidden = plate.image[~plate.observed]
        assert (hidden >= stripes.min((0, 1)) - 1e-6).all()
        assert (hidden <= stripes.max((0, 1)) + 1e-6).all()


def test_measured_with_the_world(walled, run, capsys, tmp_path):
    """Catches matted images' figures called whole ones, and a traceback without a world."""
    assert stga("eval", run, "--split train") == 0
    assert "in front of its world, against whole images as recorded" in capsys.readouterr().out
    found = json.loads((run / "quality_train.json").read_text())["psnr_recorded"]
    cameras = walled / "transforms_train.json"
    assert stga("render", run, "--world --cameras", cameras, "--out", run / "pictures") == 0
    errors = []
    for view in open_capture(walled).views["train"]:
        paths = run / "pictures" / Path(view.name).name, view.image
        rendered, recorded = (np.asarray(Image.open(path).convert("RGB")) / 255 for path in paths)
        errors.append(-10 * np.log10(((rendered - recorded) ** 2).mean()))
    assert found == pytest.approx(np.mean(errors), abs=0.05)
    assert found > 18
    avatar = tmp_path / "avatar.npz"
    cameras = walled / "transforms_test.json"
    avatar.write_bytes((run / "avatar.npz").read_bytes())
    asked = ("--world", "--capture", walled, "--cameras", cameras, "--out", tmp_path / "out")
    assert "world.ply: is missing; --world shows what a training with --effect world=on" in refused(
        capsys, "render", avatar, *asked
    )
    plain = factory.write_mesh_capture(tmp_path / "plain", (0, 1), range(3))
    told = refused(capsys, "train", plain, "--out", tmp_path / "run", "--iterations", "1", *EFFECTS)
    assert "world=on: is not possible, because what lies behind the person is of one color" in told
