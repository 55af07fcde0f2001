"""Images without what lies behind the head: by masks, by the mesh, over random colors."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from scipy.ndimage import binary_dilation, binary_erosion

from stga_addon.capture.camera import camera_from_gl
from stga_addon.capture.images import read_image, read_mask, read_view
from stga_addon.capture.mesh_geometry import rasterize
from stga_addon.capture.model import View
from stga_addon.raster.cpu.image_loss import change_background
from stga_addon.raster.cpu.rasterize import frames_in_camera
from stga_addon.training.evaluate.metrics import read_evaluation_view
from stga_addon.training.optimize.backend import RenderOptions
from stga_addon.training.optimize.image_preparation import (
    image_preparation,
    over_color,
    without_backdrop,
)
from stga_addon.training.optimize.trainer import Trainer
from stga_addon.training.schedule import view_order
from stga_addon.training.settings import make_settings

from .toys import quick_settings

SIZE = 80
GREEN = (0.0, 1.0, 0.0)


def room():
    """(SIZE, SIZE, 3) levels of a wall in shades and colors."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    return np.stack([60 + 120 * x, 200 - 100 * y, 90 + 60 * np.sin(3 * x + 2 * y)], -1)


def person():
    """Levels (SIZE, SIZE, 3), and coverage in 0…1 with an edge of six pixels, as of hair."""
    y, x = np.mgrid[:SIZE, :SIZE]
    distance = np.hypot(x - 38, y - 42)
    return np.stack([70 + x, 40 + 0.5 * y, 30 + 0 * x], -1), np.clip((26 - distance) / 6, 0, 1)


def test_soft_edge_keeps_no_wall():
    """Catches a rim of the wall's color, as plain blending has: against the true foreground."""
    colors, cover = person()
    alpha = cover[..., None]
    mask = (255 * cover).round().astype(np.uint8)
    image = (alpha * colors + (1 - alpha) * room()).round().astype(np.uint8)
    expected = alpha * colors + (1 - alpha) * 255 * np.array(GREEN)
    error = np.abs(over_color(image, mask, GREEN) - expected)
    blended = np.abs(alpha * image + (1 - alpha) * 255 * np.array(GREEN) - expected)
    assert error.max() < 6
    assert blended.max() > 25


@pytest.mark.parametrize("screen", [[70, 160, 105], [30, 60, 170]])
def test_the_light_of_a_screen_is_taken_away(screen, tmp_path):
    """Catches a green rim on hair and ears of a person before a green screen. Before a meadow, of
    the same light, and far from the outline, colors stay."""
    key = int(np.argmax(screen))
    hair, cover = person()
    hair[:] = 60
    alpha = cover[..., None]
    y, x = np.mgrid[:SIZE, :SIZE]
    middle = np.hypot(x - 38, y - 42) < 6
    spilt = hair + 0.2 * (np.array(screen) - np.delete(screen, key).max()) * (np.arange(3) == key)
    badge = np.where(np.arange(3) == key, 200.0, 60.0)
    colors = np.where(middle[..., None], badge, spilt)
    mask = (255 * cover).round().astype(np.uint8)
    wild = np.random.default_rng(0).uniform(-120, 120, (SIZE, SIZE, 1))
    camera = camera_from_gl(np.eye(4), (SIZE, SIZE), (100, 100), (SIZE / 2, SIZE / 2))
    Image.fromarray(mask).save(tmp_path / "mask.png")
    for noise in (0, wild):
        backdrop = np.clip(np.array(screen) + noise, 0, 255)
        image = (alpha * colors + (1 - alpha) * backdrop).round().astype(np.uint8)
        Image.fromarray(image).save(tmp_path / "image.png")
        view = View(0, 0, camera, "image", tmp_path / "image.png", tmp_path / "mask.png")
        _, found, _ = read_view(view)
        rim = (cover == 1) & ~binary_erosion(cover == 1, iterations=3)
        expected = hair if not np.any(noise) else spilt
        assert_allclose(found[rim], expected[rim], atol=1)
        assert_array_equal(found[middle], image[middle])
        over = over_color(found, mask, (0, 0, 0))
        edge = (cover > 0.3) & (cover < 0.9)
        excess = (over[..., key].astype(int) - np.delete(over, key, 2).max(2))[edge]
        assert (excess.max() <= 1) == (not np.any(noise))


@pytest.mark.parametrize("level", [0, 255])
def test_masks_of_one_value(level):
    """Catches a division by zero where a mask shows nothing or everything."""
    image = room().astype(np.uint8)
    expected = image if level else np.broadcast_to(255 * np.array(GREEN), image.shape)
    assert_array_equal(over_color(image, np.full((SIZE, SIZE), level, np.uint8), GREEN), expected)


