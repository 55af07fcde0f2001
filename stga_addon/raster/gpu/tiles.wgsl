// Which tiles are rendered, and every tile's list of pairs, near to far.
//
// Where the pairs exceed the capacity, or did so in an earlier submit, the device goes on with none at all: no splat is
// wanted then and no parameter changes, until the host has made room and clears OVERFLOWED.

var<storage> touched: array<atomic<u32>>; // (tiles,) 1 for those that a splat in focus reaches
var<storage> order: array<u32>; // (N,) splats, near to far
// (N + workgroups,) by place in `order`: pairs within the workgroup up to this splat; then the pairs of each workgroup,
// and in the end those before it.
var<storage> pairs_until: array<u32>;
var<storage> slot_tile: array<u32>; // (P,)
var<storage> pair_tile: array<u32>; // (P,) sorted

// A thread a splat; `touched` is zero before.
@compute @workgroup_size(WORKGROUP)
fn mark_touched(thread: Thread) {
  let i = thread_number(thread);
  if i >= view.splats || focus[i] == 0u {
    return;
  }
  let r = rect[i];
  for (var y = r.y; y < r.w; y++) {
    for (var x = r.x; x < r.z; x++) {
      atomicStore(&touched[u32(y) * view.tiles_x + u32(x)], 1u);
    }
  }
}

// A thread a tile: render the touched tiles and those at most view.ring tiles away, or all without a focus.
@compute @workgroup_size(WORKGROUP)
fn choose_rendered(thread: Thread) {
  let tile = thread_number(thread);
  if tile >= view.tiles_x * view.tiles_y {
    return;
  }
  tile_range[tile] = vec2u(0u);
  if view.focused == 0u {
    atomicStore(&touched[tile], 1u);
    rendered[tile] = 1u;
    return;
  }
  let x = tile % view.tiles_x;
  let y = tile / view.tiles_x;
  var near = 0u;
  for (var row = y - min(y, view.ring); row < min(view.tiles_y, y + view.ring + 1u); row++) {
    for (var column = x - min(x, view.ring); column < min(view.tiles_x, x + view.ring + 1u); column++) {
      near |= atomicLoad(&touched[row * view.tiles_x + column]);
    }
  }
  rendered[tile] = near;
}

// Which tiles a splat reaches: of those within its bounds the rendered ones whose pixels its outline, the ellipse on
// which alpha = MIN_ALPHA, may touch. See `cpu/blend.py`.

struct Outline {
  mean: vec2f,
  extent_y: f32, // half height, pixels
  lean: f32, // x of its highest point
  rate: f32, // of the middle of a chord along y, by x
  chord: f32, // square of half the chord through the mean
  cut: f32, // what that loses, by x²
  slack: f32, // pixels, so that rounding loses none
}

fn outline_of(i: u32) -> Outline {
  let at = i * PROJECTED;
  let precision_x = projected[at + PRECISION_X];
  let shear = projected[at + SHEAR];
  let precision_y = projected[at + PRECISION_Y];
  let reach = reach_of(projected[at + OPACITY]);
  let shrink = 1.0 / (precision_x * shear * shear + precision_y);
  var o: Outline;
  o.mean = vec2f(projected[at + MEAN_X], projected[at + MEAN_Y]);
  o.extent_y = sqrt(reach / precision_y);
  o.lean = shear * o.extent_y;
  o.rate = precision_x * shear * shrink;
  o.chord = reach * shrink;
  o.cut = precision_x * precision_y * shrink * shrink;
  o.slack = 0.01 + 1.0e-3 * sqrt(o.chord) + 1.0e-6 * o.extent_y;
  return o;
}

// Whether a pixel's center of a tile lies within an outline.
fn touches(o: Outline, tile: vec2u) -> bool {
  let mean = o.mean - vec2f(tile * TILE) - 0.5; // from the center of the tile's first pixel
  let last = f32(TILE - 1u);
  let low = -mean.x;
  let high = low + last;
  let nearest = clamp(0.0, low, high);
  if o.cut * nearest * nearest > 1.00001 * o.chord {
    return false;
  }
  // Between the tile's outermost columns the ellipse is highest where it is highest altogether, or else at the nearer
  // edge, and likewise lowest.
  let top = clamp(-o.lean, low, high);
  let bottom = clamp(o.lean, low, high);
  let up = o.rate * top - sqrt(max(0.0, o.chord - o.cut * top * top)) - o.slack;
  let down = o.rate * bottom + sqrt(max(0.0, o.chord - o.cut * bottom * bottom)) + o.slack;
  let height = o.extent_y + 1.0e-3;
  let first = ceil(max(0.0, mean.y + max(up, -height)));
  return first <= min(last, mean.y + min(down, height));
}

