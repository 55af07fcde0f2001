"""Image quality against numpy and scipy: exposure, which pixels count, residuals."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from capture import factory
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from raster.reference import image_loss
from scipy.ndimage import gaussian_filter

from stga_addon.avatar.file import Avatar, read_avatar
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.avatar.splats import SH_C0
from stga_addon.capture.camera import Camera
from stga_addon.capture.images import read_image
from stga_addon.capture.model import View
from stga_addon.capture.selection import visible_pixels
from stga_addon.render.render import render_avatar
from stga_addon.training.evaluate.metrics import (
    MAX_EVALUATION_VIEWS,
    MIN_WEIGHT_PX,
    EvaluationView,
    Residuals,
    detail_difference,
    evaluate,
    evaluate_avatar,
    known_exposure,
    match_exposure,
    read_evaluation_view,
    triangle_residuals,
)
from stga_addon.training.optimize.image_preparation import image_preparation
from stga_addon.training.run.continuation import grouped_evaluation_views
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.run.session import train_run

from .toys import quick_settings, run_of

HEIGHT = 31
WIDTH = 24


def random_image(seed):
    return default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def reference_ssim(image, target, where=None):
    """Mean SSIM of (H, W, 3) images in 0…1."""
    pair = (torch.from_numpy(each).double().permute(2, 0, 1) for each in (image, target))
    values = image_loss(*pair)[1].numpy()
    return float(np.mean(values if where is None else values[:, where]))


def evaluation_views(*targets):
    """Of images (H, W, 3) uint8, each by a camera of its own."""
    found = []
    for number, target in enumerate(targets):
        height, width, _ = target.shape
        camera = Camera(width, height, 50.0, 50.0, 12.0, 15.0, np.eye(4))
        target.setflags(write=False)  # as it is read: Numba would compile again
        view = View(number, number, camera, f"{number}.png", Path())
        found.append(EvaluationView(view, target))
    return found


def test_evaluate_means_over_views_and_clips():
    """Catches PSNR of the mean error, of other axes, a peak of 255 or natural logarithms, an
    infinite one, another SSIM, and values over one counted double."""
    views = evaluation_views(*map(random_image, range(3)))
    noise = default_rng(9).normal(0.5, 0.5, (3, HEIGHT, WIDTH)).astype(np.float32)
    drawn = dict.fromkeys(("0.png", "1.png"), noise)
    drawn["2.png"] = (random_image(2).transpose(2, 0, 1) / 255).astype(np.float32)
    quality = evaluate(lambda view: drawn[view.name], views)
    pairs = [
        (np.clip(drawn[name], 0, 1).transpose(1, 2, 0).astype(float), each.target / 255)
        for name, each in zip(sorted(drawn), views, strict=True)
    ]
    psnrs = [-10 * np.log10(max(np.mean((a - b) ** 2), 1e-12)) for a, b in pairs]
    assert quality.psnr == pytest.approx(np.mean(psnrs), abs=1e-3)
    ssims = [reference_ssim(a, b) for a, b in pairs]
    assert quality.ssim == pytest.approx(np.mean(ssims), abs=1e-4)
    assert quality.lpips is None


def test_regions_are_measured_by_themselves():
    """Catches figures that depend on the rest of the image, and views without the region."""
    views = evaluation_views(random_image(0), random_image(1))
    where = np.zeros((HEIGHT, WIDTH), bool)
    where[4:24, 3:18] = True
    target = views[0].target
    rng = default_rng(3)
    inside = np.clip(target / 255 + rng.normal(0, 0.1, target.shape), 0, 1)
    good = np.where(where[..., None], inside, target / 255)
    bad = np.where(where[..., None], inside, rng.random(target.shape))
    views[0] = replace(views[0], regions={"mask": where})
    for image in (good, bad):
        drawn = np.moveaxis(image, 2, 0).astype(np.float32)
        quality = evaluate(lambda view, drawn=drawn: drawn, views)
        region = quality.regions["mask"]
        error = ((inside - target / 255) ** 2)[where]
        assert region.psnr == pytest.approx(-10 * np.log10(error.mean()), abs=1e-3)
        # The image's windows reach a few pixels out of the region, where both images are the same.
        outside = reference_ssim(good, target / 255, ~where)
        share = where.mean()
        lost = (1 - reference_ssim(good, target / 255, where)) + (1 - outside) * (1 - share) / share
        assert region.ssim == pytest.approx(1 - lost, abs=1e-4)
    assert set(quality.as_json()) == {"psnr", "ssim", "detail_difference", "psnr_mask", "ssim_mask"}


def expected(image, target, where):
    """By loops, for images (H, W, 3) in 0…1; edges repeat by reflection."""

    def windows(values, side):
        padded = np.pad(values, side // 2, mode="symmetric")
        return np.lib.stride_tricks.sliding_window_view(padded, (side, side))

    def local(rgb):
        near = windows(rgb.astype(np.float64) @ [0.299, 0.587, 0.114], 3)
        across = (near[..., 2].sum(-1) - near[..., 0].sum(-1)) / 3
        down = (near[..., 2, :].sum(-1) - near[..., 0, :].sum(-1)) / 3
        return windows(np.sqrt(across**2 + down**2), 7).mean((-1, -2))

    a = local(image)
    b = local(target)
    return float((abs(a - b) / (a + b + 0.02))[where].mean())


def test_against_the_formula():
    """Catches a wrong filter, window, channel weight or region."""
    rng = default_rng(0)
    image = gaussian_filter(rng.random((3, 24, 32), np.float32), (0, 1, 1))
    target = rng.integers(0, 256, (24, 32, 3), np.uint8)
    where = rng.random((24, 32)) < 0.3
    found = detail_difference(image, target, where)
    assert found == pytest.approx(expected(image.transpose(1, 2, 0), target / 255, where), rel=1e-3)
    assert found != detail_difference(image, target)
    same = np.ascontiguousarray(target.transpose(2, 0, 1), dtype=np.float32) / 255
    assert detail_difference(same, target) == pytest.approx(0, abs=1e-6)


SIDE = 32


def head_and_image():
    """A mask (H, W) bool and a rendering (3, H, W) float32 over white."""
    head = np.zeros((SIDE, SIDE), bool)
    head[6:26, 8:24] = True
    noise = default_rng(0).uniform(0.2, 0.7, (3, SIDE, SIDE))
    return head, np.where(head, noise, 1.0).astype(np.float32)


def test_training_images_lose_their_exposure(toy):
    """Catches images that are trained with the exposure that analysis has found, gain and offset
    swapped, mixed channels, and a background that changes."""
    head, image = head_and_image()
    gain = np.array([1.1, 0.9, 1.2])
    offset = np.array([5.0, -8.0, 2.0])
    levels = 255 * image.transpose(1, 2, 0)
    target = np.where(head[..., None], gain * levels + offset, levels).round().astype(np.uint8)
    prepare = image_preparation(toy, quick_settings(exposure=((0.0, *gain, *offset),)))
    view = evaluation_views(target)[0].view
    back, _ = prepare(view, target, np.uint8(255 * head))
    assert np.abs(back - levels).max() < 3


def test_a_rendering_of_one_color_stays_finite():
    """Catches a singular system, and a crash without a mask or pixels."""
    head, _ = head_and_image()
    flat = np.full((3, SIDE, SIDE), 0.5, np.float32)
    target = np.full((SIDE, SIDE, 3), 153, np.uint8)
    assert match_exposure(flat, target) == pytest.approx(0.6, abs=2e-3)
    assert np.array_equal(match_exposure(flat, target, head, np.zeros_like(head)), flat)


def test_nothing_is_fitted_where_the_exposure_is_known():
    """Catches six numbers fitted where training knows the exposure, which hides its errors."""
    head, image = head_and_image()
    gain = np.array([0.8, 1.1, 0.9])
    offset = np.array([4.0, -6.0, 3.0])
    levels = 255 * image.transpose(1, 2, 0)
    target = np.where(head[..., None], gain * levels + offset, levels).round().astype(np.uint8)
    views = evaluation_views(target, target, target)
    known = known_exposure([[0, *gain, *offset]], [each.view for each in views[:2]])
    shown = [[replace(each, regions={"mask": head}, interior=head)] for each in views]
    trained, plain, other = (evaluate(lambda _: image, each, exposure=known) for each in shown)
    assert trained.psnr > 45
    assert trained.psnr_unmatched is None
    assert plain.psnr == pytest.approx(evaluate(lambda view: image, views[:1]).psnr)
    assert plain.psnr_unmatched is None  # trained, and not corrected
    assert other.psnr > 45
    assert other.psnr_unmatched == other.as_json()["psnr_unmatched"] == pytest.approx(plain.psnr)
    assert other.regions["mask"].psnr > plain.regions["mask"].psnr + 20


def test_evaluation_views_are_evenly_spread(toy, monkeypatch):
    """Catches evaluations that cost too much, or look at one end of the sequence."""
    monkeypatch.setattr(
        "stga_addon.training.evaluate.metrics.read_evaluation_view",
        lambda capture, view, *rest: EvaluationView(view, np.zeros(0)),
    )

    def chosen_of(capture):
        run = run_of(capture)
        return [own.view for own in grouped_evaluation_views(run, capture, None)]

    view = toy.views["val"][0]
    many = tuple(replace(view, timestep=t) for t in range(100))
    chosen = [v.timestep for v in chosen_of(replace(toy, views={"val": many}))]
    assert len(chosen) == MAX_EVALUATION_VIEWS
    assert (chosen[0], chosen[-1]) == (0, 99)
    assert set(np.diff(chosen)) <= {6, 7}
    assert chosen_of(toy) == list(toy.views["val"])


def test_regions_of_a_view(toy, tmp_path):
    """Catches an inverted mask, a region where nothing moves, and a matte's border that counts."""
    still, *_, moving = (read_evaluation_view(toy, view) for view in toy.views["val"])
    assert_array_equal(still.regions["mask"], factory.silhouette())
    assert "moving" not in still.regions  # timestep 0 is the neutral one
    where = moving.regions["moving"]
    assert where.any()
    # The ball's lower part moves, which is below in the image, and only the ball does.
    rows = np.flatnonzero(where.any(1))
    assert rows.min() > factory.CY
    beside = where & ~factory.silhouette()
    assert not beside[:-1].any() or beside.mean() < 0.02
    assert not moving.target.flags.writeable
    view = toy.views["val"][0]
    size = 400
    camera = replace(view.camera, width=size, height=size)
    mask = np.zeros((size, size), np.uint8)
    mask[100:300, 100:300] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    Image.fromarray(np.repeat(mask[..., None], 3, 2)).save(tmp_path / "image.png")
    view = replace(view, camera=camera, image=tmp_path / "image.png", mask=tmp_path / "mask.png")
    interior = read_evaluation_view(toy, view).interior
    rows, columns = np.nonzero(interior)
    # 0.75 % of 400 pixels
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (103, 296, 103, 296)
    assert interior.sum() > 0.99 * 194**2
    # without a mask, the whole image is not taken for a head
    bare = read_evaluation_view(toy, replace(view, mask=None))
    assert "mask" not in bare.regions
    assert bare.interior is None


