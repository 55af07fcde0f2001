// Camera-space frames and deformation of a posed mesh's triangles, as `avatar/embedding.py` and `avatar/strain.py` define
// them, and their move by driven offsets (`avatar/offsets.py`). A thread is a triangle.
//
// Shaders have no float64. A position is therefore a sum of two float32 numbers, relative to the mesh's first vertex, of
// which only differences and means are formed: an edge is as exact as float32 can hold it.

var<uniform> pose: Pose;
var<storage> vertices: array<f32>; // (V, 6): a position's float32 and what is left of it
var<storage> faces: array<u32>; // (F, 3)
// (F,) area in the neutral mesh, 0 where a triangle counts as a line.
var<storage> neutral_area: array<f32>;
// (F, BASIS_STRIDE): `gram`, `to_tensor`, `to_plane`, `normal` and `range` of the `StrainBasis`.
var<storage> basis: array<f32>;
// (V + 1 + 3·F): where the triangles that touch a vertex begin in this array, then those triangles.
var<storage> vertex_faces: array<u32>;
// (F, 6): a triangle's own strain as xx, yy, zz, xy, yz, zx.
var<storage> tensors: array<f32>;
var<storage> strain_from_rest: array<f32>; // (F, 3): strain less that at rest
var<storage> normal_change: array<f32>; // (F, 3): of the unit normal, world axes
// (F + 1 + N): where the triangles that share an edge with a triangle begin in this array, then those triangles.
var<storage> neighbors: array<u32>;
var<storage> smoothed: array<f32>; // (F, 3): as averaged in the rounds so far
var<storage> averaged: array<f32>; // (F, 3): once more

const LEAST_STRAIN: f32 = 3.0e-6; // twice what float32's rounding makes of none
const TENSOR: u32 = 6u; // words of a tensor
const TO_TENSOR: u32 = 3u; // columns of `basis`
const TO_PLANE: u32 = 21u;
const NORMAL: u32 = 39u;
const LOWEST: u32 = 42u; // three of strain, three of the normal's change
const HIGHEST: u32 = 48u;
const BASIS_STRIDE: u32 = 54u;

struct Edges {
  first: vec3f, // from corner 0 to corner 1
  second: vec3f, // from corner 0 to corner 2
  third: vec3f, // from corner 1 to corner 2
  center: vec3f,
}

fn vertex_vec3(at: u32) -> vec3f {
  return vec3f(vertices[at], vertices[at + 1u], vertices[at + 2u]);
}

fn edge_between(a: u32, b: u32) -> vec3f {
  return (vertex_vec3(b) - vertex_vec3(a)) + (vertex_vec3(b + 3u) - vertex_vec3(a + 3u));
}

fn edges_of(f: u32) -> Edges {
  let a = 6u * faces[3u * f];
  let b = 6u * faces[3u * f + 1u];
  let c = 6u * faces[3u * f + 2u];
  let center = (vertex_vec3(a) + vertex_vec3(b) + vertex_vec3(c)) / 3.0;
  return Edges(edge_between(a, b), edge_between(a, c), edge_between(b, c), center);
}

// The unit normal beside a unit axis; any perpendicular where the triangle is a line.
fn perpendicular(first: vec3f, raw_normal: vec3f, longest: f32) -> vec3f {
  var normal = raw_normal;
  if length(normal) <= 2.0 * MIN_AREA_RATIO * longest {
    normal = cross(first, select(vec3f(0.0, 0.0, 1.0), vec3f(1.0, 0.0, 0.0), abs(first.z) > UPRIGHT_COSINE));
  }
  normal -= dot(normal, first) * first;
  return normal / length(normal);
}

// Write a triangle's origin and matrix: camera point = matrix · local + origin. And its deformation, where it is wanted.
@compute @workgroup_size(WORKGROUP)
fn compose(thread: Thread) {
  let f = thread_number(thread);
  if f >= pose.triangles {
    return;
  }
  let e = edges_of(f);
  let longest = max(dot(e.first, e.first), max(dot(e.second, e.second), dot(e.third, e.third)));
  let least = MIN_AREA_RATIO * sqrt(longest);
  let raw_normal = cross(e.first, e.second);
  let edge = length(e.first);
  var first = e.first;
  if pose.area_scales == 1u {
    first = -(e.first + e.second) / 3.0; // from the center to corner 0
  }
  if length(first) <= least {
    first = vec3f(1.0, 0.0, 0.0);
  } else {
    first /= length(first);
  }
  let normal = perpendicular(first, raw_normal, longest);
  var axes = mat3x3f(first, normal, cross(first, normal));
  var across = length(e.second);
  if edge > least {
    across = length(raw_normal) / edge;
  }
  var scale = 0.5 * (edge + across);
  if pose.area_scales == 1u {
    axes = mat3x3f(first, cross(normal, first), normal);
    scale = 1.0;
    if neutral_area[f] > 0.0 {
      scale = sqrt(0.5 * length(raw_normal) / neutral_area[f]);
    }
  }
  let at = f * FRAME_STRIDE;
  let center = vec4f(e.center, 1.0);
  for (var axis = 0u; axis < 3u; axis++) {
    frames[at + FRAME_ORIGIN + axis] = dot(pose.rows[axis], center);
    let row = scale * (pose.rows[axis].xyz * axes);
    for (var c = 0u; c < 3u; c++) {
      frames[at + FRAME_MATRIX + 3u * axis + c] = row[c];
    }
  }
  for (var c = 0u; c < 3u; c++) {
    frames[at + FRAME_COLOR + c] = 0.0;
  }
  if pose.follows == 1u {
    write_tensor(f, e);
    write_normal_change(f, raw_normal);
  }
}

