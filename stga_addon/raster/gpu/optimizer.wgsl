// What the optimizer's kernels share: the uniform `step`, and the fields of a splat's row.

struct Step {
  rates: array<vec4f, 2>, // by field, see field_of(); the last is that of the harmonics above the constant one
  beta1: f32,
  beta2: f32,
  log_beta1: f32,
  log_beta2: f32,
  epsilon: f32,
  newest: f32, // least share of a step in the running average
  scale_weight: f32,
  distance_weight: f32,
  opacity_weight: f32, // already divided by the number of splats
  statistics: u32, // 1: collect what density control asks for
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