def test_only_the_nearest_triangle_is_seen(toy):
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


def test_transparent_images_lie_over_the_settings_background(toy, tmp_path):
    """Catches evaluations that compare a head over gray with one over white."""
    pixels = np.dstack([factory.picture(0, 0), factory.silhouette().astype(np.uint8) * 255])
    Image.fromarray(pixels).save(tmp_path / "cut.png")
    views = tuple(replace(view, image=tmp_path / "cut.png", mask=None) for view in toy.views["val"])
    capture = replace(toy, views={**toy.views, "val": views, "test": views})
    gray = (0.2, 0.4, 0.6)
    target = read_evaluation_view(capture, views[0], gray).target
    assert_array_equal(target[0, 0], [51, 102, 153])
    plain = {"background": gray, "random_background": False}
    run = run_of(capture, lattice=0, iterations=2, **plain)
    path = train_run(capture, tmp_path / "run", run).path
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


def plain_avatar(capture, level):
    """The capture's mesh in one gray; levels below zero are shown as black."""
    splats = lattice_splats(capture.neutral, capture.faces, 1, 0)
    sh = np.full_like(splats.sh, (level - 0.5) / SH_C0)
    return Avatar(replace(splats, sh=sh), "stga", capture.neutral.astype(np.float32), capture.faces)


