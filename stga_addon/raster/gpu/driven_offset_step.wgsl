// One step of Adam on a driven offset's coefficients, a thread a triangle, before the limits change the splats'
// gradients.
//
// A triangle of which no splat is wanted keeps every bit.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<storage, read> wanted: array<u32>;
@group(0) @binding(3) var<storage, read> gradients: array<f32>; // of the splats
// (F + 1 + N): where each triangle's splats begin in this array, then those splats.
@group(0) @binding(4) var<storage, read> splats_of: array<u32>;
@group(0) @binding(5) var<storage, read> driving: array<f32>; // (F, S): its signal
@group(0) @binding(6) var<storage, read_write> steps: array<u32>; // (F,)
// (F, S, 3), as are the moments and the exponential moving average.
@group(0) @binding(7) var<storage, read_write> value: array<f32>;
@group(0) @binding(8) var<storage, read_write> first: array<f32>;
@group(0) @binding(9) var<storage, read_write> second: array<f32>;
@group(0) @binding(10) var<storage, read_write> average: array<f32>;

override SIGNALS: u32; // S
override RATE_SHARE: f32; // learning rate, as a share of that of the splats' positions

@compute @workgroup_size(WORKGROUP)
fn main(thread: Thread) {
  let f = thread_number(thread);
  if f >= step.triangles {
    return;
  }
  var moved = vec3f(0.0); // a triangle moves all its splats alike, so its gradient is their sum
  var is_wanted = false;
  for (var n = splats_of[f]; n < splats_of[f + 1u]; n++) {
    let i = splats_of[n];
    if wanted[i] != 0u {
      let at = i * splat_stride(view) + XYZ;
      moved += vec3f(gradients[at], gradients[at + 1u], gradients[at + 2u]);
      is_wanted = true;
    }
  }
  if !is_wanted {
    return;
  }
  steps[f] += 1u;
  if !(is_finite(moved.x) && is_finite(moved.y) && is_finite(moved.z)) {
    return;
  }
  var broken = false;
  for (var c = 0u; c < 3u * SIGNALS; c++) {
    broken = broken || is_too_large(driving[f * SIGNALS + c / 3u] * moved[c % 3u]);
  }
  if broken {
    return;
  }
  let correct = corrections_at(step, steps[f]);
  for (var c = 0u; c < 3u * SIGNALS; c++) {
    let n = 3u * SIGNALS * f + c;
    let gradient = driving[f * SIGNALS + c / 3u] * moved[c % 3u];
    let m = step.beta1 * first[n] + (1.0 - step.beta1) * gradient;
    let v = step.beta2 * second[n] + (1.0 - step.beta2) * gradient * gradient;
    first[n] = m;
    second[n] = v;
    let stepped = value[n] - RATE_SHARE * step.rates[0].x * m * correct.x / (sqrt(v) * correct.y + step.epsilon);
    value[n] = stepped;
    average[n] += correct.z * (stepped - average[n]);
  }
}
