// Gradient of every wanted splat, a thread each, from those of its pairs. The derivation, and what has to be taken
// together because it cancels, is in `cpu/project.py`.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> splats: array<f32>;
@group(0) @binding(2) var<storage, read> face: array<u32>;
@group(0) @binding(3) var<storage, read> frames: array<f32>;
@group(0) @binding(4) var<storage, read> projected: array<f32>;
@group(0) @binding(5) var<storage, read> wanted: array<u32>;
@group(0) @binding(6) var<storage, read> slots: array<vec2u>;
@group(0) @binding(7) var<storage, read> pair_gradients: array<f32>;
@group(0) @binding(8) var<storage, read_write> gradients: array<f32>;
// (N,) length of the gradient with respect to the projected center in units of half the image, for density control.
@group(0) @binding(9) var<storage, read_write> screen: array<f32>;

// Overwrites the wanted rows of `gradients` and `screen`; all others stay as they are.
@compute @workgroup_size(WORKGROUP)
fn main(thread: Thread) {
  let i = thread_number(thread);
  if i >= view.splats || wanted[i] == 0u {
    return;
  }
  var g = sum_of_pairs(i);
  screen[i] = length(0.5 * vec2f(f32(view.width), f32(view.height)) * vec2f(g[MEAN_X], g[MEAN_Y]));
  let at = i * splat_stride(view);
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
  v_position += write_color(at, face[i], s.position, v_color);
  write_vec3(at + XYZ, frame.row_x * v_position.x + frame.row_y * v_position.y + frame.row_z * v_position.z);
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

// Write the gradients of harmonics and strain colors; returns what the color's direction adds to the position's.
fn write_color(at: u32, triangle: u32, position: vec3f, v_color: vec3f) -> vec3f {
  let away = 1.0 / length(position);
  let direction = to_world() * (position * away);
  var b = harmonics(direction);
  var weights: array<f32, MAX_COEFFICIENTS>;
  for (var k = 0u; k < MAX_COEFFICIENTS; k++) {
    let column = at + SH + 3u * k;
    if k < view.coefficients {
      write_vec3(column, b[k] * v_color); // zero above the degree in use
      if k < used_coefficients() {
        weights[k] = dot(v_color, splat_vec3(column));
      }
    }
  }
  let by_strain = at + SH + 3u * view.coefficients;
  for (var k = 0u; k < view.strain_colors; k++) {
    var strain = 0.0;
    if k < view.strains {
      strain = frames[triangle * frame_stride(view) + FRAME_STRAIN + k];
    }
    write_vec3(by_strain + 3u * k, strain * v_color);
  }
  let by_direction = harmonics_gradient(direction, weights);
  return ((by_direction - dot(by_direction, direction) * direction) * away) * to_world();
}

// Gradient with respect to the direction of Σ w[k]·harmonics[k].
fn harmonics_gradient(d: vec3f, weights: array<f32, MAX_COEFFICIENTS>) -> vec3f {
  var w = weights;
  var g = vec3f(0.0);
  if view.degree > 0u {
    g = SH_WEIGHTS[1] * vec3f(-w[3], -w[1], w[2]);
  }
  if view.degree > 1u {
    g.x += SH_WEIGHTS[2] * (d.y * w[4] - d.z * w[7]) - 2.0 * SH_WEIGHTS[3] * d.x * w[6]
      + 2.0 * SH_WEIGHTS[4] * d.x * w[8];
    g.y += SH_WEIGHTS[2] * (d.x * w[4] - d.z * w[5]) - 2.0 * SH_WEIGHTS[3] * d.y * w[6]
      - 2.0 * SH_WEIGHTS[4] * d.y * w[8];
    g.z += -SH_WEIGHTS[2] * (d.y * w[5] + d.x * w[7]) + 4.0 * SH_WEIGHTS[3] * d.z * w[6];
  }
  if view.degree > 2u {
    let xx = d.x * d.x;
    let yy = d.y * d.y;
    let zz = d.z * d.z;
    g.x += -SH_WEIGHTS[5] * 6.0 * d.x * d.y * w[9] + SH_WEIGHTS[6] * d.y * d.z * w[10]
      + SH_WEIGHTS[7] * 2.0 * d.x * d.y * w[11] - SH_WEIGHTS[8] * 6.0 * d.x * d.z * w[12]
      - SH_WEIGHTS[7] * (4.0 * zz - 3.0 * xx - yy) * w[13] + SH_WEIGHTS[9] * 2.0 * d.x * d.z * w[14]
      - SH_WEIGHTS[5] * 3.0 * (xx - yy) * w[15];
    g.y += -SH_WEIGHTS[5] * 3.0 * (xx - yy) * w[9] + SH_WEIGHTS[6] * d.x * d.z * w[10]
      - SH_WEIGHTS[7] * (4.0 * zz - xx - 3.0 * yy) * w[11] - SH_WEIGHTS[8] * 6.0 * d.y * d.z * w[12]
      + SH_WEIGHTS[7] * 2.0 * d.x * d.y * w[13] - SH_WEIGHTS[9] * 2.0 * d.y * d.z * w[14]
      + SH_WEIGHTS[5] * 6.0 * d.x * d.y * w[15];
    g.z += SH_WEIGHTS[6] * d.x * d.y * w[10] - SH_WEIGHTS[7] * 8.0 * d.y * d.z * w[11]
      + SH_WEIGHTS[8] * (6.0 * zz - 3.0 * xx - 3.0 * yy) * w[12] - SH_WEIGHTS[7] * 8.0 * d.x * d.z * w[13]
      + SH_WEIGHTS[9] * (xx - yy) * w[14];
  }
  return g;
}
