"""Blending on WebGPU against the CPU's, from the CPU's projection: images, and the gradients of the columns."""

import numpy as np
import pytest

from raster import gpu_device
from raster.test_kernels import IMAGE_TOLERANCE, NAMES, SCENES, Scene, cloud, random_cotangents
from stga_addon.avatar.embedding import WORLD
from stga_addon.raster.cpu.blend import blend_backward as cpu_backward
from stga_addon.raster.cpu.layout import PROJECTED, Parameters
from stga_addon.raster.cpu.rasterize import RenderOutput, frames_in_camera, render_forward
from stga_addon.raster.gpu.blend import blend_backward, blend_forward
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.layout import HIDDEN, VIEW
from stga_addon.raster.gpu.tiles import choose_tiles, list_pairs

pytestmark = pytest.mark.needs("adapter")

CAPACITY = 1 << 14
BACKGROUND = np.float32([0.9, 0.2, 0.6])
TOLERANCE = 1e-4
"""Of a column's gradient, relative to the largest of the scene. Software Vulkan rounds as the processor does: 4e-5 with
AVX2."""
CASES = {**SCENES, "many layers": cloud(30, count=700, size=(40, 40), log_scale=-1.5, logit=-3.0)}


@pytest.fixture(scope="module")
def device() -> Device:
    return gpu_device.device()


def on_cpu(scene: Scene, focus: np.ndarray | None, v: list[np.ndarray]) -> tuple[RenderOutput, np.ndarray]:
    """The rendering, and the gradient of every splat's columns (N, PROJECTED)."""
    splats = Parameters(*(scene.splats[name] for name in NAMES))
    count = len(splats.xyz)
    frames = frames_in_camera(WORLD, scene.camera)
    out = render_forward(splats, np.zeros(count, np.int32), frames, scene.degree, BACKGROUND, focus, reach=10)
    wanted = np.ones(count, bool) if focus is None else focus
    pair_gradients = np.zeros((len(out.lists.pair_splat), PROJECTED), np.float32)
    tiles_x = out.touched.shape[1]
    touched = out.tiles[out.touched.ravel()[out.tiles]]
    cpu_backward(
        touched, tiles_x, out.lists, out.blended, wanted, out.projection.columns, out.background, *v, pair_gradients
    )
    columns = np.zeros((count, PROJECTED))
    np.add.at(columns, out.lists.pair_splat, pair_gradients)
    return out, np.where(wanted[:, None], columns, 0)


def on_device(
    device: Device, scene: Scene, out: RenderOutput, v: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image (3, H, W), transmittance (H, W) and gradients of the columns (N, PROJECTED) from the CPU's projection."""
    height, width = out.transmittance.shape
    count, tiles, area = len(out.projection.rect), out.touched.size, height * width
    rect, view = out.projection.rect, np.zeros((), VIEW)
    view["width"], view["height"], view["splats"], view["capacity"] = width, height, count, CAPACITY
    view["tiles_y"], view["tiles_x"] = out.touched.shape
    view["background_r"], view["background_g"], view["background_b"] = BACKGROUND
    view["focused"], view["ring"] = out.focus is not None, 1
    uniform = device.upload("view", view, "uniform")
    visible = rect[:, 2] > rect[:, 0]
    keys = device.upload("depth_key", np.where(visible, out.projection.depth.view(np.uint32), np.uint32(HIDDEN)))
    shared = {"view": uniform, "projected": device.upload("projected", out.projection.columns)}
    given = {"view": uniform, "rect": device.upload("rect", rect)}
    given["focus"] = None if out.focus is None else device.upload("focus", out.focus.astype(np.uint32))
    v_image, v_transmittance = device.upload("v_image", v[0]), device.upload("v_transmittance", v[1])
    with device.record() as work:
        chosen = choose_tiles(work, count, tiles, **given)
        projected = shared["projected"]
        lists = list_pairs(
            work, count, tiles, CAPACITY, depth_key=keys, projected=projected, tile_table=chosen, **given
        )
        shared |= {"tile_range": chosen.tile_range, "pair_slot": lists.pair_slot, "slot_splat": lists.slot_splat}
        image, pixels = blend_forward(work, area, tiles, rendered=chosen.rendered, **shared)
        v_pixels = {"v_image": v_image, "v_transmittance": v_transmittance}
        pair_gradients = blend_backward(
            work, CAPACITY, tiles, touched=chosen.touched, pixels=pixels, **v_pixels, **shared
        )
    slots, wanted = device.read(lists.slots, (count, 2), np.uint32), device.read(lists.wanted, (count,), np.uint32)
    rows = device.read(pair_gradients, (CAPACITY, PROJECTED))
    sums = [rows[first : first + pairs].sum(0) * row for (first, pairs), row in zip(slots, wanted, strict=True)]
    transmittance = device.read(pixels, (height, width, 2))[..., 0]
    return device.read(image, (3, height, width)), transmittance, np.array(sums).reshape(count, PROJECTED)


@pytest.mark.parametrize("focused", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_image_and_gradients_are_the_cpus(device: Device, name: str, focused: bool) -> None:
    """Catches a pair skipped or taken twice, a batch's edge, a pixel outside the image, frozen pairs not walked."""
    scene = CASES[name]
    v_image, v_alpha, _ = random_cotangents(scene.camera, 3)
    v = [v_image.float().numpy(), -v_alpha.float().numpy()]
    focus = np.random.default_rng(5).random(len(scene.splats["xyz"])) < 0.1 if focused else None
    out, expected = on_cpu(scene, focus, v)
    image, transmittance, gradients = on_device(device, scene, out, v)
    height, width = transmittance.shape
    pixels = np.zeros((height, width), bool)
    for tile, (a, b, c, d) in enumerate(out.tile_rows):  # the CPU renders no other rows, the GPU whole tiles
        y, x = 16 * np.array(divmod(tile, out.touched.shape[1]))
        pixels[y + a : y + b, x : x + 8] = pixels[y + c : y + d, x + 8 : x + 16] = True
    assert np.abs(image - out.image)[:, pixels].max(initial=0) < IMAGE_TOLERANCE
    assert np.abs(transmittance - out.transmittance)[pixels].max(initial=0) < IMAGE_TOLERANCE
    for column in range(PROJECTED):
        want = expected[:, column]
        error = np.abs(gradients[:, column] - want).max() / max(np.abs(want).max(), 1e-6)
        assert error < TOLERANCE, f"column {column}: {error:.1e}"


def test_the_same_bits_twice(device: Device) -> None:
    """Catches sums in an order that changes from run to run."""
    scene = CASES["many layers"]
    v_image, v_alpha, _ = random_cotangents(scene.camera, 3)
    v = [v_image.float().numpy(), -v_alpha.float().numpy()]
    out, _ = on_cpu(scene, None, v)
    first, second = (on_device(device, scene, out, v) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)
