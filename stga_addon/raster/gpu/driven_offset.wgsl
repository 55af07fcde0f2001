// Frames moved by a driven offset, as `avatar/offsets/offset.py` defines it: a thread a triangle.

override SIGNALS: u32; // S

@group(0) @binding(0) var<uniform> pose: Pose;
// (F, S, 3): `Avatar.driven_offsets`.
@group(0) @binding(1) var<storage, read> coefficients: array<f32>;
// (F, S): its signal.
@group(0) @binding(2) var<storage, read> driving: array<f32>;
@group(0) @binding(3) var<storage, read_write> frames: array<f32>;

// Move a triangle's origin by Σ signal · coefficients, in the triangle's axes and unit.
@compute @workgroup_size(WORKGROUP)
fn main(thread: Thread) {
  let f = thread_number(thread);
  if f >= pose.triangles {
    return;
  }
  var moved = vec3f(0.0);
  for (var k = 0u; k < SIGNALS; k++) {
    let row = f * SIGNALS + k;
    moved += driving[row] * vec3f(coefficients[3u * row], coefficients[3u * row + 1u], coefficients[3u * row + 2u]);
  }
  let at = f * (FRAME_STRAIN + pose.strains);
  for (var axis = 0u; axis < 3u; axis++) {
    let row = at + FRAME_MATRIX + 3u * axis;
    frames[at + FRAME_ORIGIN + axis] += dot(vec3f(frames[row], frames[row + 1u], frames[row + 2u]), moved);
  }
}
