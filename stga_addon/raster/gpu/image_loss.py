"""(1 − w)·L1 + w·(1 − SSIM) and its gradient; the counterpart of `cpu/image_loss.py`.

Four passes with a thread a value: the window along rows, then along columns, once for the blurred moments and once
for the slopes. Between them the maps stay in a GPU's second-level cache (7 MB each at 802×550).
"""

import numpy as np
import warp as wp

from ..cpu import image_loss as cpu
from .rasterize import DeviceRenderOutput, Rasterizer
from .tiles import TILE, UNMARKED

wp.set_module_options({"enable_backward": False})

WINDOW_RADIUS_PX = wp.constant(cpu.WINDOW_RADIUS_PX)
WINDOW_WIDTH_PX = 2 * cpu.WINDOW_RADIUS_PX + 1
C1, C2 = wp.constant(float(cpu.C1)), wp.constant(float(cpu.C2))
_half = [float(w) for w in (cpu.W0, cpu.W1, cpu.W2, cpu.W3, cpu.W4, cpu.W5)]
Window = wp.types.vector(length=WINDOW_WIDTH_PX, dtype=wp.float32)
WINDOW = wp.constant(Window(*_half, *_half[-2::-1]))
BYTE = wp.constant(float(np.float32(1 / 255)))


@wp.func
def _moments(a: float, b: float) -> wp.vec4:
    return wp.vec4(a, b, a * a + b * b, a * b)


