// Gradient of every wanted pair of the touched tiles with respect to its splat's projected columns.
//
// BATCH pairs at a time, far to near, in two steps. First a thread is a pixel, walks through the batch and leaves what
// each pair weighs there and how strongly its exponent counts. Then PAIR_THREADS threads are a pair and add up its
// pixels, each every PAIR_THREADS-th, and their sums in the order of threads. So no sum depends on chance or on the
// width of subgroups, and every pair writes a row of its own.

override HAS_V_TRANSMITTANCE: bool = false;

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> touched: array<u32>;
@group(0) @binding(2) var<storage, read> tile_range: array<vec2u>;
@group(0) @binding(3) var<storage, read> pair_slot: array<u32>;
@group(0) @binding(4) var<storage, read> slot_splat: array<u32>;
@group(0) @binding(5) var<storage, read> projected: array<f32>;
@group(0) @binding(6) var<storage, read> pixels: array<vec2u>;
@group(0) @binding(7) var<storage, read> v_image: array<f32>; // (3, H, W)
@group(0) @binding(8) var<storage, read> v_transmittance: array<f32>; // (H, W), if HAS_V_TRANSMITTANCE
@group(0) @binding(9) var<storage, read_write> pair_gradients: array<f32>;

const BATCH: u32 = 8u;
const PAIR_THREADS: u32 = WORKGROUP / BATCH;
const PIXELS_PER_THREAD: u32 = PIXELS / PAIR_THREADS;
const POWERS: u32 = BATCH * PIXELS; // where the exponents' gradients begin, after the weights
const SUM_STRIDE: u32 = PAIR_THREADS + 1u; // so that sums side by side lie in different banks of memory

var<workgroup> scratch: array<f32, 2u * BATCH * PIXELS>;
var<workgroup> v_color: array<vec3f, PIXELS>;
var<workgroup> deepest_last: atomic<u32>;
var<workgroup> nearest_wanted: atomic<u32>;
var<workgroup> walk: vec2u; // first pair, and one past the last, that matter

@compute @workgroup_size(WORKGROUP)
fn main(thread: Thread) {
  let local = thread.local;
  let tile = workgroup_number(thread);
  if tile >= view.tiles_x * view.tiles_y || touched[tile] == 0u {
    return;
  }
  let corner = tile_corner(tile);
  let pixel = corner + vec2u(local % TILE, local / TILE);
  let center = pixel_center(local);
  var v = vec3f(0.0);
  var t = 1.0;
  var behind = 0.0;
  var last = 0u;
  if is_inside(pixel) {
    let n = pixel.y * view.width + pixel.x;
    let area = view.width * view.height;
    v = vec3f(v_image[n], v_image[area + n], v_image[2u * area + n]);
    t = bitcast<f32>(pixels[n].x);
    last = pixels[n].y;
    behind = dot(vec3f(view.background_r, view.background_g, view.background_b), v);
    if HAS_V_TRANSMITTANCE {
      behind += v_transmittance[n];
    }
    behind *= t;
  }
  v_color[local] = v;
  let range = tile_range[tile];
  let bounds = find_walk(range, last, local);
  for (var end = bounds.y; end > bounds.x; end -= min(end, BATCH)) {
    let begin = max(bounds.x + BATCH, end) - BATCH;
    var any_wanted = 0u;
    for (var k = 0u; k < end - begin; k++) {
      let q = end - begin - 1u - k;
      let marked = marked_splat(begin + q);
      any_wanted |= marked & WANTED;
      let splat = fetch(marked & ~WANTED, vec2f(corner));
      let offset = center - splat.mean;
      let raw = raw_alpha(splat, offset.x, offset.y);
      let a = min(MAX_ALPHA, raw);
      var weight = 0.0;
      var v_power = 0.0;
      if a >= MIN_ALPHA && begin + q - range.x < last {
        let ra = 1.0 / (1.0 - a);
        t *= ra;
        weight = a * t;
        let along = dot(splat.color, v);
        // The gradient of the exponent through the clamp of alpha is zero.
        v_power = select(0.0, a * (t * along - ra * behind), raw < MAX_ALPHA);
        behind += weight * along;
      }
      scratch[q * PIXELS + local] = weight;
      scratch[POWERS + q * PIXELS + local] = v_power;
    }
    if any_wanted != 0u {
      workgroupBarrier();
      let q = local / PAIR_THREADS;
      var sums: array<f32, PROJECTED>;
      if begin + q < end {
        sums = sum_pixels(marked_splat(begin + q) & ~WANTED, q, local % PAIR_THREADS, vec2f(corner));
      }
      workgroupBarrier();
      for (var c = 0u; c < PROJECTED; c++) {
        scratch[(q * PROJECTED + c) * SUM_STRIDE + local % PAIR_THREADS] = sums[c];
      }
      workgroupBarrier();
      if local < PROJECTED * (end - begin) {
        write_sum(begin, local);
      }
      workgroupBarrier();
    }
  }
}

