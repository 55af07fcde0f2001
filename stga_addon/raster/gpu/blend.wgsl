// Alpha blending of the splats of each tile, forward and backward; see `cpu/blend.py`. Forward, a workgroup is a tile;
// backward, SEGMENT_PAIRS of its pairs: those at a head's outline have ten times as many as others.

var<storage> touched: array<u32>;
var<storage> pair_slot: array<u32>; // (P,) a pair's slot; by tile, near to far
var<storage> pixels: array<vec2u>; // (H, W) transmittance f32, and one past the last contributing pair
var<storage> v_transmittance: array<f32>; // (H, W), if HAS_V_TRANSMITTANCE
// Of the segment that begins after each cut of a tile's list: the color (3) that it adds to the tile's pixels, and
// their transmittance before it; (P / SEGMENT_PAIRS + 1, 4, PIXELS), a cut's row by its pair's number.
var<storage> segments: array<f32>;
var<storage> segment_tile: array<u32>; // (P / SEGMENT_PAIRS + 1) the tile of the cut, if there is one

fn segment_word(pair: u32, column: u32, local: u32) -> u32 {
  return (pair / SEGMENT_PAIRS * 4u + column) * PIXELS + local;
}

struct Splat {
  mean: vec2f, // from the tile's corner
  precision_x: f32,
  shear: f32,
  precision_y: f32,
  opacity: f32,
  color: vec3f,
}

fn fetch(i: u32, corner: vec2f) -> Splat {
  let at = i * PROJECTED;
  return Splat(
    vec2f(projected[at + MEAN_X], projected[at + MEAN_Y]) - corner,
    projected[at + PRECISION_X],
    projected[at + SHEAR],
    projected[at + PRECISION_Y],
    projected[at + OPACITY],
    vec3f(projected[at + RED], projected[at + GREEN], projected[at + BLUE]),
  );
}

// The splat of a pair, with WANTED.
fn marked_splat(pair: u32) -> u32 {
  return slot_splat[pair_slot[pair]];
}

fn tile_corner(tile: u32) -> vec2u {
  return vec2u(tile % view.tiles_x, tile / view.tiles_x) * TILE;
}

fn is_inside(pixel: vec2u) -> bool {
  return pixel.x < view.width && pixel.y < view.height;
}

// Center of a tile's pixel, from the tile's corner.
fn pixel_center(number: u32) -> vec2f {
  return vec2f(vec2u(number % TILE, number / TILE)) + 0.5;
}

// Opacity · density at an offset from the splat's center: squares, whose sign rounding cannot turn.
fn raw_alpha(splat: Splat, dx: f32, dy: f32) -> f32 {
  let along = dx - splat.shear * dy;
  return splat.opacity * exp(-0.5 * (splat.precision_x * along * along + splat.precision_y * dy * dy));
}

// Splats are fetched a workgroup's worth at a time.
var<workgroup> batch: array<Splat, WORKGROUP>;
var<workgroup> open_pixels: atomic<u32>; // that something behind can still be seen through
var<workgroup> is_open: u32;

@compute @workgroup_size(WORKGROUP)
fn forward(thread: Thread) {
  let local = thread.local;
  let tile = workgroup_number(thread);
  if tile >= view.tiles_x * view.tiles_y || rendered[tile] == 0u {
    return;
  }
  let corner = tile_corner(tile);
  let pixel = corner + vec2u(local % TILE, local / TILE);
  let center = pixel_center(local);
  var open = is_inside(pixel);
  var color = vec3f(0.0);
  var t = 1.0;
  var last = 0u;
  let range = tile_range[tile];
  for (var cut = range.x + (1u + local) * SEGMENT_PAIRS; cut < range.y; cut += WORKGROUP * SEGMENT_PAIRS) {
    segment_tile[cut / SEGMENT_PAIRS] = tile;
  }
  var segment = range.x;
  var segment_color = vec3f(0.0);
  for (var begin = range.x; begin < range.y; begin += WORKGROUP) {
    if !anyone_open(open, local) {
      break;
    }
    if begin - segment == SEGMENT_PAIRS {
      write_segment_color(segment, range.x, local, segment_color);
      segment = begin;
      segment_color = vec3f(0.0);
      segments[segment_word(segment, 3u, local)] = t;
    }
    if begin + local < range.y {
      batch[local] = fetch(marked_splat(begin + local) & ~WANTED, vec2f(corner));
    }
    workgroupBarrier();
    let length = min(WORKGROUP, range.y - begin);
    for (var q = 0u; open && q < length; q++) {
      let splat = batch[q];
      let offset = center - splat.mean;
      let a = min(MAX_ALPHA, raw_alpha(splat, offset.x, offset.y));
      if a < MIN_ALPHA {
        continue;
      }
      let after = t * (1.0 - a);
      if after <= MIN_TRANSMITTANCE {
        open = false;
        break;
      }
      color += a * t * splat.color;
      segment_color += a * t * splat.color;
      t = after;
      last = begin + q - range.x + 1u;
    }
  }
  write_segment_color(segment, range.x, local, segment_color);
  if !is_inside(pixel) {
    return;
  }
  color += t * view.background.rgb;
  let n = pixel.y * view.width + pixel.x;
  let area = view.width * view.height;
  image[n] = color.x;
  image[area + n] = color.y;
  image[2u * area + n] = color.z;
  pixels[n] = vec2u(bitcast<u32>(t), last);
}

