// Embedding, projection and color of every splat, a thread each, and the gradient back to it. The formulas, and what
// has to be taken together because it cancels, are in `cpu/project.py`.

var<storage> depth_key: array<u32>; // (N,) bits of a splat's depth; HIDDEN where it is not visible
var<storage> selected: array<u32>; // (F,) bytes, four to a word
var<storage> blend_weights: array<f32>; // (N,)

const MAX_COEFFICIENTS: u32 = 16u;

struct Frame {
  origin: vec3f,
  row_x: vec3f, // of the matrix from the triangle to the camera
  row_y: vec3f,
  row_z: vec3f,
}

struct CameraSplat {
  position: vec3f,
  slope: vec2f, // x / z and y / z
  limited: vec2f, // the slope within the limits of the projection's Jacobian
  quaternion: vec4f, // unit, wxyz
  inverse_norm: f32,
  turn: mat3x3f,
  scale: vec3f,
  u0: vec3f, // rows of the map U from the local frame to pixels
  u1: vec3f,
  a0: vec3f, // rows of A = U · turn · diag(scale); the covariance is A·Aᵀ + LOW_PASS_PX2·I
  a1: vec3f,
  minors: vec3f, // a0 × a1
}

fn frame_vec3(at: u32) -> vec3f {
  return vec3f(frames[at], frames[at + 1u], frames[at + 2u]);
}

fn read_frame(triangle: u32) -> Frame {
  let at = triangle * FRAME_STRIDE;
  return Frame(
    frame_vec3(at + FRAME_ORIGIN),
    frame_vec3(at + FRAME_MATRIX),
    frame_vec3(at + FRAME_MATRIX + 3u),
    frame_vec3(at + FRAME_MATRIX + 6u),
  );
}

fn to_camera(frame: Frame, local: vec3f) -> vec3f {
  return vec3f(dot(frame.row_x, local), dot(frame.row_y, local), dot(frame.row_z, local)) + frame.origin;
}

// Unit quaternion and 1 / norm of one of any length; zero counts as no rotation, with 1 / norm = 0. Those far from
// length one are first scaled by a power of two, because their squares leave float32's range.
fn unit_quaternion(q: vec4f, inverse_norm: ptr<function, f32>) -> vec4f {
  let size = abs(q.x) + abs(q.y) + abs(q.z) + abs(q.w);
  if size == 0.0 {
    *inverse_norm = 0.0;
    return vec4f(1.0, 0.0, 0.0, 0.0);
  }
  var lift = 1.0;
  if size < 1.0e-12 {
    lift = QUATERNION_LIFT;
  } else if size > 1.0e12 {
    lift = 1.0 / QUATERNION_LIFT;
  }
  let lifted = q * lift;
  let inverse = 1.0 / sqrt(dot(lifted, lifted));
  *inverse_norm = min(inverse * lift, 1.0e12);
  return lifted * inverse;
}

// Rotation matrix of a unit quaternion wxyz, which WGSL's vec4f calls x, y, z, w.
fn rotation_matrix(q: vec4f) -> mat3x3f {
  let w = q.x;
  let x = q.y;
  let y = q.z;
  let z = q.w;
  return mat3x3f( // by columns
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y),
  );
}

// x / z or y / z, kept within the image plus 0.3 of its half field of view.
fn limit_slope(slope: f32, size: u32, focal: f32, principal: f32) -> f32 {
  let margin = 0.3 * (0.5 * f32(size) / focal);
  return min((f32(size) - principal) / focal + margin, max(-principal / focal - margin, slope));
}

