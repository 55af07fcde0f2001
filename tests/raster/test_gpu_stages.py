"""Sorting, image loss, and frames and strain of a posed mesh on a WebGPU device, against numpy and
the CPU."""

import numpy as np
import pytest
from numerics.meshes import bent_ball, collapsed
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from raster.test_kernels import SCENES
from stga_addon.avatar.embedding import CONVENTIONS, face_areas, face_frames
from stga_addon.avatar.offsets import SIGNALS
from stga_addon.avatar.strain import MAX_STRAIN, strain_basis
from stga_addon.capture.camera import Camera
from stga_addon.raster.cpu.rasterize import frames_in_camera, tile_grid
from stga_addon.raster.gpu.frames import Embedding
from stga_addon.raster.gpu.layout import (
    COUNTS,
    FRAME_COLOR,
    FRAME_STRIDE,
    HIDDEN,
    NEEDED,
    OVERFLOWED,
    WORKGROUP,
)
from stga_addon.raster.gpu.optimizer import image_loss, upload_target
from stga_addon.raster.gpu.rasterize import counts_buffer, sort_keys
from stga_addon.training.optimize.image_loss import image_gradient, whole_image

pytestmark = pytest.mark.needs("adapter")


def view_of(device, splats):
    return device.uniform("View", splats=splats, capacity=1 << 16)


@pytest.mark.parametrize("count", [1, 255, 257, 2048, 2049, 10_000])
@pytest.mark.parametrize("kind", ["random", "few", "equal", "reversed", "two digits"])
def test_sorted_keys_are_numpys(device, count, kind):
    """Catches a key lost at a block's edge, a digit's carry, equal keys that change places, and the
    tiles of a large image, which need a second pass."""
    random = default_rng(count)
    keys = {
        "random": random.integers(0, 1 << 32, count),
        "few": random.integers(0, 3, count) << 11,
        "equal": np.full(count, HIDDEN),
        "reversed": 0xFFFFFF00 - np.arange(count),
        "two digits": random.integers(0, 130 * 70, count),
    }[kind].astype(np.uint32)
    bits = 14 if kind == "two digits" else 32
    with device.record() as work:
        found = sort_keys(work, device.upload("keys", keys), count, bits, view_of(device, count))
    order = np.argsort(keys, kind="stable")
    assert_array_equal(device.read(found[1], (count,), np.uint32), order)
    assert_array_equal(device.read(found[0], (count,), np.uint32), keys[order])


def test_a_count_beyond_32_bits_is_too_many(device):
    """Catches a sum that wraps around to a small number: of three workgroups with 2³¹ − 1 pairs
    each."""
    until = np.full(3 * WORKGROUP + 3, 0x7FFFFFFF, np.uint32)
    tables = {"view": view_of(device, 3 * WORKGROUP), "pairs_until": device.upload("until", until)}
    counts_buffer(device)
    with device.record() as work:
        work.dispatch("tiles.add_pairs", (1, 1, 1), tables)
    counts = device.read(counts_buffer(device), (COUNTS,), np.uint32)
    device.upload("counts", np.zeros(COUNTS, np.uint32))
    assert counts[NEEDED] == 0x7FFFFFFF
    assert counts[OVERFLOWED] == 1


SIZES = [(100, 70), (1, 1), (1, 40), (40, 1), (17, 33), (32, 16), (9, 11)]
SSIM_WEIGHT = 0.2


def on_device(device, image, target, touched, **options):
    """Gradient (3, H, W), filled with 77 before, and loss; touched (rows, columns) of tiles."""
    _, height, width = image.shape
    columns, rows = tile_grid(width, height)
    view = device.uniform("View", width=width, height=height, tiles_x=columns, tiles_y=rows)
    upload_target(device, target, SSIM_WEIGHT, **options)
    device.upload("v_image", np.full_like(image, 77))
    with device.record() as work:
        v_image, loss = image_loss(
            work,
            width,
            height,
            view=view,
            image=device.upload("image", image),
            touched=device.upload("touched", touched.astype(np.uint32)),
            whole=bool(touched.all()),
        )
    return device.read(v_image, image.shape), float(device.read(loss, (1,))[0])