// What a segment adds, unless it is the tile's first.
fn write_segment_color(segment: u32, first: u32, local: u32, color: vec3f) {
  if segment > first {
    segments[segment_word(segment, 0u, local)] = color.x;
    segments[segment_word(segment, 1u, local)] = color.y;
    segments[segment_word(segment, 2u, local)] = color.z;
  }
}

// Whether any pixel of the tile is open; also separates the use of one batch from the fetching of the next.
fn anyone_open(open: bool, local: u32) -> bool {
  if local == 0u {
    atomicStore(&open_pixels, 0u);
  }
  workgroupBarrier();
  if open {
    atomicStore(&open_pixels, 1u);
  }
  workgroupBarrier();
  if local == 0u {
    is_open = atomicLoad(&open_pixels);
  }
  return workgroupUniformLoad(&is_open) == 1u;
}

// Part of a tile's list: the pairs from `begin` to one before `end`; an empty one has the tile NO_TILE.
struct Segment {
  tile: u32,
  begin: u32,
  end: u32,
}

const NO_TILE: u32 = 0xffffffffu;

// A workgroup's: first those that tiles begin with, then those behind cuts.
fn segment_of(group: u32) -> Segment {
  let none = Segment(NO_TILE, 0u, 0u);
  let tiles = view.tiles_x * view.tiles_y;
  let cut = group - min(group, tiles);
  if cut > view.capacity / SEGMENT_PAIRS {
    return none;
  }
  var tile = group;
  if group >= tiles {
    tile = segment_tile[cut];
  }
  if tile >= tiles || touched[tile] == 0u {
    return none;
  }
  let range = tile_range[tile];
  var begin = range.x;
  if group >= tiles {
    let first = range.x / SEGMENT_PAIRS;
    begin += (cut - min(cut, first)) * SEGMENT_PAIRS;
    if cut <= first || begin >= range.y { // what an earlier image has left
      return none;
    }
  }
  return Segment(tile, begin, min(range.y, begin + SEGMENT_PAIRS));
}

// Gradient of every wanted pair of the touched tiles with respect to its splat's projected columns.
//
// BATCH pairs at a time, far to near, in two steps. First a thread is a pixel, walks through the batch and leaves what
// each pair weighs there and how strongly its exponent counts. Then PAIR_THREADS threads are a pair and add up its
// pixels, each every PAIR_THREADS-th, and their sums in the order of threads. So no sum depends on chance or on the
// width of subgroups, and every pair writes a row of its own.

override HAS_V_TRANSMITTANCE: bool = false;

const BATCH: u32 = 8u;
const PAIR_THREADS: u32 = WORKGROUP / BATCH;
const PIXELS_PER_THREAD: u32 = PIXELS / PAIR_THREADS;
const POWERS: u32 = BATCH * PIXELS; // where the exponents' gradients begin, after the weights
const SUM_STRIDE: u32 = PAIR_THREADS + 1u; // so that sums side by side lie in different banks of memory

var<workgroup> scratch: array<f32, 2u * BATCH * PIXELS>;
var<workgroup> v_color: array<vec3f, PIXELS>;
var<workgroup> deepest_past: atomic<u32>;
var<workgroup> nearest_wanted: atomic<u32>;
var<workgroup> walk: vec2u; // first pair, and one past the last, that matter

@compute @workgroup_size(WORKGROUP)
fn backward(thread: Thread) {
  let local = thread.local;
  let segment = segment_of(workgroup_number(thread));
  if segment.tile == NO_TILE {
    return;
  }
  let range = tile_range[segment.tile];
  let corner = tile_corner(segment.tile);
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
    behind = dot(view.background.rgb, v);
    if HAS_V_TRANSMITTANCE {
      behind += v_transmittance[n];
    }
    behind *= t;
    if range.x + last > segment.end {
      for (var cut = segment.end; cut < range.x + last; cut += SEGMENT_PAIRS) {
        let color = vec3f(
          segments[segment_word(cut, 0u, local)],
          segments[segment_word(cut, 1u, local)],
          segments[segment_word(cut, 2u, local)],
        );
        behind += dot(color, v);
      }
      t = segments[segment_word(segment.end, 3u, local)];
    }
  }
  v_color[local] = v;
  let bounds = find_walk(segment, range.x + last, local);
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

// Of a segment, the pairs from the nearest wanted one to the deepest that any pixel sees; writes zeros for the wanted
// ones behind. past: one past this pixel's last.
fn find_walk(segment: Segment, past: u32, local: u32) -> vec2u {
  if local == 0u {
    atomicStore(&deepest_past, segment.begin);
    atomicStore(&nearest_wanted, segment.end);
  }
  workgroupBarrier();
  atomicMax(&deepest_past, min(past, segment.end));
  for (var j = segment.begin + local; j < segment.end; j += WORKGROUP) {
    if marked_splat(j) >= WANTED {
      atomicMin(&nearest_wanted, j);
      break;
    }
  }
  workgroupBarrier();
  if local == 0u {
    walk = vec2u(atomicLoad(&nearest_wanted), atomicLoad(&deepest_past));
  }
  let found = workgroupUniformLoad(&walk);
  for (var j = found.y + local; j < segment.end; j += WORKGROUP) {
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
