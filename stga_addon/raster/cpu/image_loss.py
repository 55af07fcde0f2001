"""(1 − w)·L1 + w·(1 − SSIM) and its gradient in one sweep over the rows of each rectangle of an
image.

SSIM: Gaussian window of 11 pixels, σ 1.5, zero padding, per channel, C1 = 0.01², C2 = 0.03² (Wang
et al. 2004, as used by 3D Gaussian splatting). Rows of horizontally blurred values live in rings of
eleven, so the intermediate maps never reach main memory.
"""

from typing import NamedTuple

import numpy as np

from . import inline_jit, part_jit
from .threads import call_helpers, end_stages, parallel, pieces, stage

WINDOW_RADIUS_PX = 5
"""Radius of SSIM's Gaussian window."""
LOSS_REACH_PX = 2 * WINDOW_RADIUS_PX
"""A pixel's gradient depends on image pixels up to this far away."""
ROW_UNIT_PX = 32
"""Rows of this length have no remainder for LLVM to compute pixel by pixel."""
PADDING_PX = 8
"""Zeros before and after each row: WINDOW_RADIUS_PX are needed, and with eight, rows begin where
vectors do."""
RING_ROWS = 2 * WINDOW_RADIUS_PX + 1
C1 = np.float32(0.01**2)
C2 = np.float32(0.03**2)
_window = np.exp(-0.5 * (np.arange(-WINDOW_RADIUS_PX, WINDOW_RADIUS_PX + 1) / 1.5) ** 2)
W0, W1, W2, W3, W4, W5 = (np.float32(w) for w in (_window / _window.sum())[: WINDOW_RADIUS_PX + 1])
ZERO = np.float32(0.0)
ONE = np.float32(1.0)
TWO = np.float32(2.0)
N1, N2, N3, N4, N5, N6, N7, N8, N9, N10 = (np.uint64(n) for n in range(1, 11))


class _Columns(NamedTuple):
    """Which columns of the image are looked at for those of a rectangle.

    left      the first; span: how many, from there to the last that matters
    padded    of a row buffer's values, those that are computed: blurs go beyond the span, where
              nothing reads
    stride    from one row buffer to the next, PADDING_PX of zeros before and after
    first, past   the rectangle's own, counted from `left`
    """

    left: int
    span: int
    padded: int
    stride: int
    first: int
    past: int


class _Rows(NamedTuple):
    """Row buffers of one channel, each value's row behind that of the one before."""

    target: np.ndarray  # as floats: the last RING_ROWS
    source: np.ndarray  # image, target, sum of squares, product
    first: np.ndarray  # the four of them blurred horizontally: the last RING_ROWS
    moments: np.ndarray  # the four of them blurred
    slopes: np.ndarray  # of SSIM by three of the four
    second: np.ndarray  # the three of them blurred horizontally: the last RING_ROWS
    blurred: np.ndarray  # the three of them blurred
    similarities: np.ndarray
    differences: np.ndarray


@inline_jit
def _blur(a, i):
    """Eleven values, at the indices i, weighted by the window."""
    return (
        W0 * (a[i[0]] + a[i[10]])
        + W1 * (a[i[1]] + a[i[9]])
        + W2 * (a[i[2]] + a[i[8]])
        + W3 * (a[i[3]] + a[i[7]])
        + W4 * (a[i[4]] + a[i[6]])
        + W5 * a[i[5]]
    )


@part_jit
def _blur_row(source, offset, out, at, count):
    """Horizontal blur of source[offset + PADDING_PX : …] to out[at : at + count]; the source row is
    padded by PADDING_PX."""
    for x in range(np.uint64(count)):
        i = np.uint64(offset + PADDING_PX - WINDOW_RADIUS_PX) + x
        out[np.uint64(at) + x] = _blur(
            source,
            (i, i + N1, i + N2, i + N3, i + N4, i + N5, i + N6, i + N7, i + N8, i + N9, i + N10),
        )


@inline_jit
def _ring_row(plane, row, stride):
    return np.uint64((plane * RING_ROWS + row % RING_ROWS) * stride)


@part_jit
def _blur_column(ring, plane, row, out, columns):
    """Vertical blur of the ring's eleven rows around `row` to the plane's row of `out`."""
    stride = columns.stride
    r0 = _ring_row(plane, row - 5, stride)
    r1 = _ring_row(plane, row - 4, stride)
    r2 = _ring_row(plane, row - 3, stride)
    r3 = _ring_row(plane, row - 2, stride)
    r4 = _ring_row(plane, row - 1, stride)
    r5 = _ring_row(plane, row, stride)
    r6 = _ring_row(plane, row + 1, stride)
    r7 = _ring_row(plane, row + 2, stride)
    r8 = _ring_row(plane, row + 3, stride)
    r9 = _ring_row(plane, row + 4, stride)
    r10 = _ring_row(plane, row + 5, stride)
    at = np.uint64(plane * stride)
    for x in range(np.uint64(columns.padded)):
        out[at + x] = _blur(
            ring,
            (
                r0 + x,
                r1 + x,
                r2 + x,
                r3 + x,
                r4 + x,
                r5 + x,
                r6 + x,
                r7 + x,
                r8 + x,
                r9 + x,
                r10 + x,
            ),
        )


