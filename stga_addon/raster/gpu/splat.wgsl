// What projection forward and backward share: reading a splat, placing it in the camera, spherical harmonics.
//
// Needs numbers.wgsl, the uniform `view`, and the tables `splats` and `frames`.

const SH_WEIGHTS = array<f32, 10>(
  0.28209479177387814, 0.4886025119029199, 1.0925484305920792, 0.31539156525252005, 0.5462742152960396,
  0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277,
);
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

fn splat_vec3(at: u32) -> vec3f {
  return vec3f(splats[at], splats[at + 1u], splats[at + 2u]);
}

fn frame_vec3(at: u32) -> vec3f {
  return vec3f(frames[at], frames[at + 1u], frames[at + 2u]);
}

fn read_frame(triangle: u32) -> Frame {
  let at = triangle * frame_stride(view);
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
  return mat3x3f(
    view.to_world_00, view.to_world_10, view.to_world_20,
    view.to_world_01, view.to_world_11, view.to_world_21,
    view.to_world_02, view.to_world_12, view.to_world_22,
  );
}

fn used_coefficients() -> u32 {
  return (view.degree + 1u) * (view.degree + 1u);
}

// Real spherical harmonics of a unit direction; those above the degree in use are zero.
fn harmonics(d: vec3f) -> array<f32, MAX_COEFFICIENTS> {
  var b: array<f32, MAX_COEFFICIENTS>;
  let xx = d.x * d.x;
  let yy = d.y * d.y;
  let zz = d.z * d.z;
  b[0] = SH_WEIGHTS[0];
  if view.degree > 0u {
    b[1] = -SH_WEIGHTS[1] * d.y;
    b[2] = SH_WEIGHTS[1] * d.z;
    b[3] = -SH_WEIGHTS[1] * d.x;
  }
  if view.degree > 1u {
    b[4] = SH_WEIGHTS[2] * d.x * d.y;
    b[5] = -SH_WEIGHTS[2] * d.y * d.z;
    b[6] = SH_WEIGHTS[3] * (2.0 * zz - xx - yy);
    b[7] = -SH_WEIGHTS[2] * d.x * d.z;
    b[8] = SH_WEIGHTS[4] * (xx - yy);
  }
  if view.degree > 2u {
    b[9] = -SH_WEIGHTS[5] * d.y * (3.0 * xx - yy);
    b[10] = SH_WEIGHTS[6] * d.x * d.y * d.z;
    b[11] = -SH_WEIGHTS[7] * d.y * (4.0 * zz - xx - yy);
    b[12] = SH_WEIGHTS[8] * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
    b[13] = -SH_WEIGHTS[7] * d.x * (4.0 * zz - xx - yy);
    b[14] = SH_WEIGHTS[9] * d.z * (xx - yy);
    b[15] = -SH_WEIGHTS[5] * d.x * (xx - 3.0 * yy);
  }
  return b;
}
