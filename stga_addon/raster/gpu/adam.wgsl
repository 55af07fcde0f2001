// One step of Adam on the wanted rows, a thread a value; rows that are not wanted keep every bit.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<storage, read> wanted: array<u32>;
@group(0) @binding(3) var<storage, read> corrections: array<vec4u>; // see rows.wgsl
@group(0) @binding(4) var<storage, read> gradients: array<f32>;
@group(0) @binding(5) var<storage, read_write> splats: array<f32>;
@group(0) @binding(6) var<storage, read_write> first: array<f32>;
@group(0) @binding(7) var<storage, read_write> second: array<f32>;
@group(0) @binding(8) var<storage, read_write> average: array<f32>;

const REST_RATE: u32 = 6u; // of the harmonics above the constant one

@compute @workgroup_size(WORKGROUP)
fn main(thread: Thread) {
  let n = thread_number(thread);
  let stride = splat_stride(view);
  let i = n / stride;
  if i >= view.splats || wanted[i] == 0u {
    return;
  }
  let column = n % stride;
  let field = field_of(view, column);
  if ((corrections[i].w >> field) & 1u) == 1u {
    return;
  }
  let correct = bitcast<vec3f>(corrections[i].xyz);
  let is_rest = column >= SH + 3u && column < SH + 3u * view.coefficients;
  let rate = select(field, REST_RATE, is_rest);
  let g = gradients[n];
  let m = step.beta1 * first[n] + (1.0 - step.beta1) * g;
  let v = step.beta2 * second[n] + (1.0 - step.beta2) * g * g;
  first[n] = m;
  second[n] = v;
  let value = splats[n] - step.rates[rate / 4u][rate % 4u] * m * correct.x / (sqrt(v) * correct.y + step.epsilon);
  splats[n] = value;
  average[n] += correct.z * (value - average[n]);
}
