// Which splats ride on a selected triangle, a thread each.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> face: array<u32>;
@group(0) @binding(2) var<storage, read> selected: array<u32>; // (F,) bytes, four to a word
@group(0) @binding(3) var<storage, read_write> focus: array<u32>; // (N,) 0 or 1

@compute @workgroup_size(WORKGROUP)
fn main(thread: Thread) {
  let i = thread_number(thread);
  if i < view.splats {
    focus[i] = (selected[face[i] / 4u] >> (8u * (face[i] & 3u))) & 1u;
  }
}
