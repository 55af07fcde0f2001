// Adam on the splats and on the coefficients of driven offsets, with the gradients of the limits. Rows that are not
// wanted, and triangles without a wanted splat, keep every bit.

var<uniform> step: Step;
var<storage> traits: array<vec2f>; // (N,) 1 if unbound, else 0; share of unseen cameras
var<storage> limits: array<f32>; // (F, 3) scale of bound and of unbound splats, distance
// A workgroup's excess of scale (xy) and of distance (zw).
var<storage> excess: array<vec4f>;
var<storage> norms: array<f32>; // (2,) of scale and of distance
// (N, 3): steps, sum of the screen gradients and number of summands; the latter two are bits of float32.
var<storage> history: array<u32>;
// (N, 4): what corrects the first and second moment's bias, the step's share in the average, all three bits of
// float32; and a bit for each field that keeps its value because its gradient is broken.
var<storage> corrections: array<vec4u>;
// Moments and moving average, of the splats or of an offset's coefficients.
var<storage> first: array<f32>;
var<storage> second: array<f32>;
var<storage> average: array<f32>;
var<storage> steps: array<u32>; // (F,) of its triangles
// (F + 1 + N): where each triangle's splats begin in this array, then those splats.
var<storage> splats_of: array<u32>;

// Of a driven offset: where the splats' gradient that trains it begins in a row, by how much of it, and its learning rate.
override TARGET: u32 = 0u;
override IS_SCALE: bool = false; // then it is that of the logarithm of the triangle's scale
override PER_UNIT: f32 = 1.0;
override RATE: u32 = 0u;
override RATE_FRACTION: f32 = 1.0;

const REST_RATE: u32 = 5u; // of the harmonics above the constant one

// Number of the parameter that a column of a row belongs to: in the order of `cpu.layout.Parameters`.
fn field_of(column: u32) -> u32 {
  return u32(column >= ROTATION) + u32(column >= LOG_SCALE) + u32(column >= OPACITY_LOGIT) + u32(column >= SH);
}

