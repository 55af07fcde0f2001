// Camera-space frames and strain of a posed mesh's triangles, as `avatar/embedding.py` and `avatar/strain.py` define
// them, and their move by driven offsets (`avatar/offsets/offset.py`). A thread is a triangle.
//
// Shaders have no float64. A position is therefore a sum of two float32 numbers, relative to the mesh's first vertex, of
// which only differences and means are formed: an edge is as exact as float32 can hold it.

var<uniform> pose: Pose;
var<storage> vertices: array<f32>; // (V, 6): a position's float32 and what is left of it
var<storage> faces: array<u32>; // (F, 3)
// (F,) area in the neutral mesh, 0 where a triangle counts as a line.
var<storage> neutral_area: array<f32>;
// (F, 21 + 8·S): `gram`, `to_tensor`, `to_plane` and `range` of the `StrainBasis`.
var<storage> basis: array<f32>;
// (V + 1 + 3·F): where the triangles that touch a vertex begin in this array, then those triangles.
var<storage> vertex_faces: array<u32>;
// (F, 6): a triangle's own strain as xx, yy, zz, xy, yz, zx.
var<storage> tensors: array<f32>;
// (F, S): strain less that at rest, which positions follow where it is averaged.
var<storage> strain_from_rest: array<f32>;
// (F + 1 + N): where the triangles that share an edge with a triangle begin in this array, then those triangles.
var<storage> neighbors: array<u32>;
var<storage> smoothed: array<f32>; // (F, S): as averaged in the rounds so far
var<storage> averaged: array<f32>; // (F, S): once more

const LEAST_STRAIN: f32 = 3.0e-6; // twice what float32's rounding makes of none
const TENSOR: u32 = 6u; // words of a tensor
const TO_TENSOR: u32 = 3u; // columns of `basis`
const TO_PLANE: u32 = 21u;

fn basis_stride() -> u32 {
  return TO_PLANE + (TENSOR + 2u) * pose.strains;
}

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

// Write a triangle's origin and matrix: camera point = matrix · local + origin. And its strain, where it is wanted.
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
  let at = f * (FRAME_STRAIN + pose.strains);
  let center = vec4f(e.center, 1.0);
  for (var axis = 0u; axis < 3u; axis++) {
    frames[at + FRAME_ORIGIN + axis] = dot(pose.rows[axis], center);
    let row = scale * (pose.rows[axis].xyz * axes);
    for (var c = 0u; c < 3u; c++) {
      frames[at + FRAME_MATRIX + 3u * axis + c] = row[c];
    }
  }
  if pose.strains > 0u {
    write_tensor(f, e);
  }
}

// Green's strain of a triangle: the change of its edges' squared lengths and product, as a tensor.
fn write_tensor(f: u32, e: Edges) {
  let at = f * basis_stride();
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
  for (var k = 0u; k < pose.strains; k++) {
    let row = f * basis_stride() + TO_PLANE + TENSOR * k;
    var strain = 0.0;
    for (var d = 0u; d < TENSOR; d++) {
      strain += mean[d] * basis[row + d];
    }
    let range = f * basis_stride() + TO_PLANE + TENSOR * pose.strains + k;
    strain = clamp(STRAIN_GAIN * strain, basis[range], basis[range + pose.strains]);
    // Rounding of a rigid triangle is no strain: Adam would take its sign for a gradient and step at full rate.
    strain = select(strain, 0.0, abs(strain) < LEAST_STRAIN);
    frames[f * (FRAME_STRAIN + pose.strains) + FRAME_STRAIN + k] = strain;
    strain_from_rest[f * pose.strains + k] = strain - clamp(0.0, basis[range], basis[range + pose.strains]);
  }
}

// The mean of a triangle's strain and of those that share an edge with it: one round of averaging.
@compute @workgroup_size(WORKGROUP)
fn smooth_strain(thread: Thread) {
  let f = thread_number(thread);
  if f >= pose.triangles {
    return;
  }
  for (var k = 0u; k < pose.strains; k++) {
    var total = smoothed[f * pose.strains + k];
    let end = neighbors[f + 1u];
    for (var n = neighbors[f]; n < end; n++) {
      total += smoothed[neighbors[n] * pose.strains + k];
    }
    averaged[f * pose.strains + k] = total / f32(1u + end - neighbors[f]);
  }
}

// Move a triangle's origin by Σ signal · coefficients, in the triangle's axes and unit.
@compute @workgroup_size(WORKGROUP)
fn shift(thread: Thread) {
  let f = thread_number(thread);
  if f >= pose.triangles {
    return;
  }
  var moved = vec3f(0.0);
  for (var k = 0u; k < SIGNALS; k++) {
    let row = f * SIGNALS + k;
    moved += driving[row] * vec3f(coefficients[3u * row], coefficients[3u * row + 1u], coefficients[3u * row + 2u]);
  }
  let at = f * (FRAME_STRAIN + pose.strains);
  for (var axis = 0u; axis < 3u; axis++) {
    let row = at + FRAME_MATRIX + 3u * axis;
    frames[at + FRAME_ORIGIN + axis] += dot(vec3f(frames[row], frames[row + 1u], frames[row + 2u]), moved);
  }
}