fn place(at: u32, frame: Frame, position: vec3f) -> CameraSplat {
  var s: CameraSplat;
  s.position = position;
  let r = 1.0 / position.z;
  s.slope = position.xy * r;
  s.limited = vec2f(
    limit_slope(s.slope.x, view.width, view.fl_x, view.cx),
    limit_slope(s.slope.y, view.height, view.fl_y, view.cy),
  );
  let raw = vec4f(splats[at + ROTATION], splat_vec3(at + ROTATION + 1u));
  var inverse_norm = 0.0;
  s.quaternion = unit_quaternion(raw, &inverse_norm);
  s.inverse_norm = inverse_norm;
  s.turn = rotation_matrix(s.quaternion);
  let log_scale = splat_vec3(at + LOG_SCALE);
  s.scale = vec3f(bounded_exp(log_scale.x), bounded_exp(log_scale.y), bounded_exp(log_scale.z));
  s.u0 = view.fl_x * r * (frame.row_x - s.limited.x * frame.row_z);
  s.u1 = view.fl_y * r * (frame.row_y - s.limited.y * frame.row_z);
  s.a0 = (s.u0 * s.turn) * s.scale;
  s.a1 = (s.u1 * s.turn) * s.scale;
  s.minors = cross(s.a0, s.a1);
  return s;
}

// Rotation from the camera to the world, in which the harmonics' directions are.
fn to_world() -> mat3x3f {
  return transpose(mat3x3f(view.to_world[0].xyz, view.to_world[1].xyz, view.to_world[2].xyz));
}

fn used_coefficients() -> u32 {
  return (view.degree + 1u) * (view.degree + 1u);
}

// Real spherical harmonics of a unit direction; formulas and constants are those of `cpu/splat_block.py`.
fn harmonics(d: vec3f) -> array<f32, MAX_COEFFICIENTS> {
  let x = d.x;
  let y = d.y;
  let z = d.z;
  let xx = x * x;
  let yy = y * y;
  let zz = z * z;
  return array<f32, MAX_COEFFICIENTS>(
    C0, -C1 * y, C1 * z, -C1 * x,
    C2 * x * y, -C2 * y * z, C3 * (2.0 * zz - xx - yy), -C2 * x * z, C4 * (xx - yy),
    -C5 * y * (3.0 * xx - yy), C6 * x * y * z, -C7 * y * (4.0 * zz - xx - yy),
    C8 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy), -C7 * x * (4.0 * zz - xx - yy),
    C9 * z * (xx - yy), -C5 * x * (xx - 3.0 * yy),
  );
}

// Which splats ride on a selected triangle, a thread each.
@compute @workgroup_size(WORKGROUP)
fn mark_focus(thread: Thread) {
  let i = thread_number(thread);
  if i < view.splats {
    focus[i] = (selected[face[i] / 4u] >> (8u * (face[i] & 3u))) & 1u;
  }
}

const NOTHING = vec4i(0); // the tile bounds of a splat that is not visible
const BROKEN = vec4i(-1); // and of one that is not finite

@compute @workgroup_size(WORKGROUP)
fn forward(thread: Thread) {
  let i = thread_number(thread);
  if i >= view.splats {
    return;
  }
  depth_key[view.first + i] = HIDDEN;
  rect[view.first + i] = project(i);
}

// Write a visible splat's columns and depth; returns its tile bounds.
fn project(i: u32) -> vec4i {
  let at = i * splat_stride();
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
  let by_face = triangle * FRAME_STRIDE + FRAME_COLOR;
  var color = 0.5 + vec3f(frames[by_face], frames[by_face + 1u], frames[by_face + 2u]);
  for (var k = 0u; k < MAX_COEFFICIENTS; k++) {
    if k < used_coefficients() {
      color += b[k] * splat_vec3(at + SH + 3u * k);
    }
  }
  return color;
}

