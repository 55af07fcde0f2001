// How far the splats exceed the limits of size and distance, as norms over all wanted rows, in two steps: a value for
// each workgroup, then one workgroup for all.
//
// A sum of squares is kept as (largest, Σ (value / largest)²), whose parts stay in float32's range.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> splats: array<f32>;
@group(0) @binding(2) var<storage, read> face: array<u32>;
@group(0) @binding(3) var<storage, read> wanted: array<u32>;
@group(0) @binding(4) var<storage, read> traits: array<vec2f>; // (N,) see rows.wgsl
@group(0) @binding(5) var<storage, read> limits: array<f32>; // (F, 3) see rows.wgsl
// A workgroup's excess of scale (xy) and of distance (zw).
@group(0) @binding(6) var<storage, read_write> excess: array<vec4f>;
@group(0) @binding(7) var<storage, read_write> norms: array<f32>; // (2,) of scale and of distance

var<workgroup> parts: array<vec4f, WORKGROUP>;

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

fn excess_of(i: u32) -> vec4f {
  let at = i * splat_stride(view);
  let unbound = traits[i].x > 0.0;
  let limit = limits[3u * face[i] + select(0u, 1u, unbound)];
  var found = vec4f(0.0);
  for (var c = 0u; c < 3u; c++) {
    let over = max(0.0, bounded_exp(splats[at + LOG_SCALE + c]) - limit);
    found = vec4f(join(found.xy, vec2f(over, 1.0)), found.zw);
  }
  if !unbound {
    let away = length(vec3f(splats[at + XYZ], splats[at + XYZ + 1u], splats[at + XYZ + 2u]));
    found.z = max(0.0, away - limits[3u * face[i] + 2u]);
    found.w = 1.0;
  }
  return found;
}

@compute @workgroup_size(WORKGROUP)
fn measure(thread: Thread) {
  let local = thread.local;
  let i = thread_number(thread);
  var value = vec4f(0.0);
  if i < view.splats && wanted[i] != 0u {
    value = excess_of(i);
  }
  join_workgroup(value, local);
  if local == 0u {
    excess[i / WORKGROUP] = parts[0];
  }
}

@compute @workgroup_size(WORKGROUP)
fn total(@builtin(local_invocation_index) local: u32) {
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