@wp.kernel
def blur_rows(
    image: wp.array3d[wp.float32],
    target: wp.array3d[wp.uint8],
    tiles_x: wp.int32,
    rendered: wp.array[wp.uint8],
    out: wp.array3d[wp.vec4],
):
    """Image, target, sum of their squares and product, blurred along x; for the rendered tiles' pixels."""
    c, y, x = wp.tid()
    if rendered[(y // TILE) * tiles_x + x // TILE] == UNMARKED:
        return
    total = wp.vec4()
    for k in range(wp.static(WINDOW_WIDTH_PX)):
        column = x + k - WINDOW_RADIUS_PX
        if column >= 0 and column < image.shape[2]:
            total += WINDOW[k] * _moments(image[c, y, column], float(target[y, column, c]) * BYTE)
    out[c, y, x] = total


@wp.kernel
def find_slopes(
    image: wp.array3d[wp.float32],
    target: wp.array3d[wp.uint8],
    blurred: wp.array3d[wp.vec4],
    tiles_x: wp.int32,
    rendered: wp.array[wp.uint8],
    ssim_weight: wp.float32,
    out: wp.array3d[wp.vec3],
    loss: wp.array3d[wp.float32],
):
    """SSIM's derivatives by mean, sum of squares and product, holding the other blurred values fixed.

    loss (3, H, W): what each value adds to the loss, before the mean.
    """
    c, y, x = wp.tid()
    if rendered[(y // TILE) * tiles_x + x // TILE] == UNMARKED:
        return
    m = wp.vec4()
    for k in range(wp.static(WINDOW_WIDTH_PX)):
        row = y + k - WINDOW_RADIUS_PX
        if row >= 0 and row < image.shape[1]:
            m += WINDOW[k] * blurred[c, row, x]
    mxy, mm = m[0] * m[1], m[0] * m[0] + m[1] * m[1]
    # As on the CPU: rounding must not make a variance negative, nor the covariance larger than it.
    variance = wp.max(0.0, m[2] - mm)
    covariance = wp.min(variance, wp.max(-variance, 2.0 * (m[3] - mxy)))
    over_d, over_e = 1.0 / (mm + C1), 1.0 / (variance + C2)
    luminance, structure = (2.0 * mxy + C1) * over_d, (covariance + C2) * over_e
    ssim = luminance * structure
    by_mean = 2.0 * m[1] * (structure * over_d - luminance * over_e) - 2.0 * m[0] * ssim * (over_d - over_e)
    out[c, y, x] = wp.vec3(by_mean, -ssim * over_e, 2.0 * luminance * over_e)
    difference = wp.abs(image[c, y, x] - float(target[y, x, c]) * BYTE)
    loss[c, y, x] = (1.0 - ssim_weight) * difference + ssim_weight * (1.0 - ssim)


@wp.kernel
def blur_slopes(
    slopes: wp.array3d[wp.vec3], tiles_x: wp.int32, rendered: wp.array[wp.uint8], out: wp.array3d[wp.vec3]
):  # fmt: skip
    """The slopes blurred along x."""
    c, y, x = wp.tid()
    if rendered[(y // TILE) * tiles_x + x // TILE] == UNMARKED:
        return
    total = wp.vec3()
    for k in range(wp.static(WINDOW_WIDTH_PX)):
        column = x + k - WINDOW_RADIUS_PX
        if column >= 0 and column < slopes.shape[2]:
            total += WINDOW[k] * slopes[c, y, column]
    out[c, y, x] = total


@wp.kernel
def image_gradient(
    image: wp.array3d[wp.float32],
    target: wp.array3d[wp.uint8],
    blurred: wp.array3d[wp.vec3],
    tiles_x: wp.int32,
    touched: wp.array[wp.uint8],
    ssim_weight: wp.float32,
    gradient: wp.array3d[wp.float32],
):
    """Gradient of the mean over all values of the loss with respect to the image, for the touched tiles' pixels."""
    c, y, x = wp.tid()
    if touched[(y // TILE) * tiles_x + x // TILE] == UNMARKED:
        return
    s = wp.vec3()
    for k in range(wp.static(WINDOW_WIDTH_PX)):
        row = y + k - WINDOW_RADIUS_PX
        if row >= 0 and row < image.shape[1]:
            s += WINDOW[k] * blurred[c, row, x]
    a, b = image[c, y, x], float(target[y, x, c]) * BYTE
    sign = wp.where(a > b, 1.0, wp.where(a < b, -1.0, 0.0))
    slope = s[0] + 2.0 * a * s[1] + b * s[2]
    share = 1.0 / float(3 * image.shape[1] * image.shape[2])
    gradient[c, y, x] = share * ((1.0 - ssim_weight) * sign - ssim_weight * slope)


@wp.kernel
def change_background(
    image: wp.array3d[wp.uint8], mask: wp.array2d[wp.uint8], change: wp.vec3, out: wp.array3d[wp.uint8]
):  # fmt: skip
    """As the CPU's; change: the color after less the one before, in 0…255."""
    y, x = wp.tid()
    clear = float(255 - int(mask[y, x])) * BYTE
    for c in range(3):
        value = float(image[y, x, c]) + clear * change[c]
        out[y, x, c] = wp.uint8(wp.min(255.0, wp.max(0.0, value)) + 0.5)


def image_loss_gradient(
    rasterizer: Rasterizer, rendering: DeviceRenderOutput, target: wp.array, ssim_weight: float
) -> tuple[wp.array, wp.array]:
    """Gradient (3, H, W) of the image loss in the touched tiles, and what each value adds to the loss (3, H, W).

    target (H, W, 3) uint8. The loss is the mean of the latter where every tile was rendered.
    """
    shape, lens, array = rendering.image.shape, rendering.frames.lens, rasterizer.buffers.get
    image, tiles_x, rendered = rendering.image, lens.tiles_x, rendering.rendered
    moments, loss, v_image = array("moments", shape, wp.vec4), array("loss", shape), array("v_image", shape)
    slopes, blurred = array("slopes", shape, wp.vec3), array("blurred_slopes", shape, wp.vec3)
    launch = rasterizer.launch
    launch(blur_rows, shape, image, target, tiles_x, rendered, moments)
    launch(find_slopes, shape, image, target, moments, tiles_x, rendered, ssim_weight, slopes, loss)
    launch(blur_slopes, shape, slopes, tiles_x, rendered, blurred)
    launch(image_gradient, shape, image, target, blurred, tiles_x, rendering.touched, ssim_weight, v_image)
    return v_image, loss
