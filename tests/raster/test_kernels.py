"""The CPU kernels against the float64 reference: images, and gradients under random cotangents."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from raster import reference
from stga_addon.avatar.embedding import WORLD, face_frames
from stga_addon.avatar.splats import SH_C0
from stga_addon.capture.camera import Camera
from stga_addon.raster.cpu.autograd import render_differentiable
from stga_addon.raster.cpu.layout import Parameters
from stga_addon.raster.cpu.rasterize import (
    frames_in_camera,
    render_backward,
    render_forward,
)
from stga_addon.raster.cpu.threads import set_threads, threads

NAMES = Parameters._fields[:5]
# Kernels compute in float32 with a polynomial exp; a pixel sums up to a hundred terms below 1.
IMAGE_TOLERANCE = 1e-5
# Depth is that sum times distances of a few meters.
DEPTH_TOLERANCE = 4e-5
# Gradients: largest error over the largest gradient of that quantity in the scene.
# Color is a plain weighted sum. Opacity and the geometry come through (1 − alpha) divisions and the
# inverse 2D covariance, whose float32 conditioning worsens with the splats' anisotropy.
GRADIENT_TOLERANCE = {"sh": 1e-5, "opacity": 2e-5, "xyz": 2e-5, "rotation": 2e-5, "log_scale": 5e-5}


@dataclass(frozen=True)
class Scene:
    splats: dict[str, np.ndarray]
    camera: Camera
    degree: int = 3


def random_pose(rng):
    """(4, 4) world to camera: any rotation, the world's origin four meters ahead."""
    axes, upper = np.linalg.qr(rng.normal(size=(3, 3)))
    axes *= np.sign(np.diag(upper))
    axes[0] *= np.linalg.det(axes)
    pose = np.eye(4)
    pose[:3, :3] = axes
    pose[:3, 3] = [0.1, -0.2, 4.0]
    return pose


def cloud(
    seed,
    count=60,
    size=(50, 37),
    degree=3,
    spread=0.8,
    log_scale=-2.0,
    logit=0.0,
    zoom=1.0,
    shift=(0.0, 0.0),
):
    """`count` random splats around the origin; the image is wide enough to hold most of them at
    zoom 1."""
    rng = default_rng(seed)
    width, height = size
    focal = zoom * 1.5 * max(width, height)
    splats = {
        "xyz": rng.normal(size=(count, 3)) * spread,
        "rotation": rng.normal(size=(count, 4)) * rng.uniform(0.2, 5, (count, 1)),
        "log_scale": rng.normal(size=(count, 3)) * 0.5 + log_scale,
        "opacity": rng.normal(size=count) * 1.5 + logit,
        "sh": rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.4,
    }
    center = width / 2 + shift[0], height / 2 + shift[1]
    camera = Camera(width, height, focal, focal * 1.1, *center, random_pose(rng))
    return Scene({name: value.astype(np.float32) for name, value in splats.items()}, camera, degree)


SCENES = {
    "plain": cloud(1),
    "degree 2": cloud(2, degree=2),
    "degree 1": cloud(3, degree=1),
    "degree 0": cloud(4, degree=0),
    "lower degree than stored": replace(cloud(5), degree=1),
    "one pixel": cloud(6, size=(1, 1), log_scale=-0.5),
    "one row": cloud(7, size=(33, 1)),
    "one column": cloud(8, size=(1, 50)),
    "exact tiles": cloud(9, size=(32, 16)),
    "one more than a tile": cloud(10, size=(17, 33)),
    "off center": cloud(11, shift=(13.3, -9.1)),
    "around the camera": cloud(12, spread=4.0),
    "mostly off screen": cloud(13, spread=1.5, zoom=2.0, log_scale=-1.0),
    "covering everything": cloud(14, count=12, log_scale=0.7, logit=-2.0),
    "opaque layers": cloud(15, count=100, log_scale=-1.0, logit=6.0),
    "smaller than a pixel": cloud(16, log_scale=-7.0, logit=3.0),
    "faint": cloud(18, logit=-4.0),
    "dark": replace(cloud(19), splats=cloud(19).splats | {"sh": cloud(19).splats["sh"] - 0.5}),
    "single": cloud(20, count=1, spread=0.0, log_scale=-1.0, logit=2.0),
    "many layers": cloud(30, count=700, size=(40, 40), log_scale=-1.5, logit=-3.0),
    # which the GPU cuts
    "long lists": cloud(31, count=2600, size=(20, 18), log_scale=-1.0, logit=-5.0),
    "long lists, closed": cloud(32, count=1500, size=(20, 18), log_scale=-1.0, logit=-2.5),
}


def reference_gradients(
    scene, cotangents, frames=None, face=None, antialiased=False, near=reference.NEAR_M
):
    """Images and gradients of the float64 reference for the very numbers that the kernels get; of
    world-space splats, or in the frames of the triangles face (N,)."""
    tensors = {n: torch.from_numpy(a).double().requires_grad_() for n, a in scene.splats.items()}
    placed = [tensors[name] for name in NAMES]
    if frames is not None:
        placed[:3] = reference.embed(*placed[:3], frames, torch.from_numpy(face).long())
        if frames.color.shape[1]:
            shift = torch.from_numpy(frames.color[face]).double() / SH_C0
            rest = placed[4].shape[1] - 1
            placed[4] = placed[4] + torch.nn.functional.pad(shift[:, None], (0, 0, 0, rest))
    images = reference.render(*placed, scene.camera, scene.degree, near, antialiased)
    return finish(images, cotangents, tensors)