// Overwrites the wanted rows of `gradients` and `screen`; all others stay as they are.
@compute @workgroup_size(WORKGROUP)
fn backward(thread: Thread) {
  let i = thread_number(thread);
  if i >= view.splats || wanted[i] == 0u {
    return;
  }
  var g = sum_of_pairs(i);
  screen[i] = length(0.5 * vec2f(f32(view.width), f32(view.height)) * vec2f(g[MEAN_X], g[MEAN_Y]));
  let at = i * splat_stride();
  let frame = read_frame(face[i]);
  let s = place(at, frame, to_camera(frame, splat_vec3(at + XYZ)));
  let p = i * PROJECTED;
  let shear = projected[p + SHEAR];
  let opacity = projected[p + OPACITY];

  let inverse_yy = projected[p + PRECISION_Y];
  let residual = inverse_yy * (LOW_PASS_PX2 * s.a0 + cross(s.a1, s.minors));
  let v_variance = -2.0 * projected[p + PRECISION_X] * projected[p + PRECISION_X] * g[PRECISION_X];
  let v_shear = inverse_yy * g[SHEAR];
  var v0 = v_variance * residual + v_shear * s.a1;
  var v1 = v_shear * residual - 2.0 * inverse_yy * inverse_yy * g[PRECISION_Y] * s.a1;
  if view.antialiased == 1u {
    // Of ln sqrt(sharp / det). The factor holds sqrt(sharp), so it is finite where a splat has no area.
    let sharp = dot(s.minors, s.minors);
    let around = LOW_PASS_PX2 * (dot(s.a0, s.a0) + dot(s.a1, s.a1) + LOW_PASS_PX2);
    let v = g[OPACITY] * opacity;
    let w = v * around / ((sharp + around) * max(sharp, 1.0e-30));
    let u = -v * LOW_PASS_PX2 / (sharp + around);
    let by_row_0 = w * cross(s.a1, s.minors) + u * s.a0;
    v0 += by_row_0;
    v1 += w * cross(s.minors, s.a0) + u * s.a1 + shear * by_row_0;
  }
  let by_scale = v0 * residual + v1 * s.a1;
  write_vec3(at + LOG_SCALE, by_scale);
  v0 *= s.scale;
  v1 *= s.scale;
  write_rotation(at, s, outer(s.u0 - shear * s.u1, v0) + outer(s.u1, v1));

  // To U, and through it to the position in the camera, because the Jacobian depends on it.
  let r = 1.0 / s.position.z;
  let from_row_0 = dot(s.turn * v0, frame.row_z);
  let from_row_1 = dot(s.turn * v1, frame.row_z) - shear * from_row_0;
  let focal = vec2f(view.fl_x, view.fl_y);
  let by_limited = -r * focal * vec2f(from_row_0, from_row_1);
  let by_slope = select(vec2f(0.0), by_limited, s.limited == s.slope) + focal * vec2f(g[MEAN_X], g[MEAN_Y]);
  // U shrinks with z as the scales do.
  var v_position = vec3f(by_slope, -(by_scale.x + by_scale.y + by_scale.z) - dot(by_slope, s.slope)) * r;
  // σ(−x) instead of 1 − σ(x), which cancels for nearly opaque splats.
  gradients[at + OPACITY_LOGIT] = g[OPACITY] * opacity * sigmoid(-splats[at + OPACITY_LOGIT]);

  var v_color = vec3f(g[RED], g[GREEN], g[BLUE]);
  if view.depth_as_color == 1u {
    v_position.z += v_color.x;
    v_color = vec3f(0.0);
  } else {
    let color = vec3f(projected[p + RED], projected[p + GREEN], projected[p + BLUE]);
    v_color = select(vec3f(0.0), v_color, color > vec3f(0.0));
  }
  v_position += write_color(at, s.position, v_color);
  write_vec3(at + XYZ, frame.row_x * v_position.x + frame.row_y * v_position.y + frame.row_z * v_position.z);
}

// How many pixels each splat fills: its blend weights' sum, which is the gradient by its color where the image's is 1.
@compute @workgroup_size(WORKGROUP)
fn sum_weights(thread: Thread) {
  let i = thread_number(thread);
  if i >= view.splats {
    return;
  }
  var sum = 0.0;
  if wanted[i] != 0u {
    sum = sum_of_pairs(i)[RED];
  }
  blend_weights[i] = sum;
}

fn sum_of_pairs(i: u32) -> array<f32, PROJECTED> {
  var g: array<f32, PROJECTED>;
  let end = slots[i].x + slots[i].y;
  for (var row = slots[i].x; row < end; row++) {
    for (var c = 0u; c < PROJECTED; c++) {
      g[c] += pair_gradients[row * PROJECTED + c];
    }
  }
  return g;
}

fn write_vec3(at: u32, value: vec3f) {
  gradients[at] = value.x;
  gradients[at + 1u] = value.y;
  gradients[at + 2u] = value.z;
}