// Of the unit normal, 0 of a posed triangle without area; none where the neutral one has none.
fn write_normal_change(f: u32, raw_normal: vec3f) {
  let at = f * BASIS_STRIDE;
  let neutral = vec3f(basis[at + NORMAL], basis[at + NORMAL + 1u], basis[at + NORMAL + 2u]);
  let size = length(raw_normal);
  let unit = select(vec3f(0.0), raw_normal / size, size * size >= MIN_SQUARED_NORMAL);
  let change = select(vec3f(0.0), unit - neutral, dot(neutral, neutral) > 0.0);
  for (var c = 0u; c < 3u; c++) {
    let within = clamp(change[c], basis[at + LOWEST + 3u + c], basis[at + HIGHEST + 3u + c]);
    normal_change[3u * f + c] = select(within, 0.0, abs(within) < LEAST_STRAIN);
  }
}

// Green's strain of a triangle: the change of its edges' squared lengths and product, as a tensor.
fn write_tensor(f: u32, e: Edges) {
  let at = f * BASIS_STRIDE;
  let gram = vec3f(dot(e.first, e.first), dot(e.first, e.second), dot(e.second, e.second));
  let change = gram - vec3f(basis[at], basis[at + 1u], basis[at + 2u]);
  for (var d = 0u; d < TENSOR; d++) {
    let row = at + TO_TENSOR + d;
    tensors[TENSOR * f + d] = change.x * basis[row] + change.y * basis[row + TENSOR]
      + change.z * basis[row + 2u * TENSOR];
  }
}

// Strain in the triangle's own directions: of the mean over its corners of the mean over the triangles touching each.
@compute @workgroup_size(WORKGROUP)
fn average_strain(thread: Thread) {
  let f = thread_number(thread);
  if f >= pose.triangles {
    return;
  }
  var mean: array<f32, TENSOR>;
  for (var corner = 0u; corner < 3u; corner++) {
    let vertex = faces[3u * f + corner];
    let end = vertex_faces[vertex + 1u];
    let share = 1.0 / (3.0 * f32(max(end - vertex_faces[vertex], 1u)));
    for (var n = vertex_faces[vertex]; n < end; n++) {
      for (var d = 0u; d < TENSOR; d++) {
        mean[d] += share * tensors[TENSOR * vertex_faces[n] + d];
      }
    }
  }
  for (var k = 0u; k < STRAIN_COMPONENTS; k++) {
    let row = f * BASIS_STRIDE + TO_PLANE + TENSOR * k;
    var strain = 0.0;
    for (var d = 0u; d < TENSOR; d++) {
      strain += mean[d] * basis[row + d];
    }
    let lowest = basis[f * BASIS_STRIDE + LOWEST + k];
    let highest = basis[f * BASIS_STRIDE + HIGHEST + k];
    strain = clamp(STRAIN_GAIN * strain, lowest, highest);
    // Rounding of a rigid triangle is no strain: Adam would take its sign for a gradient and step at full rate.
    strain = select(strain, 0.0, abs(strain) < LEAST_STRAIN);
    strain_from_rest[3u * f + k] = strain - clamp(0.0, lowest, highest);
  }
}

// The mean of a triangle's strain and of those that share an edge with it: one round of averaging.
@compute @workgroup_size(WORKGROUP)
fn smooth_strain(thread: Thread) {
  let f = thread_number(thread);
  if f >= pose.triangles {
    return;
  }
  for (var k = 0u; k < STRAIN_COMPONENTS; k++) {
    var total = smoothed[3u * f + k];
    let end = neighbors[f + 1u];
    for (var n = neighbors[f]; n < end; n++) {
      total += smoothed[3u * neighbors[n] + k];
    }
    averaged[3u * f + k] = total / f32(1u + end - neighbors[f]);
  }
}

// Σ signal · coefficients of a triangle.
fn driven(f: u32) -> vec3f {
  var change = vec3f(0.0);
  for (var row = 3u * f; row < 3u * f + 3u; row++) {
    change += driving[row] * vec3f(coefficients[3u * row], coefficients[3u * row + 1u], coefficients[3u * row + 2u]);
  }
  return change;
}

// Add what is driven to a triangle's color.
@compute @workgroup_size(WORKGROUP)
fn move_color(thread: Thread) {
  let f = thread_number(thread);
  if f >= pose.triangles {
    return;
  }
  let change = driven(f);
  for (var c = 0u; c < 3u; c++) {
    frames[f * FRAME_STRIDE + FRAME_COLOR + c] += change[c];
  }
}

// Move a triangle's origin by what is driven, in the triangle's axes and unit.
@compute @workgroup_size(WORKGROUP)
fn move_position(thread: Thread) {
  let f = thread_number(thread);
  if f >= pose.triangles {
    return;
  }
  let moved = driven(f);
  let at = f * FRAME_STRIDE;
  for (var axis = 0u; axis < 3u; axis++) {
    let row = at + FRAME_MATRIX + 3u * axis;
    frames[at + FRAME_ORIGIN + axis] += dot(vec3f(frames[row], frames[row + 1u], frames[row + 2u]), moved);
  }
}

// Scale a triangle's frame by the exponential of the first component of what is driven, about its origin.
@compute @workgroup_size(WORKGROUP)
fn move_scale(thread: Thread) {
  let f = thread_number(thread);
  if f >= pose.triangles {
    return;
  }
  let enlargement = exp(driven(f).x);
  for (var c = 0u; c < 9u; c++) {
    frames[f * FRAME_STRIDE + FRAME_MATRIX + c] *= enlargement;
  }
}
