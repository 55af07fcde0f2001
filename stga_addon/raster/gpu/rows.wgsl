// Before Adam, a thread for each wanted row: the gradients of the limits, the row's step count and what follows from
// it, and the statistics of density control.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<storage, read> splats: array<f32>;
@group(0) @binding(3) var<storage, read> face: array<u32>;
@group(0) @binding(4) var<storage, read> wanted: array<u32>;
@group(0) @binding(5) var<storage, read> traits: array<vec2f>; // (N,) 1 if unbound, else 0; share of unseen cameras
@group(0) @binding(6) var<storage, read> limits: array<f32>; // (F, 3) scale of bound and of unbound splats, distance
@group(0) @binding(7) var<storage, read> norms: array<f32>;
@group(0) @binding(8) var<storage, read> screen: array<f32>;
@group(0) @binding(9) var<storage, read_write> gradients: array<f32>;
// (N, 3): steps, sum of the screen gradients and number of summands; the latter two are bits of float32.
@group(0) @binding(10) var<storage, read_write> history: array<u32>;
// (N, 4): what corrects the first and second moment's bias, the step's share in the average, all three bits of
// float32; and a bit for each field that keeps its value because its gradient is broken.
@group(0) @binding(11) var<storage, read_write> corrections: array<vec4u>;

@compute @workgroup_size(WORKGROUP)
fn main(thread: Thread) {
  let i = thread_number(thread);
  if i >= view.splats || wanted[i] == 0u {
    return;
  }
  limit_scale(i);
  limit_distance(i);
  let at = i * splat_stride(view);
  let visible = sigmoid(splats[at + OPACITY_LOGIT]);
  gradients[at + OPACITY_LOGIT] += step.opacity_weight * traits[i].y * visible * (1.0 - visible);
  count_step(i);
  if step.statistics == 1u {
    history[3u * i + 1u] = bitcast<u32>(bitcast<f32>(history[3u * i + 1u]) + screen[i]);
    history[3u * i + 2u] = bitcast<u32>(bitcast<f32>(history[3u * i + 2u]) + 1.0);
  }
}

// The gradient of scale_weight · ‖ReLU(scale − limit)‖₂.
fn limit_scale(i: u32) {
  if !(step.scale_weight > 0.0 && norms[0] > 0.0) {
    return;
  }
  let at = i * splat_stride(view) + LOG_SCALE;
  let limit = limits[3u * face[i] + select(0u, 1u, traits[i].x > 0.0)];
  for (var c = 0u; c < 3u; c++) {
    let scale = bounded_exp(splats[at + c]);
    gradients[at + c] += step.scale_weight / norms[0] * max(0.0, scale - limit) * scale;
  }
}

// The gradient of distance_weight · ‖ReLU(|xyz| − limit)‖₂ over the bound splats.
fn limit_distance(i: u32) {
  if !(step.distance_weight > 0.0 && norms[1] > 0.0) || traits[i].x > 0.0 {
    return;
  }
  let at = i * splat_stride(view) + XYZ;
  let away = length(vec3f(splats[at], splats[at + 1u], splats[at + 2u]));
  let over = away - limits[3u * face[i] + 2u];
  if over > 0.0 {
    for (var c = 0u; c < 3u; c++) {
      gradients[at + c] += step.distance_weight / norms[1] * (over / away) * splats[at + c];
    }
  }
}

fn count_step(i: u32) {
  let count = history[3u * i] + 1u;
  history[3u * i] = count;
  corrections[i] = vec4u(bitcast<vec3u>(corrections_at(step, count)), broken_fields(i));
}

// Bit f is set where a gradient of field f is not finite, or so large that Adam cannot square it.
fn broken_fields(i: u32) -> u32 {
  let stride = splat_stride(view);
  var broken = 0u;
  for (var c = 0u; c < stride; c++) {
    broken |= select(0u, 1u << field_of(view, c), is_too_large(gradients[i * stride + c]));
  }
  return broken;
}