fn is_listed(o: Outline, tile: vec2u) -> bool {
  return rendered[tile.y * view.tiles_x + tile.x] == 1u && touches(o, tile);
}

// How many tiles to be rendered a visible splat reaches.
fn pairs_of(i: u32, r: vec4u) -> u32 {
  let outline = outline_of(i);
  var found = 0u;
  for (var y = r.y; y < r.w; y++) {
    for (var x = r.x; x < r.z; x++) {
      found += u32(is_listed(outline, vec2u(x, y)));
    }
  }
  return found;
}

// How many pairs each splat has, a thread each in order of depth.
@compute @workgroup_size(WORKGROUP)
fn count_pairs(thread: Thread) {
  let local = thread.local;
  let n = thread_number(thread);
  var found = 0u;
  if n < view.splats {
    let i = order[n];
    let is_visible = rect[i].z > rect[i].x;
    if is_visible {
      found = pairs_of(i, vec4u(rect[i]));
    }
    // Also where no pixel sees it, as on the CPU.
    wanted[i] = u32(is_visible && (view.focused == 0u || focus[i] == 1u));
  }
  let until = sum_until(found, local);
  if n < view.splats {
    pairs_until[n] = until;
  }
  if local == WORKGROUP - 1u && n - local < view.splats {
    pairs_until[view.splats + n / WORKGROUP] = until;
  }
}

// How many there are before each splat and in all; one workgroup.
@compute @workgroup_size(WORKGROUP)
fn add_pairs(@builtin(local_invocation_index) local: u32) {
  let blocks = (view.splats + WORKGROUP - 1u) / WORKGROUP;
  var before = 0u; // all earlier rounds
  for (var round = 0u; round < blocks; round += WORKGROUP) {
    let block = round + local;
    var own = 0u;
    if block < blocks {
      own = pairs_until[view.splats + block];
    }
    let until = sum_until(own, local);
    if block < blocks {
      pairs_until[view.splats + block] = min(before + until - own, TOO_MANY);
    }
    before = min(before + sums[WORKGROUP - 1u], TOO_MANY);
    workgroupBarrier();
  }
  if local == 0u {
    let fits = before <= view.capacity && counts[OVERFLOWED] == 0u;
    let pairs = select(0u, before, fits);
    counts[PAIRS] = pairs;
    counts[NEEDED] = before;
    counts[OVERFLOWED] = select(1u, 0u, fits);
    counts[SORT_GROUPS] = (pairs + SORT_BLOCK - 1u) / SORT_BLOCK;
    counts[SORT_GROUPS + 1u] = 1u;
    counts[SORT_GROUPS + 2u] = 1u;
    let groups = (pairs + WORKGROUP - 1u) / WORKGROUP;
    let rows = max(1u, (groups + MAX_GROUPS - 1u) / MAX_GROUPS);
    counts[PAIR_GROUPS] = (groups + rows - 1u) / rows;
    counts[PAIR_GROUPS + 1u] = rows;
    counts[PAIR_GROUPS + 2u] = 1u;
  }
}

// The pairs of every splat by slot, consecutive for each splat and in order of depth, with their tiles as keys.
@compute @workgroup_size(WORKGROUP)
fn fill_pairs(thread: Thread) {
  let n = thread_number(thread);
  if n >= view.splats {
    return;
  }
  let i = order[n];
  var found = 0u;
  if counts[OVERFLOWED] == 0u {
    found = pairs_until[n];
    if thread.local > 0u {
      found -= pairs_until[n - 1u];
    }
  }
  var slot = pairs_until[view.splats + n / WORKGROUP] + pairs_until[n] - found;
  slots[i] = vec2u(slot, found);
  if counts[OVERFLOWED] == 1u {
    wanted[i] = 0u;
  }
  if found == 0u {
    return;
  }
  let marked = i | (wanted[i] * WANTED);
  let outline = outline_of(i);
  let r = vec4u(rect[i]);
  for (var y = r.y; y < r.w; y++) {
    for (var x = r.x; x < r.z; x++) {
      if is_listed(outline, vec2u(x, y)) {
        slot_tile[slot] = y * view.tiles_x + x;
        slot_splat[slot] = marked;
        slot++;
      }
    }
  }
}

// Where each tile's list begins and ends among the sorted pairs, a thread a pair.
@compute @workgroup_size(WORKGROUP)
fn find_ranges(thread: Thread) {
  let j = thread_number(thread);
  if j >= counts[PAIRS] {
    return;
  }
  let tile = pair_tile[j];
  if j == 0u || pair_tile[max(j, 1u) - 1u] != tile {
    tile_range[tile].x = j;
  }
  if j + 1u == counts[PAIRS] || pair_tile[j + 1u] != tile {
    tile_range[tile].y = j + 1u;
  }
}