def pictures(width, height, seed=1):
    """A smooth image with noise, and bytes that resemble it."""
    rng = default_rng(seed)
    smooth = 0.5 + 0.4 * np.sin(np.linspace(0, 9, width) + np.linspace(0, 5, height)[:, None])
    image = np.stack([smooth, 1 - smooth, smooth**2]) + rng.normal(0, 0.05, (3, height, width))
    target = np.clip(255 * (image + rng.normal(0, 0.1, image.shape)), 0, 255).transpose(1, 2, 0)
    return image.astype(np.float32), np.ascontiguousarray(target, np.uint8)


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("kind", ["noise", "bright and flat", "equal"])
def test_loss_and_gradient_are_the_cpus(device, size, kind):
    """Catches a window, padding, byte or sign that differs, and a tile left out of the sum."""
    image, target = pictures(*size)
    if kind == "bright and flat":
        image = np.full_like(image, 0.999)
        target = np.full_like(target, 255)
        image[:, 20:30, 40:60] = 0.5
    if kind == "equal":
        image = np.ascontiguousarray(
            (target.astype(np.float32) * np.float32(1 / 255)).transpose(2, 0, 1)
        )
    expected = np.empty_like(image)
    l1, ssim = image_gradient(image, target, whole_image(*image.shape[1:]), SSIM_WEIGHT, expected)
    gradient, loss = on_device(device, image, target, np.ones(tile_grid(*size)[::-1], bool))
    # In flat regions both lose digits to the same cancellation, each in its own order of summation.
    tolerance = 2e-5 if kind == "noise" else 5e-4
    assert_allclose(
        gradient, expected, atol=tolerance * max(np.abs(expected).max(), 0.1 / image.size)
    )
    assert loss == pytest.approx(
        (1 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1 - ssim), rel=1e-5, abs=tolerance / 10
    )


@pytest.mark.parametrize("scale", [1e4, 1e8, 1e15, 1e18])
def test_extreme_images_stay_bounded(device, scale):
    """Catches variances that become negative or overflow, whose gradient is NaN or enormous."""
    image, target = pictures(40, 30)
    gradient, _ = on_device(device, np.float32(scale) * image, target, np.ones((2, 3), bool))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() < 10 / image.size


FRAME_TOLERANCE = 2e-6
"""Of origins in meters and of rotations times scale: float32 at a few meters from the camera."""


@pytest.mark.parametrize("mesh", ["ball", "collapsed", "lines in the neutral mesh", "far away"])
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_frames_and_signals_are_numpys(device, convention, mesh):
    """Catches another rule for a triangle without area, an axis that differs, and edges that lose
    digits in float32."""
    posed, neutral, faces = bent_ball() if mesh in ("ball", "far away") else collapsed()
    camera = SCENES["plain"].camera
    camera = Camera(camera.width, camera.height, 50, 50, 25, 20, camera.world_to_camera.copy())
    if mesh == "lines in the neutral mesh":
        posed, neutral = neutral, posed
    if mesh == "far away":
        shift = np.array([1e4, -1e4, 1e4])
        pose = camera.world_to_camera
        posed = posed + shift
        pose[:3, 3] = -pose[:3, :3] @ shift
    ends = default_rng(8).uniform(0, 1.5, (len(faces), 2, 6))
    ends[:, 0] *= -1
    basis = strain_basis(neutral, faces, np.float32(ends) if mesh == "ball" else None)
    in_world = face_frames(posed, faces, neutral, convention, basis)
    expected = frames_in_camera(in_world, camera)
    step = Embedding(device, face_areas(neutral, faces), faces, convention, basis)
    step.upload(posed, camera)
    with device.record() as work:
        table = step.compose(work, {})
    frames = device.read(table, (len(faces), FRAME_STRIDE))
    assert_allclose(frames[:, :3], expected.origin, atol=FRAME_TOLERANCE)
    # The area of what is a line, whose root is the scale, is float32's rounding: 0 or, where a card
    # multiplies and adds at once, 6e-8 of the squared edges.
    tolerance = 3e-4 if mesh == "collapsed" else FRAME_TOLERANCE
    assert_allclose(frames[:, 3:12].reshape(-1, 3, 3), expected.matrix, atol=tolerance)
    assert not frames[:, FRAME_COLOR:].any()
    for name, signal in SIGNALS.items():
        found = device.read(step.signals[name], (len(faces), 3))
        wanted = signal(basis, in_world)
        assert wanted.any()
        if mesh == "lines in the neutral mesh" or (mesh, name) == ("collapsed", "normal"):
            # A deformation per area that is hardly there; float64 has few digits of it, too.
            assert (np.abs(found) <= MAX_STRAIN).all()
        else:
            assert_allclose(found, wanted, atol=5e-6)
