// Embedding, projection and color of every splat, a thread each; the formulas are those of `cpu/project.py`.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> splats: array<f32>;
@group(0) @binding(2) var<storage, read> face: array<u32>;
@group(0) @binding(3) var<storage, read> frames: array<f32>;
@group(0) @binding(4) var<storage, read_write> projected: array<f32>;
@group(0) @binding(5) var<storage, read_write> depth_key: array<u32>;
@group(0) @binding(6) var<storage, read_write> rect: array<vec4i>;

const NOTHING = vec4i(0); // the tile bounds of a splat that is not visible
const BROKEN = vec4i(-1); // and of one that is not finite

@compute @workgroup_size(WORKGROUP)
fn main(thread: Thread) {
  let i = thread_number(thread);
  if i >= view.splats {
    return;
  }
  depth_key[view.first + i] = HIDDEN;
  rect[view.first + i] = project(i);
}

// Write a visible splat's columns and depth; returns its tile bounds.
fn project(i: u32) -> vec4i {
  let at = i * splat_stride(view);
  let frame = read_frame(face[i]);
  let position = to_camera(frame, splat_vec3(at + XYZ));
  // The near plane first: nothing below may divide by a depth of zero.
  if position.z < NEAR_M {
    return NOTHING;
  }
  let log_scale = splat_vec3(at + LOG_SCALE);
  let logit = splats[at + OPACITY_LOGIT];
  if is_nan(log_scale.x) || is_nan(log_scale.y) || is_nan(log_scale.z) || is_nan(logit) {
    return BROKEN;
  }
  let s = place(at, frame, position);
  let xx = dot(s.a0, s.a0) + LOW_PASS_PX2;
  let xy = dot(s.a0, s.a1);
  let yy = dot(s.a1, s.a1) + LOW_PASS_PX2;
  // As squared 2×2 minors plus positive terms the determinant never cancels to zero or below.
  let sharp = dot(s.minors, s.minors);
  let det = sharp + LOW_PASS_PX2 * (xx + yy - LOW_PASS_PX2);
  let mean = vec2f(view.fl_x, view.fl_y) * s.slope + vec2f(view.cx, view.cy);
  if !(is_finite(det) && is_finite(mean.x) && is_finite(mean.y)) {
    return BROKEN;
  }
  var visible = sigmoid(logit);
  if view.antialiased == 1u {
    visible *= sqrt(sharp / det);
  }
  if !(255.0 * visible > 1.0) {
    return NOTHING;
  }
  let reach = reach_of(visible);
  let extent = vec2f(sqrt(reach * xx), sqrt(reach * yy));
  let limit = vec2f(f32(view.tiles_x), f32(view.tiles_y));
  let first = vec2i(clamp(floor((mean - extent) / f32(TILE)), vec2f(0.0), limit));
  let past = vec2i(clamp(ceil((mean + extent) / f32(TILE)), vec2f(0.0), limit));
  if past.x <= first.x || past.y <= first.y {
    return NOTHING;
  }
  var color = color_of(at, face[i], to_world() * (position / length(position)));
  // Before the cut at zero, which would turn NaN and −∞ into black.
  if !(is_finite(color.x) && is_finite(color.y) && is_finite(color.z)) {
    return BROKEN;
  }
  color = max(color, vec3f(0.0));
  if view.depth_as_color == 1u {
    color = vec3f(position.z, 0.0, 0.0);
  }
  depth_key[view.first + i] = bitcast<u32>(position.z); // positive floats are ordered like their bits
  let row = (view.first + i) * PROJECTED;
  projected[row + MEAN_X] = mean.x;
  projected[row + MEAN_Y] = mean.y;
  projected[row + PRECISION_X] = yy / det;
  projected[row + SHEAR] = xy / yy;
  projected[row + PRECISION_Y] = 1.0 / yy;
  projected[row + OPACITY] = visible;
  projected[row + RED] = color.x;
  projected[row + GREEN] = color.y;
  projected[row + BLUE] = color.z;
  return vec4i(first, past);
}

fn color_of(at: u32, triangle: u32, direction: vec3f) -> vec3f {
  var b = harmonics(direction);
  var color = vec3f(0.5);
  for (var k = 0u; k < MAX_COEFFICIENTS; k++) {
    if k < used_coefficients() {
      color += b[k] * splat_vec3(at + SH + 3u * k);
    }
  }
  let by_strain = at + SH + 3u * view.coefficients;
  for (var k = 0u; k < view.strains; k++) {
    color += frames[triangle * frame_stride(view) + FRAME_STRAIN + k] * splat_vec3(by_strain + 3u * k);
  }
  return color;
}
