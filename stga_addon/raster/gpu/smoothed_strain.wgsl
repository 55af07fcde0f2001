// Strain around each triangle, as `avatar/strain.py` defines it: one round of averaging.

@group(0) @binding(0) var<uniform> pose: Pose;
// (F + 1 + N): where the triangles that share an edge with a triangle begin in this array, then those triangles.
@group(0) @binding(1) var<storage, read> neighbors: array<u32>;
// (F, S): strain less that at rest, averaged in the rounds so far.
@group(0) @binding(2) var<storage, read> smoothed: array<f32>;
// (F, S): the same, averaged once more.
@group(0) @binding(3) var<storage, read_write> averaged: array<f32>;

// The mean of a triangle's strain and of those that share an edge with it, component by component.
@compute @workgroup_size(WORKGROUP)
fn main(thread: Thread) {
  let f = thread_number(thread);
  if f >= pose.triangles {
    return;
  }
  for (var k = 0u; k < pose.strains; k++) {
    var total = smoothed[f * pose.strains + k];
    let end = neighbors[f + 1u];
    for (var n = neighbors[f]; n < end; n++) {
      total += smoothed[neighbors[n] * pose.strains + k];
    }
    averaged[f * pose.strains + k] = total / f32(1u + end - neighbors[f]);
  }
}