def kernel_gradients(scene, cotangents, frames=WORLD, face=None, antialiased=False):
    """The same of the kernels."""
    tensors = {n: torch.from_numpy(a).clone().requires_grad_() for n, a in scene.splats.items()}
    images = render_differentiable(
        Parameters(**tensors), scene.camera, frames, face, scene.degree, antialiased
    )
    return finish(images, cotangents, tensors)


def finish(images, cotangents, tensors):
    loss = sum(
        (image * v.to(image.dtype)).sum() for image, v in zip(images, cotangents, strict=True)
    )
    gradients = torch.autograd.grad(loss, list(tensors.values()))
    found = dict(zip(tensors, (g.numpy() for g in gradients), strict=True))
    return [image.detach().numpy() for image in images], found


def random_cotangents(camera, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shape = (camera.height, camera.width)
    return [
        torch.randn(s, generator=generator, dtype=torch.float64)
        for s in ((3, *shape), shape, shape)
    ]


def assert_images_agree(images, expected):
    tolerances = {"rgb": IMAGE_TOLERANCE, "alpha": IMAGE_TOLERANCE, "depth": DEPTH_TOLERANCE}
    for (name, tolerance), image, want in zip(tolerances.items(), images, expected, strict=True):
        assert_allclose(image, want, rtol=0, atol=tolerance, err_msg=name)


def assert_gradients_agree(gradients, expected):
    for name, want in expected.items():
        largest = np.abs(want).max()
        error = np.abs(gradients[name] - want).max() / max(largest, 1e-6)
        assert error < GRADIENT_TOLERANCE[name], f"{name}: {error:.2e} of {largest:.2e}"


def assert_reference_agrees(scene, *given, **options):
    """The kernels' images, which are the reference's, as their gradients are."""
    images, gradients = kernel_gradients(scene, *given, **options)
    expected_images, expected_gradients = reference_gradients(scene, *given, **options)
    assert_images_agree(images, expected_images)
    assert_gradients_agree(gradients, expected_gradients)
    return images


@pytest.mark.parametrize("name", SCENES)
def test_image_and_gradients_are_the_references(back_end, name):
    """Catches any error in projection, harmonics, tile bounds, blending or their derivatives, one
    scene a trap."""
    images = assert_reference_agrees(SCENES[name], random_cotangents(SCENES[name].camera))
    assert any(image.any() for image in images), "the scene shows nothing"


@pytest.mark.parametrize("convention", ["stga", "gaussian_avatars"])
def test_embedded_splats_render_and_train_in_their_frames(back_end, convention):
    """Catches a kernel that turns, scales or differentiates in the wrong frame, color of the wrong
    triangle or in the wrong unit, and a gradient that misses the clamp."""
    scene = SCENES["dark"]
    rng = default_rng(30)
    vertices = rng.normal(size=(12, 3)) * 0.6
    faces = rng.permuted(np.tile(np.arange(12), (9, 1)), axis=1)[:, :3]
    neutral = vertices + rng.normal(size=vertices.shape) * 0.2
    color = rng.normal(0, 0.3, (len(faces), 3)).astype(np.float32)
    frames = replace(face_frames(vertices, faces, neutral, convention), color=color)
    face = rng.integers(0, len(faces), len(scene.splats["xyz"])).astype(np.int32)
    scene = replace(scene, splats=scene.splats | {"xyz": 0.3 * scene.splats["xyz"]})
    assert_reference_agrees(scene, random_cotangents(scene.camera, 2), frames, face)


def raw_gradients(scene, fill=0.0, buffers=None, **options):
    """Forward and backward of numpy arrays: rendering, gradients whose untouched rows keep `fill`,
    and rows.

    background, focus and reach are `render_forward`'s. The cotangents are of color and alpha.
    """
    splats = Parameters(*(scene.splats[name] for name in NAMES))
    face = np.zeros(len(splats.xyz), np.int32)
    camera_frames = frames_in_camera(WORLD, scene.camera)
    rendering = render_forward(
        splats, face, camera_frames, scene.degree, buffers=buffers, **options
    )
    v_image, v_alpha, _ = (v.float().numpy() for v in random_cotangents(scene.camera, 3))
    gradients = Parameters(*(np.full_like(a, fill) for a in splats if a is not None))
    rows, screen = render_backward(
        rendering, splats, face, camera_frames, v_image, gradients, -v_alpha, buffers
    )
    return rendering, gradients, rows, screen


def test_background_shows_through_and_pulls_on_the_splats():
    """Catches a background left out of the image, of its gradient, or counted twice."""
    scene = SCENES["plain"]
    background = np.float32([0.9, 0.2, 0.6])
    rendering, gradients, _, _ = raw_gradients(scene, background=background)
    v_image, v_alpha, _ = random_cotangents(scene.camera, 3)
    behind = torch.from_numpy(background)[:, None, None]
    cotangents = [v_image, v_alpha - (behind * v_image).sum(0), 0 * v_alpha]
    (rgb, alpha, _), expected = reference_gradients(scene, cotangents)
    image = rgb + background[:, None, None] * (1 - alpha)
    assert np.abs(rendering.image - image).max() < IMAGE_TOLERANCE
    assert np.abs(1 - rendering.transmittance - alpha).max() < IMAGE_TOLERANCE
    assert_gradients_agree(gradients._asdict(), expected)


def test_screen_gradient_is_that_of_the_projected_center():
    """Catches density control fed with pixels, or with the gradient of something else: half images,
    by both axes."""
    scene = cloud(25, count=40, size=(60, 35))
    *placed, opacity, sh = (torch.from_numpy(scene.splats[name]).double() for name in NAMES)
    moved_px = torch.zeros(40, 2, dtype=torch.float64, requires_grad=True)
    order, alphas, depth = reference.layers(
        *placed, torch.sigmoid(opacity), scene.camera, moved_px=moved_px
    )
    color = reference.sh_color(sh, placed[0] - torch.from_numpy(scene.camera.position), 3)
    rgb, alpha, _ = reference.blend(alphas, color[order], depth)
    v_image, v_alpha, _ = random_cotangents(scene.camera, 3)
    gradient = torch.autograd.grad((rgb * v_image).sum() + (alpha * v_alpha).sum(), moved_px)[0]
    expected = np.hypot(gradient[:, 0] * 60 / 2, gradient[:, 1] * 35 / 2)
    _, _, rows, screen = raw_gradients(scene)
    assert len(rows) > 20
    assert_allclose(screen[rows], expected[rows], atol=GRADIENT_TOLERANCE["xyz"] * expected.max())


@pytest.mark.parametrize("name", ["plain", "smaller than a pixel", "around the camera", "degree 1"])
def test_antialiasing_takes_what_the_low_pass_adds(back_end, name):
    """Catches a compensation of the wrong determinant, and gradients that leave it out: scale,
    rotation, position."""
    scene = SCENES[name]
    cotangents = random_cotangents(scene.camera, 6)
    images = assert_reference_agrees(scene, cotangents, antialiased=True)
    plain, _ = kernel_gradients(scene, cotangents)
    assert np.abs(plain[1] - images[1]).max() > 0.01, "antialiasing changes nothing"


@pytest.mark.parametrize("count", [80, 900])
def test_focused_rendering_gives_selected_rows_the_full_images_gradient(count):
    """Catches a local iteration whose restricted tiles change the gradient of a selected splat,
    frozen splats in front of it or behind that are left out where it reaches, and a backward pass
    that touches, or zeroes, the gradient rows of frozen splats."""
    scene = cloud(21, count=count, size=(100, 70), log_scale=-3.0)
    xyz = scene.splats["xyz"]
    focus = (
        np.isin(np.arange(80), [3, 17, 40])
        if count == 80
        else np.linalg.norm(xyz - xyz[3], axis=1) < 0.3
    )
    full, expected, _, _ = raw_gradients(scene, fill=123.0)
    part, gradients, rows, _ = raw_gradients(scene, fill=123.0, focus=focus, reach=10)
    assert 0 < len(part.tiles) < len(full.tiles)
    assert 0 < len(rows) <= focus.sum()
    assert focus[rows].all()
    for name in NAMES:
        found = getattr(gradients, name)
        want = getattr(expected, name)
        assert_array_equal(found[focus], want[focus], err_msg=name)
        assert (found[~focus] == 123).all(), name
        assert (found[rows] != 123).any(), name


def test_results_do_not_depend_on_threads():
    """Catches races, and sums whose order depends on scheduling: a resumed run must equal an
    unbroken one."""
    scene = SCENES["opaque layers"]
    before = threads()
    many = [kernel_gradients(scene, random_cotangents(scene.camera)) for _ in range(2)]
    set_threads(1)
    try:
        single = kernel_gradients(scene, random_cotangents(scene.camera))
    finally:
        set_threads(before)
    for images, gradients in many:
        for got, want in zip(images, single[0], strict=True):
            assert_array_equal(got, want)
        for name in NAMES:
            assert_array_equal(gradients[name], single[1][name], err_msg=name)


@pytest.mark.parametrize("case", ["no splats", "behind the camera", "below 1/255"])
def test_nothing_in_view_is_black_and_has_no_gradient(back_end, case):
    """Catches empty pair lists, splats mirrored through the camera, and a cut that differs from the
    reference's where the whole splat lies under it."""
    scene = cloud(22, count=0 if case == "no splats" else 60, spread=0.2)
    if case == "behind the camera":
        scene.camera.world_to_camera[2, 3] = -4
    if case == "below 1/255":
        scene.splats["opacity"][:] = np.log(0.0039 / (1 - 0.0039))
    images, gradients = kernel_gradients(scene, random_cotangents(scene.camera))
    for array in (*images, *gradients.values()):
        assert not array.any()
