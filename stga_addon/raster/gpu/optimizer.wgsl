// What the optimizer's kernels share: the uniform `step`, the fields of a splat's row, and a step's corrections.

struct Step {
  rates: array<vec4f, 2>, // by field, see field_of(); the last is that of the harmonics above the constant one
  beta1: f32,
  beta2: f32,
  log_beta1: f32,
  log_beta2: f32,
  epsilon: f32,
  ema_share: f32, // least share of a step in the exponential moving average
  scale_weight: f32,
  distance_weight: f32,
  opacity_weight: f32, // already divided by the number of splats
  statistics: u32, // 1: collect what density control asks for
  triangles: u32, // whose splats driven offsets move
  padding: u32,
}

// Number of the parameter that a column of a row belongs to: in the order of `cpu.layout.Parameters`.
fn field_of(view: View, column: u32) -> u32 {
  if column < ROTATION {
    return 0u;
  }
  if column < LOG_SCALE {
    return 1u;
  }
  if column < OPACITY_LOGIT {
    return 2u;
  }
  if column < SH {
    return 3u;
  }
  return select(5u, 4u, column < SH + 3u * view.coefficients);
}

// For the given step of a row: what corrects the first and the second moment's bias, and its share in the average.
fn corrections_at(step: Step, count: u32) -> vec3f {
  let n = f32(count);
  return vec3f(
    1.0 / one_minus_exp(n * step.log_beta1),
    1.0 / sqrt(one_minus_exp(n * step.log_beta2)),
    max(step.ema_share, 4.0 / (n + 3.0)),
  );
}

// 1 − exp(x) of a negative number; as a series where the difference would cancel.
fn one_minus_exp(x: f32) -> f32 {
  if x < -0.5 {
    return 1.0 - exp(x);
  }
  var series = 1.0;
  for (var n = 9.0; n > 1.0; n -= 1.0) {
    series = 1.0 + series * x / n;
  }
  return -x * series;
}

// Whether a gradient is not finite, or so large that Adam cannot square it.
fn is_too_large(gradient: f32) -> bool {
  let size = bitcast<u32>(gradient) & 0x7fffffffu; // ordered like the absolute values
  return size >= bitcast<u32>(MAX_GRADIENT);
}
