// Where each tile's list begins and ends among the sorted pairs.

@group(0) @binding(0) var<storage, read> counts: array<u32>;
@group(0) @binding(1) var<storage, read> pair_tile: array<u32>; // (P,) sorted
@group(0) @binding(2) var<storage, read_write> tile_range: array<vec2u>; // zero before

// A thread a pair.
@compute @workgroup_size(WORKGROUP)
fn main(thread: Thread) {
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
