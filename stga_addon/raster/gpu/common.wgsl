// Common to all kernels, after the constants and the struct View of layout.py.

// A thread in a dispatch whose workgroups fill rows of up to 65,535 (see Device.groups).
struct Thread {
  @builtin(workgroup_id) workgroup: vec3u,
  @builtin(num_workgroups) workgroups: vec3u,
  @builtin(local_invocation_index) local: u32,
}

fn workgroup_number(thread: Thread) -> u32 {
  return thread.workgroup.y * thread.workgroups.x + thread.workgroup.x;
}

fn thread_number(thread: Thread) -> u32 {
  return workgroup_number(thread) * WORKGROUP + thread.local;
}

// Words per row of the tables of splats and of their gradients.
fn splat_stride(view: View) -> u32 {
  return SH + 3u * view.coefficients + 3u * view.strain_colors;
}

// Words per row of the table of triangle frames.
fn frame_stride(view: View) -> u32 {
  return FRAME_STRAIN + view.frame_strains;
}

const MAX_EXPONENT: f32 = 88.0; // the largest whose exponential float32 holds
const REACH_MARGIN: f32 = 1.0e-5; // for the error that WGSL allows a logarithm

// By its bits, because a shader's compiler may assume that there are no infinities and NaNs.
fn is_finite(value: f32) -> bool {
  return (bitcast<u32>(value) & 0x7f800000u) != 0x7f800000u;
}

fn is_nan(value: f32) -> bool {
  return (bitcast<u32>(value) & 0x7fffffffu) > 0x7f800000u;
}

fn bounded_exp(value: f32) -> f32 {
  return exp(min(value, MAX_EXPONENT));
}

fn sigmoid(logit: f32) -> f32 {
  return 1.0 / (1.0 + bounded_exp(-logit));
}

// What PRECISION_X·(dx − SHEAR·dy)² + PRECISION_Y·dy² is where a splat's alpha has fallen to MIN_ALPHA.
fn reach_of(opacity: f32) -> f32 {
  return 2.0 * log(255.0 * opacity) + REACH_MARGIN;
}
