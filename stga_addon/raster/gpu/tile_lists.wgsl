// From the sorted pairs: whose each one is, and where each tile's list begins and ends.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> pair_tile: array<u32>; // (P,) sorted
@group(0) @binding(3) var<storage, read> pair_slot: array<u32>; // (P,) in the same order
@group(0) @binding(4) var<storage, read> slot_splat: array<u32>;
@group(0) @binding(5) var<storage, read_write> pairs: array<vec2u>; // (P,) splat, with WANTED, and slot
@group(0) @binding(6) var<storage, read_write> tile_range: array<vec2u>; // zero before

// A thread a pair.
@compute @workgroup_size(WORKGROUP)
fn main(
  @builtin(workgroup_id) workgroup: vec3u,
  @builtin(num_workgroups) workgroups: vec3u,
  @builtin(local_invocation_index) local: u32,
) {
  let j = thread_number(workgroup, workgroups, local);
  if j >= counts[PAIRS] {
    return;
  }
  let tile = pair_tile[j];
  let slot = pair_slot[j];
  pairs[j] = vec2u(slot_splat[slot], slot);
  if j == 0u || pair_tile[max(j, 1u) - 1u] != tile {
    tile_range[tile].x = j;
  }
  if j + 1u == counts[PAIRS] || pair_tile[j + 1u] != tile {
    tile_range[tile].y = j + 1u;
  }
}