@part_jit
def _blur_into_ring(values, planes, ring, row, inside, columns):
    """Blur each plane of `values` horizontally into the ring's row; zeros for a row that is not
    inside of the image."""
    for plane in range(planes):
        into = (plane * RING_ROWS + row % RING_ROWS) * columns.stride
        if inside:
            _blur_row(values, plane * columns.stride, ring, into, columns.padded)
        else:
            ring[into : into + columns.span] = ZERO


@part_jit
def _load_source(image, target, row, c, rows, columns):
    """Write a row's `source` and `target`; image (3, H, W), target (H, W, 3)."""
    left = np.uint64(columns.left)
    keep = np.uint64((row % RING_ROWS) * columns.stride)
    stride = columns.stride
    source = rows.source
    target_row = rows.target
    for n in range(np.uint64(columns.span)):
        value = target[np.uint64(row), left + n, np.uint64(c)]
        target_row[keep + n] = np.float32(value) * np.float32(1 / 255)
    for n in range(np.uint64(columns.span)):
        x = image[c, row, left + n]
        y = target_row[keep + n]
        source[np.uint64(PADDING_PX) + n] = x
        source[np.uint64(stride + PADDING_PX) + n] = y
        source[np.uint64(2 * stride + PADDING_PX) + n] = x * x + y * y
        source[np.uint64(3 * stride + PADDING_PX) + n] = x * y


@inline_jit
def _similarity_row(rows, columns):
    """Write the SSIM of a row's pixels to `similarities`, and its derivatives to `slopes`.

    The derivatives are with respect to three blurred values: the mean of the image, the sum of
    squares, and the product. Each plane of `slopes` begins with PADDING_PX empty pixels.
    """
    moments = rows.moments
    slopes = rows.slopes
    stride = columns.stride
    for n in range(np.uint64(columns.padded)):
        mx = moments[n]
        my = moments[np.uint64(stride) + n]
        squares = moments[np.uint64(2 * stride) + n]
        product = moments[np.uint64(3 * stride) + n]
        mxy = mx * my
        mm = mx * mx + my * my
        # Differences of blurred squares: in bright, flat images rounding makes the variances
        # negative and the covariance larger than their mean, which it can never be.
        variance = max(ZERO, squares - mm)
        covariance = min(variance, max(-variance, TWO * (product - mxy)))
        over_d = ONE / (mm + C1)
        over_e = ONE / (variance + C2)
        luminance = (TWO * mxy + C1) * over_d
        structure = (covariance + C2) * over_e
        ssim = luminance * structure
        # ∂SSIM/∂mean, ∂/∂(sum of squares), ∂/∂product, holding the other blurred values fixed
        by_product = TWO * luminance * over_e
        by_squares = -ssim * over_e
        by_mean = TWO * my * (structure * over_d - luminance * over_e) - TWO * mx * ssim * (
            over_d - over_e
        )
        slopes[np.uint64(PADDING_PX) + n] = by_mean
        slopes[np.uint64(stride + PADDING_PX) + n] = by_squares
        slopes[np.uint64(2 * stride + PADDING_PX) + n] = by_product
        rows.similarities[n] = ssim
    for plane in range(3):  # derivatives beyond the image are zero
        beyond = plane * stride + PADDING_PX
        slopes[beyond + columns.span : beyond + columns.padded] = ZERO


@part_jit
def _sum_row(values, first, past):
    """Σ values[first:past], which are overwritten: their second half is added to the first until
    one is left.

    One total would be added up in an order that LLVM chooses, differently from one compilation to
    the next, or where it is not sure that arrays do not overlap, from one address to the next.
    """
    count = past - first
    while count > 1:
        half = (count + 1) // 2
        for n in range(np.uint64(count - half)):
            values[np.uint64(first) + n] += values[np.uint64(first + half) + n]
        count = half
    return values[first]


@inline_jit
def _gradient_row(image, gradient, keep, rows, columns, weights):
    """Write the loss's gradient in a row of the rectangle, and |image − target| to `differences`.

    image, gradient (W,): the row; keep: where the target's begins. weights: of SSIM, and of the
    whole.
    """
    ssim_weight, scale = weights
    left = np.uint64(columns.left)
    stride = columns.stride
    blurred = rows.blurred
    for n in range(np.uint64(columns.first), np.uint64(columns.past)):
        x = image[left + n]
        y = rows.target[np.uint64(keep) + n]
        sign = ONE if x > y else (-ONE if x < y else ZERO)
        rows.differences[n] = abs(x - y)
        slope = (
            blurred[n]
            + TWO * x * blurred[np.uint64(stride) + n]
            + y * blurred[np.uint64(2 * stride) + n]
        )
        gradient[left + n] = scale * ((ONE - ssim_weight) * sign - ssim_weight * slope)