fn outer(column: vec3f, row: vec3f) -> mat3x3f {
  return mat3x3f(column * row.x, column * row.y, column * row.z);
}

// The gradient of the quaternion, along its sphere, from that of the rotation matrix.
fn write_rotation(at: u32, s: CameraSplat, by_turn: mat3x3f) {
  let h = transpose(by_turn); // h[row][column]
  let q = s.quaternion; // wxyz
  let v = 2.0 * vec4f(
    q.w * (h[1][0] - h[0][1]) + q.z * (h[0][2] - h[2][0]) + q.y * (h[2][1] - h[1][2]),
    q.z * (h[0][1] + h[1][0]) + q.w * (h[0][2] + h[2][0]) + q.x * (h[2][1] - h[1][2])
      - 2.0 * q.y * (h[1][1] + h[2][2]),
    q.y * (h[0][1] + h[1][0]) + q.w * (h[1][2] + h[2][1]) + q.x * (h[0][2] - h[2][0])
      - 2.0 * q.z * (h[0][0] + h[2][2]),
    q.y * (h[0][2] + h[2][0]) + q.z * (h[1][2] + h[2][1]) + q.x * (h[1][0] - h[0][1])
      - 2.0 * q.w * (h[0][0] + h[1][1]),
  );
  let along = s.inverse_norm * (v - dot(v, q) * q);
  gradients[at + ROTATION] = along.x;
  write_vec3(at + ROTATION + 1u, along.yzw);
}

// Write the gradients of harmonics; returns what the color's direction adds to the position's.
fn write_color(at: u32, position: vec3f, v_color: vec3f) -> vec3f {
  let away = 1.0 / length(position);
  let direction = to_world() * (position * away);
  var b = harmonics(direction);
  var weights: array<f32, MAX_COEFFICIENTS>;
  for (var k = 0u; k < MAX_COEFFICIENTS; k++) {
    let column = at + SH + 3u * k;
    if k < used_coefficients() {
      write_vec3(column, b[k] * v_color);
      weights[k] = dot(v_color, splat_vec3(column));
    } else if k < view.coefficients {
      write_vec3(column, vec3f(0.0));
    }
  }
  let by_direction = harmonics_gradient(direction, weights);
  return ((by_direction - dot(by_direction, direction) * direction) * away) * to_world();
}

// Gradient with respect to the direction of Σ w[k]·harmonics[k].
fn harmonics_gradient(d: vec3f, w: array<f32, MAX_COEFFICIENTS>) -> vec3f {
  let x = d.x;
  let y = d.y;
  let z = d.z;
  let xx = x * x;
  let yy = y * y;
  let zz = z * z;
  return vec3f(
    -C1 * w[3] + C2 * (y * w[4] - z * w[7]) - 2.0 * C3 * x * w[6] + 2.0 * C4 * x * w[8]
      - 6.0 * C5 * x * y * w[9] + C6 * y * z * w[10] + 2.0 * C7 * x * y * w[11] - 6.0 * C8 * x * z * w[12]
      - C7 * (4.0 * zz - 3.0 * xx - yy) * w[13] + 2.0 * C9 * x * z * w[14] - 3.0 * C5 * (xx - yy) * w[15],
    -C1 * w[1] + C2 * (x * w[4] - z * w[5]) - 2.0 * C3 * y * w[6] - 2.0 * C4 * y * w[8]
      - 3.0 * C5 * (xx - yy) * w[9] + C6 * x * z * w[10] - C7 * (4.0 * zz - xx - 3.0 * yy) * w[11]
      - 6.0 * C8 * y * z * w[12] + 2.0 * C7 * x * y * w[13] - 2.0 * C9 * y * z * w[14] + 6.0 * C5 * x * y * w[15],
    C1 * w[2] - C2 * (y * w[5] + x * w[7]) + 4.0 * C3 * z * w[6] + C6 * x * y * w[10]
      - 8.0 * C7 * y * z * w[11] + C8 * (6.0 * zz - 3.0 * xx - 3.0 * yy) * w[12]
      - 8.0 * C7 * x * z * w[13] + C9 * (xx - yy) * w[14],
  );
}
