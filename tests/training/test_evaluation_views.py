"""Which pixels count as head and as moving, against the toy's own geometry."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from capture import factory
from PIL import Image

from stga_addon.avatar.file import read_avatar
from stga_addon.capture.model import Capture
from stga_addon.training.evaluate.evaluation_views import (
    MAX_EVALUATION_VIEWS,
    choose_evaluation_views,
    read_evaluation_view,
    visible_pixels,
)
from stga_addon.training.evaluate.metrics import evaluate_avatar
from stga_addon.training.run.folder import Run
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.run.session import train

from .toys import quick_settings


def test_evaluation_views_are_evenly_spread(toy: Capture) -> None:
    """Catches evaluations while training that cost more than the training, or look at one end of
    the sequence."""
    view = toy.views["val"][0]
    many = tuple(replace(view, timestep=t) for t in range(100))
    chosen = [v.timestep for v in choose_evaluation_views(replace(toy, views={"val": many}))]
    assert len(chosen) == MAX_EVALUATION_VIEWS
    assert (chosen[0], chosen[-1]) == (0, 99)
    assert set(np.diff(chosen)) <= {6, 7}
    assert list(choose_evaluation_views(toy)) == list(toy.views["val"])


def test_regions_of_a_view(toy: Capture) -> None:
    """Catches a mask that is inverted, and a view in which nothing moves with a region for it."""
    still, *_, moving = (read_evaluation_view(toy, view) for view in toy.views["val"])
    np.testing.assert_array_equal(still.regions["mask"], factory.silhouette())
    assert "moving" not in still.regions  # timestep 0 is the neutral one
    where = moving.regions["moving"]
    assert where.any()
    # The ball's lower part moves, which is below in the image, and only the ball does.
    rows = np.flatnonzero(where.any(1))
    assert rows.min() > factory.CY
    assert (
        not (where & ~factory.silhouette())[:-1].any()
        or (where & ~factory.silhouette()).mean() < 0.02
    )
    assert not moving.target.flags.writeable


def test_interior_leaves_out_the_matte_s_border(toy: Capture, tmp_path: Path) -> None:
    """Catches an avatar that is chosen by the matte's border or the background, which differ from
    view to view."""
    view, size = toy.views["val"][0], 400
    camera = replace(view.camera, width=size, height=size)
    mask = np.zeros((size, size), np.uint8)
    mask[100:300, 100:300] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    Image.fromarray(np.repeat(mask[..., None], 3, 2)).save(tmp_path / "image.png")
    view = replace(view, camera=camera, image=tmp_path / "image.png", mask=tmp_path / "mask.png")
    interior = read_evaluation_view(toy, view).interior
    assert interior is not None
    rows, columns = np.nonzero(interior)
    # 0.75 % of 400 pixels
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (103, 296, 103, 296)
    assert interior.sum() > 0.99 * 194**2


def test_only_the_nearest_triangle_is_seen(toy: Capture) -> None:
    """Catches pixels of triangles on the far side of the head, which no camera sees."""
    view = toy.views["val"][0]
    mesh = toy.mesh(view.timestep)
    away = mesh[toy.faces].mean(1) - view.camera.position
    normals = np.cross(
        mesh[toy.faces[:, 1]] - mesh[toy.faces[:, 0]], mesh[toy.faces[:, 2]] - mesh[toy.faces[:, 0]]
    )
    behind = (away * normals).sum(1) > 0
    everything = visible_pixels(toy, view, np.ones(len(toy.faces), bool))
    # edges of the silhouette
    assert visible_pixels(toy, view, behind).sum() < 0.06 * everything.sum()
    assert visible_pixels(toy, view, ~behind).sum() > 0.94 * everything.sum()
    disc = factory.silhouette()
    assert (everything ^ disc).sum() < 0.08 * disc.sum()  # the ball is a polyhedron


def test_a_view_without_mask_has_no_head(toy: Capture, tmp_path: Path) -> None:
    """Catches a whole image taken for a head."""
    path = tmp_path / "plain.png"
    Image.fromarray(factory.picture(0, 0)).save(path)
    view = replace(toy.views["val"][0], image=path, mask=None)
    assert "mask" not in read_evaluation_view(toy, view).regions
    assert read_evaluation_view(toy, view).interior is None


def test_transparent_images_lie_over_the_settings_background(toy: Capture, tmp_path: Path) -> None:
    """Catches evaluations that compare a head over gray with one over white."""
    pixels = np.dstack([factory.picture(0, 0), factory.silhouette().astype(np.uint8) * 255])
    Image.fromarray(pixels).save(tmp_path / "cut.png")
    views = tuple(replace(view, image=tmp_path / "cut.png", mask=None) for view in toy.views["val"])
    capture = replace(toy, views={**toy.views, "val": views, "test": views})
    gray = (0.2, 0.4, 0.6)
    target = read_evaluation_view(capture, views[0], gray).target
    np.testing.assert_array_equal(target[0, 0], [51, 102, 153])
    settings = replace(
        quick_settings("global", lattice=0, iterations=2), background=gray, random_background=False
    )
    path = train(capture, tmp_path / "run", Run(toy.root, None, "vhap", settings))
    # behind the cameras: nothing but the background is rendered
    outside = np.ones(capture.neutral.shape) * 10
    avatar = read_avatar(path)
    empty = evaluate_avatar(avatar, replace(capture, mesh=lambda timestep: outside), "test")
    over_gray = np.where(
        factory.silhouette()[..., None], factory.picture(0, 0), np.round(255 * np.array(gray))
    )
    error = np.square(over_gray / 255 - np.array(gray)).mean()
    assert empty.psnr == pytest.approx(-10 * np.log10(error), abs=0.1)
    assert read_metrics(tmp_path / "run")[-1]["psnr"] > empty.psnr
