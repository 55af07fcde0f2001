// The pairs of every splat by slot, consecutive for each splat and in order of depth, with their tiles as keys.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> order: array<u32>; // (N,) splats, near to far
@group(0) @binding(3) var<storage, read> pairs_until: array<u32>; // see count_pairs.wgsl
@group(0) @binding(4) var<storage, read> rect: array<vec4i>;
@group(0) @binding(5) var<storage, read> rendered: array<u32>;
@group(0) @binding(6) var<storage, read> projected: array<f32>;
@group(0) @binding(7) var<storage, read_write> slots: array<vec2u>;
@group(0) @binding(8) var<storage, read_write> wanted: array<u32>; // see count_pairs.wgsl; 0 where nothing fits
@group(0) @binding(9) var<storage, read_write> slot_tile: array<u32>; // (P,)
@group(0) @binding(10) var<storage, read_write> slot_splat: array<u32>; // (P,) with WANTED

// A thread a splat.
@compute @workgroup_size(WORKGROUP)
fn main(thread: Thread) {
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
