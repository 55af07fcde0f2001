// (1 − w)·L1 + w·(1 − SSIM) and its gradient with respect to the image; the formulas are those of `cpu/image_loss.py`.
//
// A workgroup computes one channel of one tile, from its pixels and those up to REACH around it, in its own memory:
// what SSIM's windows need twice is computed again instead of being stored, so that no map of the image's size exists.

var<uniform> loss: Loss;
// (H, W, 3) and (H, W) bytes, four to a word.
var<storage> image_target: array<u32>;
var<storage> mask: array<u32>;
// (tiles,) 1 where the gradient is wanted; the image must be rendered REACH pixels around these tiles.
var<storage> touched: array<u32>;
var<storage> tile_sums: array<vec2f>; // (3, tiles): Σ |difference| and Σ SSIM
var<storage> result: array<f32>; // (1,) the loss

const RADIUS: i32 = i32(WINDOW_RADIUS_PX);
const REACH: i32 = 2 * RADIUS;
const SIDE: i32 = i32(TILE);
const INNER: i32 = SIDE + 2 * RADIUS; // pixels whose SSIM depends on the tile
const OUTER: i32 = SIDE + 2 * REACH; // pixels that those depend on
const OUTER_AREA: i32 = OUTER * OUTER;
const STRIPS: i32 = 2; // in which the inner rows are blurred, so that 16 KiB of a workgroup's memory suffice
const STRIP_ROWS: i32 = INNER / STRIPS;
const STRIP_AREA: i32 = STRIP_ROWS * INNER;
const THREADS: i32 = i32(WORKGROUP);
const STRIP_ROUNDS: i32 = (STRIP_AREA + THREADS - 1) / THREADS; // a thread's pixels of a strip
const ROUNDS: i32 = STRIPS * STRIP_ROUNDS;

// First the image and its target (OUTER²), then two at a time of SSIM's slopes (INNER²).
var<workgroup> values: array<vec2f, OUTER_AREA>;
var<workgroup> blurred: array<vec2f, (STRIP_ROWS + 2 * RADIUS) * INNER>;

fn byte_of(word: u32, index: u32) -> f32 {
  return f32((word >> (8u * (index & 3u))) & 255u);
}

// The target's value in 0…1, over the new background, rounded to a byte as on the CPU.
fn target_value(x: i32, y: i32, channel: u32) -> f32 {
  let pixel = u32(y) * view.width + u32(x);
  let at = 3u * pixel + channel;
  var value = byte_of(image_target[at / 4u], at);
  if loss.masked == 1u {
    let clear = (255.0 - byte_of(mask[pixel / 4u], pixel)) * (1.0 / 255.0);
    value = floor(clamp(value + clear * loss.change[channel], 0.0, 255.0) + 0.5);
  }
  return value * (1.0 / 255.0);
}

// Two of the four values whose means SSIM is made of.
fn moments_of(squares: bool, pixel: vec2f) -> vec2f {
  return select(pixel, vec2f(dot(pixel, pixel), pixel.x * pixel.y), squares);
}

// Blur along x the rows that a strip's windows reach: INNER pixels of each.
fn blur_moments(squares: bool, strip: i32, local: i32) {
  for (var n = local; n < (STRIP_ROWS + 2 * RADIUS) * INNER; n += THREADS) {
    let at = (strip * STRIP_ROWS + n / INNER) * OUTER + n % INNER + RADIUS;
    blurred[n] = WINDOW_0 * moments_of(squares, values[at])
      + WINDOW_1 * (moments_of(squares, values[at - 1]) + moments_of(squares, values[at + 1]))
      + WINDOW_2 * (moments_of(squares, values[at - 2]) + moments_of(squares, values[at + 2]))
      + WINDOW_3 * (moments_of(squares, values[at - 3]) + moments_of(squares, values[at + 3]))
      + WINDOW_4 * (moments_of(squares, values[at - 4]) + moments_of(squares, values[at + 4]))
      + WINDOW_5 * (moments_of(squares, values[at - 5]) + moments_of(squares, values[at + 5]));
  }
}

// Blur along x: INNER rows of SIDE pixels.
fn blur_slopes(local: i32) {
  for (var n = local; n < INNER * SIDE; n += THREADS) {
    let at = n / SIDE * INNER + n % SIDE + RADIUS;
    blurred[n] = WINDOW_0 * values[at]
      + WINDOW_1 * (values[at - 1] + values[at + 1])
      + WINDOW_2 * (values[at - 2] + values[at + 2])
      + WINDOW_3 * (values[at - 3] + values[at + 3])
      + WINDOW_4 * (values[at - 4] + values[at + 4])
      + WINDOW_5 * (values[at - 5] + values[at + 5]);
  }
}

// Blur along y at a place of `blurred`, whose rows are `stride` long.
fn blur_column(at: i32, stride: i32) -> vec2f {
  return WINDOW_0 * blurred[at]
    + WINDOW_1 * (blurred[at - stride] + blurred[at + stride])
    + WINDOW_2 * (blurred[at - 2 * stride] + blurred[at + 2 * stride])
    + WINDOW_3 * (blurred[at - 3 * stride] + blurred[at + 3 * stride])
    + WINDOW_4 * (blurred[at - 4 * stride] + blurred[at + 4 * stride])
    + WINDOW_5 * (blurred[at - 5 * stride] + blurred[at + 5 * stride]);
}

// The place, among the INNER² pixels, of a thread's pixel of a round; past the end where it has none.
fn inner_place(round: i32, local: i32) -> i32 {
  let n = round % STRIP_ROUNDS * THREADS + local;
  return select(INNER * INNER, round / STRIP_ROUNDS * STRIP_AREA + n, n < STRIP_AREA);
}

