// Strain around each triangle, and frames moved by it, as `avatar/strain.py` and `avatar/embedding.py` define them.

@group(0) @binding(0) var<uniform> pose: Pose;
// (M, F): a triangle that shares an edge with each triangle, another one, …; F where there is none.
@group(0) @binding(1) var<storage, read> neighbors: array<u32>;
// (F, S, 3): `Avatar.strain_position`.
@group(0) @binding(2) var<storage, read> coefficients: array<f32>;
// (F, S): strain less that at rest, averaged in the rounds so far.
@group(0) @binding(3) var<storage, read> nearby: array<f32>;
// (F, S): the same, averaged once more.
@group(0) @binding(4) var<storage, read_write> averaged: array<f32>;
@group(0) @binding(5) var<storage, read_write> frames: array<f32>;

// The mean of a triangle's strain and of those that share an edge with it, component by component.
@compute @workgroup_size(WORKGROUP)
fn average(
  @builtin(workgroup_id) workgroup: vec3u,
  @builtin(num_workgroups) workgroups: vec3u,
  @builtin(local_invocation_index) local: u32,
) {
  let f = thread_number(workgroup, workgroups, local);
  if f >= pose.triangles {
    return;
  }
  for (var k = 0u; k < pose.strains; k++) {
    var total = nearby[f * pose.strains + k];
    var count = 1.0;
    for (var n = 0u; n < pose.neighbors; n++) {
      let other = neighbors[n * pose.triangles + f];
      if other < pose.triangles {
        total += nearby[other * pose.strains + k];
        count += 1.0;
      }
    }
    averaged[f * pose.strains + k] = total / count;
  }
}

// Move a triangle's origin by Σ nearby · coefficients, in the triangle's axes and unit.
@compute @workgroup_size(WORKGROUP)
fn shift(
  @builtin(workgroup_id) workgroup: vec3u,
  @builtin(num_workgroups) workgroups: vec3u,
  @builtin(local_invocation_index) local: u32,
) {
  let f = thread_number(workgroup, workgroups, local);
  if f >= pose.triangles {
    return;
  }
  var moved = vec3f(0.0);
  for (var k = 0u; k < pose.strains; k++) {
    let row = f * pose.strains + k;
    moved += nearby[row] * vec3f(coefficients[3u * row], coefficients[3u * row + 1u], coefficients[3u * row + 2u]);
  }
  let at = f * (FRAME_STRAIN + pose.strains);
  for (var axis = 0u; axis < 3u; axis++) {
    let row = at + FRAME_MATRIX + 3u * axis;
    frames[at + FRAME_ORIGIN + axis] += dot(vec3f(frames[row], frames[row + 1u], frames[row + 2u]), moved);
  }
}