// For the given step of a row: what corrects the first and the second moment's bias, and its share in the average.
fn corrections_at(count: u32) -> vec3f {
  let n = f32(count);
  return vec3f(
    1.0 / one_minus_exp(n * step.log_beta1 + log(1.0 - step.ahead)),
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

// How far the splats exceed the limits of size and distance, as norms over all wanted rows, in two steps: a value for
// each workgroup, then one workgroup for all.
//
// A sum of squares is kept as (largest, Σ (value / largest)²), whose parts stay in float32's range.

var<workgroup> parts: array<vec4f, WORKGROUP>;

fn is_unbound(i: u32) -> bool {
  return traits[i].x > 0.0;
}

fn scale_limit(i: u32) -> f32 {
  return limits[3u * face[i] + u32(is_unbound(i))];
}

fn join(a: vec2f, b: vec2f) -> vec2f {
  let largest = max(a.x, b.x);
  if largest == 0.0 {
    return vec2f(0.0);
  }
  let shrunk = vec2f(a.x, b.x) / largest;
  return vec2f(largest, a.y * shrunk.x * shrunk.x + b.y * shrunk.y * shrunk.y);
}

fn join_both(a: vec4f, b: vec4f) -> vec4f {
  return vec4f(join(a.xy, b.xy), join(a.zw, b.zw));
}

fn join_workgroup(value: vec4f, index: u32) {
  parts[index] = value;
  for (var half = WORKGROUP / 2u; half > 0u; half /= 2u) {
    workgroupBarrier();
    if index < half {
      parts[index] = join_both(parts[index], parts[index + half]);
    }
  }
}

@compute @workgroup_size(WORKGROUP)
fn measure_excess(thread: Thread) {
  let i = thread_number(thread);
  var found = vec4f(0.0);
  if i < view.splats && wanted[i] != 0u {
    let at = i * splat_stride();
    let limit = scale_limit(i);
    for (var c = 0u; c < 3u; c++) {
      let over = max(0.0, bounded_exp(splats[at + LOG_SCALE + c]) - limit);
      found = vec4f(join(found.xy, vec2f(over, 1.0)), found.zw);
    }
    if !is_unbound(i) {
      found.z = max(0.0, length(splat_vec3(at + XYZ)) - limits[3u * face[i] + 2u]);
      found.w = 1.0;
    }
  }
  join_workgroup(found, thread.local);
  if thread.local == 0u {
    excess[i / WORKGROUP] = parts[0];
  }
}

@compute @workgroup_size(WORKGROUP)
fn join_excess(@builtin(local_invocation_index) local: u32) {
  let count = (view.splats + WORKGROUP - 1u) / WORKGROUP;
  var value = vec4f(0.0);
  for (var n = local; n < count; n += WORKGROUP) {
    value = join_both(value, excess[n]);
  }
  join_workgroup(value, local);
  if local == 0u {
    norms[0] = parts[0].x * sqrt(parts[0].y);
    norms[1] = parts[0].z * sqrt(parts[0].w);
  }
}

// Before Adam, a thread for each wanted row: the gradients of the limits, the row's step count and what follows from
// it, and the statistics of density control.
@compute @workgroup_size(WORKGROUP)
fn prepare(thread: Thread) {
  let i = thread_number(thread);
  if i >= view.splats || wanted[i] == 0u {
    return;
  }
  let at = i * splat_stride();
  // scale_weight · ‖ReLU(scale − limit)‖₂
  if step.scale_weight > 0.0 && norms[0] > 0.0 {
    let limit = scale_limit(i);
    for (var c = at + LOG_SCALE; c < at + LOG_SCALE + 3u; c++) {
      let scale = bounded_exp(splats[c]);
      gradients[c] += step.scale_weight / norms[0] * max(0.0, scale - limit) * scale;
    }
  }
  // distance_weight · ‖ReLU(|xyz| − limit)‖₂ over the bound splats
  if step.distance_weight > 0.0 && norms[1] > 0.0 && !is_unbound(i) {
    let away = length(splat_vec3(at + XYZ));
    let over = max(0.0, away - limits[3u * face[i] + 2u]);
    for (var c = at + XYZ; over > 0.0 && c < at + XYZ + 3u; c++) {
      gradients[c] += step.distance_weight / norms[1] * (over / away) * splats[c];
    }
  }
  let visible = sigmoid(splats[at + OPACITY_LOGIT]);
  gradients[at + OPACITY_LOGIT] += step.opacity_weight * traits[i].y * visible * (1.0 - visible);
  history[3u * i] += 1u;
  corrections[i] = vec4u(bitcast<vec3u>(corrections_at(history[3u * i])), broken_fields(i));
  if step.statistics == 1u {
    history[3u * i + 1u] = bitcast<u32>(bitcast<f32>(history[3u * i + 1u]) + screen[i]);
    history[3u * i + 2u] = bitcast<u32>(bitcast<f32>(history[3u * i + 2u]) + 1.0);
  }
}

// Bit f is set where a gradient of field f is not finite, or so large that Adam cannot square it.
fn broken_fields(i: u32) -> u32 {
  let stride = splat_stride();
  var broken = 0u;
  for (var c = 0u; c < stride; c++) {
    broken |= select(0u, 1u << field_of(c), is_too_large(gradients[i * stride + c]));
  }
  return broken;
}

// Advance the moments of a value; returns what its step takes from it.
fn adam_step(n: u32, gradient: f32, rate: f32, correct: vec3f) -> f32 {
  let m = step.beta1 * first[n] + (1.0 - step.beta1) * gradient;
  let v = step.beta2 * second[n] + (1.0 - step.beta2) * gradient * gradient;
  first[n] = m;
  second[n] = v;
  let along = m + step.ahead * (gradient - m);
  return rate * along * correct.x / (sqrt(v) * correct.y + step.epsilon);
}

// One step of Adam on the wanted rows, a thread a value.
@compute @workgroup_size(WORKGROUP)
fn adam(thread: Thread) {
  let n = thread_number(thread);
  let stride = splat_stride();
  let i = n / stride;
  if i >= view.splats || wanted[i] == 0u {
    return;
  }
  let column = n % stride;
  let field = field_of(column);
  if ((corrections[i].w >> field) & 1u) == 1u {
    return;
  }
  let correct = bitcast<vec3f>(corrections[i].xyz);
  let is_rest = column >= SH + 3u;
  let rate = select(field, REST_RATE, is_rest);
  let value = splats[n] - adam_step(n, gradients[n], step.rates[rate / 4u][rate % 4u], correct);
  splats[n] = value;
  average[n] += correct.z * (value - average[n]);
}

// One step of Adam on a driven offset's coefficients, a thread a triangle, before the limits change the splats'
// gradients.
@compute @workgroup_size(WORKGROUP)
fn step_offset(thread: Thread) {
  let f = thread_number(thread);
  if f >= step.triangles {
    return;
  }
  var total = vec3f(0.0); // a triangle changes all its splats alike, so its gradient is their sum
  var is_wanted = false;
  for (var n = splats_of[f]; n < splats_of[f + 1u]; n++) {
    let i = splats_of[n];
    if wanted[i] != 0u {
      let at = i * splat_stride() + TARGET;
      let gradient = vec3f(gradients[at], gradients[at + 1u], gradients[at + 2u]);
      if IS_SCALE {
        let sizes = i * splat_stride() + LOG_SCALE;
        total.x += dot(splat_vec3(i * splat_stride() + XYZ), gradient) + gradients[sizes] + gradients[sizes + 1u]
          + gradients[sizes + 2u];
      } else {
        total += gradient;
      }
      is_wanted = true;
    }
  }
  if !is_wanted {
    return;
  }
  steps[f] += 1u;
  total *= PER_UNIT;
  var broken = !(is_finite(total.x) && is_finite(total.y) && is_finite(total.z));
  for (var c = 0u; c < 9u; c++) {
    broken = broken || is_too_large(driving[3u * f + c / 3u] * total[c % 3u]);
  }
  if broken {
    return;
  }
  let correct = corrections_at(steps[f]);
  let rate = RATE_FRACTION * step.rates[RATE / 4u][RATE % 4u];
  for (var c = 0u; c < 9u; c++) {
    let n = 9u * f + c;
    let gradient = driving[3u * f + c / 3u] * total[c % 3u];
    let stepped = coefficients[n] - adam_step(n, gradient, rate, correct);
    coefficients[n] = stepped;
    average[n] += correct.z * (stepped - average[n]);
  }
}
