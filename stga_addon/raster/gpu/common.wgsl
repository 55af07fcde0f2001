// Common to all kernels, after the constants and structs of layout.py.
//
// A table is a flat array of 32-bit words, row by row, without padding: word c of row i is table[i * stride + c]. N
// splats, F triangles, K SH coefficients, P (tile, splat) pairs, image H × W. `Device.kernel` binds
// those that an entry point uses, for reading where it assigns to none of their words. A file declares what only it uses.

var<uniform> view: View;
var<storage> splats: array<f32>; // (N, 11 + 3K) the fields of `cpu.layout.Parameters` in order
var<storage> gradients: array<f32>; // as the splats
var<storage> face: array<u32>; // (N,) each splat's triangle
// (F, FRAME_STRIDE) a triangle's origin (3), matrix (3, 3) by rows, in camera space; color (3) that is added.
var<storage> frames: array<f32>;
var<storage> coefficients: array<f32>; // (F, 3, 3) of a driven offset: `Avatar.driven_offsets`
var<storage> driving: array<f32>; // (F, 3) its signal
var<storage> projected: array<f32>; // (N, PROJECTED) a splat on the screen: the columns of `cpu.layout`
var<storage> rect: array<vec4i>; // (N,) tile bounds x0, y0, x1, y1 of a splat, as in `Projection`
var<storage> screen: array<f32>; // (N,) length of the gradient by the projected center in units of half the image
var<storage> focus: array<u32>; // (N,) 0 or 1
var<storage> wanted: array<u32>; // (N,) 1 for visible splats in focus: only their gradients are written
var<storage> slots: array<vec2u>; // (N,) a splat's first slot and how many it has: one a pair
var<storage> slot_splat: array<u32>; // (P,) the splat of a slot, with WANTED
var<storage> pair_gradients: array<f32>; // (P, PROJECTED) by slot: the pair's gradient of the projected columns
var<storage> counts: array<u32>; // of pairs, see PAIRS
var<storage> rendered: array<u32>; // (tiles,) 1 for the touched tiles and those that their gradient depends on
var<storage> tile_range: array<vec2u>; // (tiles,) a tile's first pair and one past its last
var<storage> image: array<f32>; // (3, H, W)
var<storage> v_image: array<f32>; // (3, H, W)

// A thread in a dispatch whose workgroups fill rows of up to 65,535 (see Device.groups_of).
struct Thread {
  @builtin(workgroup_id) workgroup: vec3u,
  @builtin(num_workgroups) workgroups: vec3u,
  @builtin(local_invocation_index) local: u32,
}

fn workgroup_number(thread: Thread) -> u32 {
  return thread.workgroup.y * thread.workgroups.x + thread.workgroup.x;
}

fn thread_number(thread: Thread) -> u32 {
  return workgroup_number(thread) * WORKGROUP + thread.local;
}

// Words per row of the tables of splats and of their gradients.
fn splat_stride() -> u32 {
  return SH + 3u * view.coefficients;
}

const MAX_EXPONENT: f32 = 88.0; // the largest whose exponential float32 holds
const REACH_MARGIN: f32 = 1.0e-5; // for the error that WGSL allows a logarithm

// By its bits, because a shader's compiler may assume that there are no infinities and NaNs.
fn is_finite(value: f32) -> bool {
  return (bitcast<u32>(value) & 0x7f800000u) != 0x7f800000u;
}

fn is_nan(value: f32) -> bool {
  return (bitcast<u32>(value) & 0x7fffffffu) > 0x7f800000u;
}

fn splat_vec3(at: u32) -> vec3f {
  return vec3f(splats[at], splats[at + 1u], splats[at + 2u]);
}

fn bounded_exp(value: f32) -> f32 {
  return exp(min(value, MAX_EXPONENT));
}

fn sigmoid(logit: f32) -> f32 {
  return 1.0 / (1.0 + bounded_exp(-logit));
}

// What PRECISION_X·(dx − SHEAR·dy)² + PRECISION_Y·dy² is where a splat's alpha has fallen to MIN_ALPHA.
fn reach_of(opacity: f32) -> f32 {
  return 2.0 * log(255.0 * opacity) + REACH_MARGIN;
}

const TOO_MANY: u32 = 0x7fffffffu; // sums end here instead of overflowing

var<workgroup> sums: array<u32, WORKGROUP>;

// The sum of `value` over this thread of a workgroup and those before it.
fn sum_until(value: u32, local: u32) -> u32 {
  sums[local] = value;
  for (var step = 1u; step < WORKGROUP; step *= 2u) {
    workgroupBarrier();
    var earlier = 0u;
    if local >= step {
      earlier = sums[local - step];
    }
    workgroupBarrier();
    sums[local] = min(sums[local] + earlier, TOO_MANY);
  }
  workgroupBarrier();
  return sums[local];
}