@part_jit
def _columns_of(rectangle, width):
    left = max(0, rectangle[0] - LOSS_REACH_PX)
    right = min(width, rectangle[2] + LOSS_REACH_PX)
    span = right - left
    padded = (span + ROW_UNIT_PX - 1) // ROW_UNIT_PX * ROW_UNIT_PX
    stride = padded + 2 * PADDING_PX
    return _Columns(left, span, padded, stride, rectangle[0] - left, rectangle[2] - left)


@part_jit
def _new_rows(columns):
    stride = columns.stride
    return _Rows(
        np.zeros(RING_ROWS * stride, np.float32),
        np.zeros(4 * stride, np.float32),
        np.zeros(4 * RING_ROWS * stride, np.float32),
        np.zeros(4 * stride, np.float32),
        np.zeros(3 * stride, np.float32),
        np.zeros(3 * RING_ROWS * stride, np.float32),
        np.zeros(3 * stride, np.float32),
        np.empty(columns.padded, np.float32),
        np.empty(columns.padded, np.float32),
    )


@parallel(lambda image, target, rectangles, *_: 3 * len(rectangles))
def image_loss(work, image, target, rectangles, ssim_weight, scale, gradient, sums, totals):
    """Gradient of the loss with respect to the image, within each rectangle (x0, y0, x1, y1) of
    pixels.

    image (3, H, W) float32; target (H, W, 3) uint8; the loss is the mean over all 3·H·W values, so
    `scale` is 1 / (3·H·W). Reads the image up to LOSS_REACH_PX pixels around a rectangle. Writes
    gradient (3, H, W); for the rows of all rectangles one after the other, sums (2, 3, rows): Σ
    |difference| and Σ SSIM over a row's pixels, by channel; and totals (2,), the sums over all
    rows and channels. By row, the sums do not depend on how an image is cut into bands.
    """
    call_helpers(work)
    weights = (ssim_weight, scale)
    for job in stage(work, 0, 3 * len(rectangles)):
        _channel_loss(job // 3, job % 3, image, target, rectangles, weights, gradient, sums)
    for k in stage(work, 1, 2):
        totals[k] = _total(sums[k])
    end_stages(work)


@part_jit
def _channel_loss(r, c, image, target, rectangles, weights, gradient, sums):
    """`image_loss` of one channel of one rectangle: row by row, the gradient ten rows behind."""
    height = image.shape[1]
    y0 = rectangles[r, 1]
    y1 = rectangles[r, 3]
    first_sum = -y0  # where the sums of the rectangle's rows begin, less its first row
    for before in range(r):
        first_sum += rectangles[before, 3] - rectangles[before, 1]
    columns = _columns_of(rectangles[r], image.shape[2])
    rows = _new_rows(columns)
    for row in range(y0 - LOSS_REACH_PX, y1 + LOSS_REACH_PX):
        # 1. horizontal blur of this row's four values
        inside = 0 <= row < height
        if inside:
            _load_source(image, target, row, c, rows, columns)
        _blur_into_ring(rows.source, 4, rows.first, row, inside, columns)
        # 2. SSIM of the row five above, and its slopes blurred horizontally
        middle = row - WINDOW_RADIUS_PX
        if middle < y0 - WINDOW_RADIUS_PX:
            continue
        inside = 0 <= middle < height
        if inside:
            for plane in range(4):
                _blur_column(rows.first, plane, middle, rows.moments, columns)
            _similarity_row(rows, columns)
            if y0 <= middle < y1:
                similarity = _sum_row(rows.similarities, columns.first, columns.past)
                sums[1, c, first_sum + middle] = similarity
        _blur_into_ring(rows.slopes, 3, rows.second, middle, inside, columns)
        # 3. gradient of the row five above that
        out = middle - WINDOW_RADIUS_PX
        if out < y0 or out >= y1 or out < 0 or out >= height:
            continue
        for plane in range(3):
            _blur_column(rows.second, plane, out, rows.blurred, columns)
        keep = (out % RING_ROWS) * columns.stride
        _gradient_row(image[c, out], gradient[c, out], keep, rows, columns, weights)
        difference = _sum_row(rows.differences, columns.first, columns.past)
        sums[0, c, first_sum + out] = difference


@part_jit
def _total(sums):
    total = 0.0
    for c in range(sums.shape[0]):
        for n in range(sums.shape[1]):
            total += sums[c, n]
    return total


@parallel(lambda image, *_: len(image), piece=16)
def change_background(work, image, mask, before, after, out):
    """Write image (H, W, 3) uint8, composited over the color `before`, as it looks over `after`.

    mask (H, W) uint8: the foreground's coverage; before, after (3,) float32 in 0…255; out as image.
    image = coverage · foreground + (1 − coverage) · before, so only the second term has to be
    exchanged.
    """
    call_helpers(work)
    for first_row, past_row in pieces(work):
        for y in range(first_row, past_row):
            for x in range(image.shape[1]):
                clear = np.float32(255 - mask[y, x]) * np.float32(1 / 255)
                for c in range(3):
                    value = np.float32(image[y, x, c]) + clear * (after[c] - before[c])
                    out[y, x, c] = np.uint8(
                        min(np.float32(255.0), max(ZERO, value)) + np.float32(0.5)
                    )
