// How many (tile, splat) pairs there are, and before each splat in order of depth.
//
// Where the pairs exceed the capacity, or did so in an earlier submit, the device goes on with none at all: no splat is
// wanted then and no parameter changes, until the host has made room and clears OVERFLOWED.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> order: array<u32>; // (N,) splats, near to far
@group(0) @binding(2) var<storage, read> rect: array<vec4i>;
@group(0) @binding(3) var<storage, read> rendered: array<u32>;
@group(0) @binding(4) var<storage, read_write> counts: array<u32>;
// (N + workgroups,) by place in `order`: pairs within the workgroup up to this splat; then the pairs of each workgroup,
// and in the end those before it.
@group(0) @binding(5) var<storage, read_write> pairs_until: array<u32>;
@group(0) @binding(6) var<storage, read> projected: array<f32>;
@group(0) @binding(7) var<storage, read> focus: array<u32>;
@group(0) @binding(8) var<storage, read_write> wanted: array<u32>;

const TOO_MANY: u32 = 0x7fffffffu; // sums end here instead of overflowing

var<workgroup> sums: array<u32, WORKGROUP>;

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

// The sum of `value` over this thread and those before it.
fn sum_until(value: u32, local: u32) -> u32 {
  sums[local] = value;
  for (var step = 1u; step < WORKGROUP; step *= 2u) {
    workgroupBarrier();
    var earlier = 0u;
    if local >= step {
      earlier = sums[local - step];
    }
    workgroupBarrier();
    sums[local] = min(sums[local] + earlier, TOO_MANY);
  }
  workgroupBarrier();
  return sums[local];
}

// A thread a splat.
@compute @workgroup_size(WORKGROUP)
fn count(thread: Thread) {
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

// One workgroup.
@compute @workgroup_size(WORKGROUP)
fn total(@builtin(local_invocation_index) local: u32) {
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