// The pairs from the nearest wanted one to the deepest that any pixel sees; writes zeros for the wanted ones behind.
fn find_walk(range: vec2u, last: u32, local: u32) -> vec2u {
  if local == 0u {
    atomicStore(&deepest_last, 0u);
    atomicStore(&nearest_wanted, range.y);
  }
  workgroupBarrier();
  atomicMax(&deepest_last, last);
  for (var j = range.x + local; j < range.y; j += WORKGROUP) {
    if marked_splat(j) >= WANTED {
      atomicMin(&nearest_wanted, j);
      break;
    }
  }
  workgroupBarrier();
  if local == 0u {
    walk = vec2u(atomicLoad(&nearest_wanted), range.x + atomicLoad(&deepest_last));
  }
  let found = workgroupUniformLoad(&walk);
  for (var j = found.y + local; j < range.y; j += WORKGROUP) {
    if marked_splat(j) >= WANTED {
      for (var c = 0u; c < PROJECTED; c++) {
        pair_gradients[pair_slot[j] * PROJECTED + c] = 0.0;
      }
    }
  }
  return found;
}

// A thread's share of a pair's gradient, linear in its pixels.
fn sum_pixels(i: u32, q: u32, thread: u32, corner: vec2f) -> array<f32, PROJECTED> {
  let splat = fetch(i, corner);
  var g = 0.0;
  var g_offset = vec2f(0.0);
  var g_squares = vec3f(0.0);
  var g_color = vec3f(0.0);
  for (var k = 0u; k < PIXELS_PER_THREAD; k++) {
    let p = thread + k * PAIR_THREADS;
    let offset = pixel_center(p) - splat.mean;
    let dy = offset.y;
    let dx = offset.x - splat.shear * dy;
    let v_power = scratch[POWERS + q * PIXELS + p];
    g += v_power;
    g_offset += v_power * vec2f(dx, dy);
    g_squares += v_power * vec3f(dx * dx, dx * dy, dy * dy);
    g_color += scratch[q * PIXELS + p] * v_color[p];
  }
  let by_x = splat.precision_x * g_offset.x;
  return array<f32, PROJECTED>(
    by_x,
    splat.precision_y * g_offset.y - splat.shear * by_x,
    -0.5 * g_squares.x,
    splat.precision_x * g_squares.y,
    -0.5 * g_squares.z,
    g / splat.opacity,
    g_color.x,
    g_color.y,
    g_color.z,
  );
}

// Add up the threads' shares of one column of one pair.
fn write_sum(begin: u32, number: u32) {
  let slot = pair_slot[begin + number / PROJECTED];
  if slot_splat[slot] < WANTED {
    return;
  }
  var sum = 0.0;
  for (var thread = 0u; thread < PAIR_THREADS; thread++) {
    sum += scratch[number * SUM_STRIDE + thread];
  }
  pair_gradients[slot * PROJECTED + number % PROJECTED] = sum;
}