// SSIM from the blurred moments; and its derivatives by mean, sum of squares and product, the other two held fixed.
fn similarity(m: vec4f) -> vec4f {
  let product = m.x * m.y;
  let squares = m.x * m.x + m.y * m.y;
  // Rounding must not make a variance negative, nor the covariance larger than it.
  let variance = max(0.0, m.z - squares);
  let covariance = clamp(2.0 * (m.w - product), -variance, variance);
  let over_d = 1.0 / (squares + SSIM_C1);
  let over_e = 1.0 / (variance + SSIM_C2);
  let luminance = (2.0 * product + SSIM_C1) * over_d;
  let structure = (covariance + SSIM_C2) * over_e;
  let ssim = luminance * structure;
  let by_mean = 2.0 * m.y * (structure * over_d - luminance * over_e) - 2.0 * m.x * ssim * (over_d - over_e);
  return vec4f(ssim, by_mean, -ssim * over_e, 2.0 * luminance * over_e);
}

fn is_inside(x: i32, y: i32) -> bool {
  return x >= 0 && y >= 0 && x < i32(view.width) && y < i32(view.height);
}

// Gradient of the mean over all 3·H·W values, for one channel (z) of one touched tile (x, y).
@compute @workgroup_size(WORKGROUP)
fn gradient(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) index: u32) {
  let tile = group.y * view.tiles_x + group.x;
  if touched[tile] == 0u {
    return;
  }
  let local = i32(index);
  let plane = group.z * view.width * view.height;
  let corner = vec2i(group.xy) * SIDE;
  for (var n = local; n < OUTER_AREA; n += THREADS) {
    let x = corner.x - REACH + n % OUTER;
    let y = corner.y - REACH + n / OUTER;
    values[n] = vec2f(0.0);
    if is_inside(x, y) {
      values[n] = vec2f(image[plane + u32(y) * view.width + u32(x)], target_value(x, y, group.z));
    }
  }
  workgroupBarrier();

  var moments: array<vec4f, ROUNDS>;
  for (var strip = 0; strip < STRIPS; strip++) {
    for (var part = 0; part < 2; part++) {
      blur_moments(part == 1, strip, local);
      workgroupBarrier();
      for (var round = 0; round < STRIP_ROUNDS; round++) {
        let n = local + round * THREADS;
        if n < STRIP_AREA {
          let found = blur_column(n + RADIUS * INNER, INNER);
          let at = strip * STRIP_ROUNDS + round;
          moments[at] = select(vec4f(found, 0.0, 0.0), vec4f(moments[at].xy, found), part == 1);
        }
      }
      workgroupBarrier();
    }
  }
  let place = vec2i(local % SIDE, local / SIDE); // of this thread's pixel in the tile
  let pixel = values[(place.y + REACH) * OUTER + place.x + REACH];
  workgroupBarrier();

  var total = vec2f(0.0);
  var by_product: array<f32, ROUNDS>;
  for (var round = 0; round < ROUNDS; round++) {
    let n = inner_place(round, local);
    if n < INNER * INNER {
      let at = vec2i(n % INNER, n / INNER) - RADIUS; // in the tile
      var slopes = vec4f(0.0);
      if is_inside(corner.x + at.x, corner.y + at.y) {
        slopes = similarity(moments[round]);
        if all(at >= vec2i(0)) && all(at < vec2i(SIDE)) {
          total.y += slopes.x;
        }
      }
      values[n] = slopes.yz;
      by_product[round] = slopes.w;
    }
  }
  workgroupBarrier();
  let column = (place.y + RADIUS) * SIDE + place.x;
  blur_slopes(local);
  workgroupBarrier();
  let slope = blur_column(column, SIDE);
  for (var round = 0; round < ROUNDS; round++) {
    let n = inner_place(round, local);
    if n < INNER * INNER {
      values[n] = vec2f(by_product[round], 0.0);
    }
  }
  workgroupBarrier();
  blur_slopes(local);
  workgroupBarrier();
  let slope_of_product = blur_column(column, SIDE).x;
  workgroupBarrier();
  let x = corner.x + place.x;
  let y = corner.y + place.y;
  if is_inside(x, y) {
    total.x = abs(pixel.x - pixel.y);
    let by_ssim = slope.x + 2.0 * pixel.x * slope.y + pixel.y * slope_of_product;
    let share = 1.0 / f32(3u * view.width * view.height);
    v_image[plane + u32(y) * view.width + u32(x)] =
      share * ((1.0 - loss.ssim_weight) * sign(pixel.x - pixel.y) - loss.ssim_weight * by_ssim);
  }
  total = sum_of_workgroup(total, index);
  if index == 0u {
    tile_sums[group.z * view.tiles_x * view.tiles_y + tile] = total;
  }
}

// The loss of a whole image, by one workgroup.
@compute @workgroup_size(WORKGROUP)
fn total(@builtin(local_invocation_index) index: u32) {
  let count = 3u * view.tiles_x * view.tiles_y;
  var total = vec2f(0.0);
  for (var n = index; n < count; n += WORKGROUP) {
    total += tile_sums[n];
  }
  total = sum_of_workgroup(total, index) / f32(3u * view.width * view.height);
  if index == 0u {
    result[0] = (1.0 - loss.ssim_weight) * total.x + loss.ssim_weight * (1.0 - total.y);
  }
}

// Sum over the workgroup's threads, always in the same order; right in thread 0.
fn sum_of_workgroup(value: vec2f, index: u32) -> vec2f {
  values[index] = value;
  for (var half = WORKGROUP / 2u; half > 0u; half /= 2u) {
    workgroupBarrier();
    if index < half {
      values[index] += values[index + half];
    }
  }
  return values[0];
}