def test_an_error_belongs_to_the_triangles_that_show_it(toy):
    """Catches weights that depend on colors, as a gradient does where a color is clamped at black,
    and errors given to hidden or neighboring triangles. The weights are rendered: one triangle
    white, all others black, before black."""
    avatar = plain_avatar(toy, -0.2)
    views = toy.views["train"][:2]
    found = triangle_residuals(avatar, toy, views)
    seen = np.flatnonzero(found.weight > 20)[::12]
    assert len(seen) > 3
    for triangle in seen:
        weight = error = 0.0
        for view in views:
            mesh = toy.mesh(view.timestep)
            shown = render_avatar(avatar, mesh, view.camera)
            difference = np.abs(shown - read_image(view).transpose(2, 0, 1) / 255).mean(0)
            white = np.where((avatar.splats.face == triangle)[:, None, None], 0.5, -0.5) / SH_C0
            sh = np.broadcast_to(white, avatar.splats.sh.shape).astype(np.float32)
            alone = replace(avatar, splats=replace(avatar.splats, sh=sh))
            share = render_avatar(alone, mesh, view.camera, (0.0, 0.0, 0.0))[0]
            weight = weight + float(share.sum())
            error = error + float((share * difference).sum())
        assert_allclose([found.weight[triangle], found.error[triangle]], [weight, error], rtol=2e-3)


def test_triangles_that_nothing_shows_are_unknown():
    """Catches a triangle called perfect because no camera sees it."""
    residuals = Residuals(np.array([1.0, 0.0, 3.0]), np.array([4.0, MIN_WEIGHT_PX / 2, 6.0]))
    assert_array_equal(residuals.mean(), [0.25, np.nan, 0.5])
    assert_array_equal((residuals + residuals).mean(), [0.25, 0.0, 0.5])