def same_but_for_the_edge(found, expected):
    """Whether both are the same but for two pixels outside of the outline, or one inside."""
    near = binary_dilation(expected, np.ones((5, 5)))
    core = binary_erosion(expected, np.ones((3, 3)))
    return bool(core.any() and not near.all() and (found <= near).all() and (found >= core).all())


def in_a_room(capture, folder, keeps_masks):
    """The capture with stripes in place of its background."""

    def repaint(view):
        _, image, mask = read_view(view)
        x = np.arange(image.shape[1])[:, None]
        stripes = np.where(x % 6 < 3, (20, 160, 180), (200, 40, 90))
        name = f"{view.timestep}_{view.camera_index}.png"
        alpha = mask[..., None] / 255
        picture = image - (1 - alpha) * 255 + (1 - alpha) * stripes
        Image.fromarray(np.clip(picture, 0, 255).round().astype(np.uint8)).save(folder / name)
        Image.fromarray(mask).save(folder / f"mask_{name}")
        return replace(
            view, image=folder / name, mask=folder / f"mask_{name}" if keeps_masks else None
        )

    views = {
        split: tuple(repaint(view) for view in members) for split, members in capture.views.items()
    }
    return replace(capture, views=views)


def test_what_is_trained_and_evaluated_is_what_masks_show(toy, tmp_path):
    """Catches a wall in training images or evaluations: the same as of the plain capture."""
    walled = in_a_room(toy, tmp_path, keeps_masks=True)
    settings = make_settings(iterations=1, backdrop="masked")
    prepare = image_preparation(walled, settings)
    for plain, view in zip(toy.views["val"], walled.views["val"], strict=True):
        _, expected, mask = read_view(plain)
        trained, kept = prepare(*read_view(view))
        inside = (mask == 0) | (mask == 255)
        assert np.abs(trained.astype(int) - expected)[inside].max() <= 1
        assert_array_equal(kept, mask)
        assert_array_equal(read_evaluation_view(walled, view, backdrop="masked").target, trained)
    assert image_preparation(walled, replace(settings, backdrop="plain")) is None


def test_without_masks_the_mesh_is_the_mask(toy, tmp_path):
    """Catches a wall beside the mesh, and a head taken away: against the depth buffer."""
    walled = in_a_room(toy, tmp_path, keeps_masks=False)
    view = walled.views["train"][0]
    small, image, mask = read_view(view, 0.7)
    found, made = without_backdrop(walled, small, image, mask, "mesh", GREEN)
    mesh = rasterize(np.asarray(walled.mesh(view.timestep)), walled.faces, small.camera)[0] >= 0
    assert same_but_for_the_edge(made > 0, mesh)
    assert_array_equal(found[made == 0], np.broadcast_to([0, 255, 0], found[made == 0].shape))
    assert_array_equal(found[made == 255], image[made == 255])


def test_exchanged_background_is_the_composite_over_the_new_one():
    """Catches a wrong sign or scale: against blending the foreground itself."""
    rng = np.random.default_rng(0)
    foreground = rng.integers(0, 256, (9, 7, 3))
    coverage = rng.integers(0, 256, (9, 7)).astype(np.uint8)
    alpha = coverage[..., None] / 255
    before = np.array([255, 255, 255], np.float32)
    after = np.array([20, 130, 240], np.float32)
    image = np.rint(foreground * alpha + before * (1 - alpha)).astype(np.uint8)
    out = np.empty_like(image)
    change_background(image, coverage, before, after, out)
    expected = foreground * alpha + after * (1 - alpha)
    # Half a gray level was lost when `image` was rounded, half is lost again.
    assert np.abs(out - expected).max() <= 1.01


def transmittance_error(capture, random_background):
    """Mean square of held-out alpha − mask, trained shortly on a white head before white."""
    trainer = Trainer(
        capture, quick_settings("global", lattice=1, random_background=random_background), {}
    )
    for n, view in zip(range(150), view_order(capture.views["train"], 1, 0), strict=False):
        trainer.step(view, np.full_like(read_image(view), 255), n / 150, read_mask(view))
    errors = []
    for view in capture.views["val"]:
        splats = trainer.state.parameters
        seen = frames_in_camera(trainer.frames.of(view.timestep), view.camera)
        options = RenderOptions(np.zeros(3, np.float32), 0)
        rendering = trainer._backend._forward(splats, seen, options)
        mask = read_mask(view)
        errors.append(np.mean((1 - rendering.transmittance - mask / 255) ** 2))
    return float(np.mean(errors))


def test_alpha_becomes_the_mask(toy):
    """Catches a white fringe of splats, and a random background where no mask takes it away."""
    assert transmittance_error(toy, random_background=True) < 0.6 * transmittance_error(
        toy, random_background=False
    )
    view = toy.views["train"][0]
    states = []
    for random_background in (True, False):
        trainer = Trainer(toy, quick_settings("global", random_background=random_background), {})
        trainer.step(view, read_image(view), 0.0)
        states.append(trainer.state.splats().sh)
    assert_array_equal(*states)
