// @ts-check
// What light meets: the point of the mesh that each splat belongs to, and its color without light. The rules are those of
// STGA for Blender's light/surface.py and light/relight.py.

/** @import { Arrays, Data, Values, Vector } from './types.js' */

import { FaceFrames } from './face_frames.js';
import { HARMONICS } from './harmonics.js';
import { crossed, difference, dotProduct } from './vector.js';

export const HIGHLIGHT_SHARE = 0.034;
export const WET_HIGHLIGHT_SHARE = 0.14;
export const MIN_DIFFUSE_SHARE = 0.1;
const MIN_IRRADIANCE = 0.15; // of the capture, as a share of its mean
const VIEW_DIRECTIONS = 96;
const MIN_VIEW_COSINE = 0.3;
const MAX_STEPS = 6; // triangles that a splat walks over
const LEAST_ALBEDO = 1e-4;
const CONSTANT = 0.28209479177387814; // harmonic of degree 0

/**
 * By splat: `corners` (3·N) and `weights` (3·N) of its triangle's vertices; `color` (3·N), recorded sRGB as a mean over
 * the directions from which it is seen; `irradiance` (3·N) of the capture, `occlusion` (N), `roughness` (N; 0: skin).
 * `typical`: mean albedo to which a damped light draws.
 */
export class Surface {
  /** @param {Data} data of an avatar whose light is known */
  constructor({ header, arrays }) {
    const count = arrays.xyz.shape[0];
    this.count = count;
    this.damping = header.light?.damping ?? 0;
    const frames = new FaceFrames(arrays, header.convention);
    frames.placeFrames(Float64Array.from(arrays.neutral.values));
    this.areas = frames.neutralArea;
    this.corners = new Int32Array(3 * count);
    this.weights = new Float32Array(3 * count);
    this.placeSplats(arrays, frames);
    const light = (/** @type {string} */ name) => /** @type {Values} */ (arrays[`light_${name}`]?.values);
    this.occlusion = this.atSplats(light('occlusion'), 1);
    this.roughness = this.atSplats(light('roughness'), 1);
    this.irradiance = this.clampedIrradiance(light('irradiance'));
    const normals = vertexNormals(arrays.faces.values, arrays.neutral.values);
    this.color = recordedColor(arrays, this.atSplats(normals, 3));
    this.typical = this.damping ? this.typicalAlbedo() : [1, 1, 1];
  }

  /**
   * The point of the mesh that each splat belongs to: from its own triangle on, it walks over the edge beyond which it
   * lies; of the triangles that it comes by, the one with the nearest point counts.
   * @param {Arrays} arrays
   * @param {FaceFrames} frames
   */
  placeSplats({ xyz, neutral, faces, splats_per_face }, frames) {
    const beyond = beyondEdges(faces.values);
    const corner = (/** @type {number} */ face, /** @type {number} */ k) => {
      const from = 3 * faces.values[3 * face + k];
      return neutral.values.subarray(from, from + 3);
    };
    for (let own = 0, splat = 0; own < splats_per_face.values.length; own++) {
      for (const end = splat + splats_per_face.values[own]; splat < end; splat++) {
        const point = placed(frames.world, own, xyz.values, splat);
        let [least, face] = [Infinity, own];
        for (let step = 0; step <= MAX_STEPS && face >= 0; step++) {
          const { inside, weights, distance } = nearest(corner(face, 0), corner(face, 1), corner(face, 2), point);
          if (distance < least) {
            least = distance;
            this.weights.set(weights, 3 * splat);
            for (let k = 0; k < 3; k++) this.corners[3 * splat + k] = faces.values[3 * face + k];
          }
          const outermost = Math.min(...inside);
          face = outermost < 0 ? beyond[3 * face + inside.indexOf(outermost)] : -1;
        }
      }
    }
  }

  /**
   * Values of vertices (C·V) at the splats: (C·N).
   * @param {ArrayLike<number>} values
   * @param {number} channels
   */
  atSplats(values, channels) {
    const found = new Float32Array(channels * this.count);
    for (let n = 0; n < this.corners.length; n++) {
      const to = channels * Math.floor(n / 3);
      const from = channels * this.corners[n];
      for (let c = 0; c < channels; c++) found[to + c] += this.weights[n] * values[from + c];
    }
    return found;
  }

  /** @param {ArrayLike<number>} values */
  clampedIrradiance(values) {
    const mean = [0, 0, 0];
    for (let k = 0; k < values.length; k++) mean[k % 3] += (3 * values[k]) / values.length;
    return this.atSplats(values, 3).map((value, k) => Math.max(value, MIN_IRRADIANCE * mean[k % 3]));
  }

  /** Geometric mean over the splats, before damping. */
  typicalAlbedo() {
    const sum = [0, 0, 0];
    for (let k = 0; k < this.color.length; k++) sum[k % 3] += Math.log(Math.max(this.recordedAlbedo(k), LEAST_ALBEDO));
    return sum.map((total) => Math.exp(total / this.count));
  }

  /**
   * Albedo before damping: the k-th of 3·N.
   * @param {number} k
   */
  recordedAlbedo(k) {
    const share = this.roughness[Math.floor(k / 3)] > 0 ? WET_HIGHLIGHT_SHARE : HIGHLIGHT_SHARE;
    const linear = linearOfSrgb(Math.max(this.color[k], 0));
    const highlight = (share / Math.PI) * this.irradiance[k];
    return (Math.PI * Math.max(linear - highlight, MIN_DIFFUSE_SHARE * linear)) / this.irradiance[k];
  }

  /**
   * Albedo of a splat, mean of its channels.
   * @param {number} splat
   */
  meanAlbedo(splat) {
    let sum = 0;
    for (let c = 0; c < 3; c++) {
      const albedo = this.recordedAlbedo(3 * splat + c);
      const damped = Math.max(albedo, LEAST_ALBEDO) ** (1 - this.damping) * this.typical[c] ** this.damping;
      sum += (this.damping ? damped : albedo) / 3;
    }
    return sum;
  }
}

/**
 * The point of a splat (xyz in its triangle's frame) in the neutral mesh.
 * @param {Float64Array} world rows of the frames
 * @param {number} face
 * @param {Values} xyz
 * @param {number} splat
 * @returns {Vector}
 */
export function placed(world, face, xyz, splat) {
  const [x, y, z] = xyz.subarray(3 * splat, 3 * splat + 3);
  const part = (/** @type {number} */ k) => world[k] * x + world[k + 1] * y + world[k + 2] * z + world[k + 3];
  return [part(12 * face), part(12 * face + 4), part(12 * face + 8)];
}

/**
 * Of the edge opposite to each corner (3·F), the triangle beyond it; -1: none.
 * @param {Values} faces
 */
function beyondEdges(faces) {
  const found = new Int32Array(faces.length).fill(-1);
  /** @type {Map<number, number>} */
  const open = new Map();
  for (let c = 0; c < faces.length; c++) {
    const first = c - (c % 3);
    const [a, b] = [faces[first + ((c + 1) % 3)], faces[first + ((c + 2) % 3)]];
    const key = Math.min(a, b) * faces.length + Math.max(a, b);
    const other = open.get(key);
    if (other !== undefined) {
      found[c] = Math.floor(other / 3);
      if (found[other] < 0) found[other] = Math.floor(c / 3);
    }
    open.set(key, c);
  }
  return found;
}

/**
 * Barycentric coordinates of a point in a triangle's plane, the same clamped to the triangle, and the square of the
 * distance from there.
 * @param {ArrayLike<number>} a
 * @param {ArrayLike<number>} b
 * @param {ArrayLike<number>} c
 * @param {Vector} point
 */
function nearest(a, b, c, point) {
  const [first, second, offset] = [difference(b, a), difference(c, a), difference(point, a)];
  const uu = dotProduct(first, first);
  const uv = dotProduct(first, second);
  const vv = dotProduct(second, second);
  const area = Math.max(uu * vv - uv * uv, 1e-30);
  const [pu, pv] = [dotProduct(offset, first), dotProduct(offset, second)];
  const u = (vv * pu - uv * pv) / area;
  const v = (uu * pv - uv * pu) / area;
  const inside = [1 - u - v, u, v];
  const clamped = inside.map((weight) => Math.max(0, Math.min(1, weight)));
  const sum = clamped[0] + clamped[1] + clamped[2];
  const weights = clamped.map((weight) => weight / sum);
  let distance = 0;
  for (let k = 0; k < 3; k++) distance += (offset[k] - weights[1] * first[k] - weights[2] * second[k]) ** 2;
  return { inside, weights, distance };
}

/**
 * Unit normals (3·V) weighted by the area of triangles; 0 where a vertex has none.
 * @param {Values} faces
 * @param {ArrayLike<number>} vertices
 */
export function vertexNormals(faces, vertices) {
  const normals = new Float64Array(vertices.length);
  for (let f = 0; f < faces.length; f += 3) {
    const i = 3 * faces[f];
    const j = 3 * faces[f + 1];
    const k = 3 * faces[f + 2];
    const ux = vertices[j] - vertices[i];
    const uy = vertices[j + 1] - vertices[i + 1];
    const uz = vertices[j + 2] - vertices[i + 2];
    const vx = vertices[k] - vertices[i];
    const vy = vertices[k + 1] - vertices[i + 1];
    const vz = vertices[k + 2] - vertices[i + 2];
    const [x, y, z] = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
    for (const at of [i, j, k]) {
      normals[at] += x;
      normals[at + 1] += y;
      normals[at + 2] += z;
    }
  }
  for (let at = 0; at < normals.length; at += 3) {
    const length = Math.max(Math.hypot(normals[at], normals[at + 1], normals[at + 2]), 1e-20);
    for (let k = at; k < at + 3; k++) normals[k] /= length;
  }
  return normals;
}

/**
 * Recorded sRGB (3·N) of the splats without what depends on the view: a mean over directions in which normals (3·N) face.
 * @param {Arrays} arrays
 * @param {Float32Array} normals
 */
function recordedColor({ color, sh }, normals) {
  const found = Float32Array.from(color.values, (value) => 0.5 + CONSTANT * value);
  if (!sh) return found;
  const terms = sh.shape[1] / 3;
  const directions = evenDirections(VIEW_DIRECTIONS).map((d) => ({ d, values: viewBasis(d).slice(0, terms) }));
  const mean = new Float64Array(terms);
  for (let at = 0; at < found.length; at += 3) {
    mean.fill(0);
    let seen = 0;
    for (const { d, values } of directions) {
      if (normals[at] * d[0] + normals[at + 1] * d[1] + normals[at + 2] * d[2] <= MIN_VIEW_COSINE) continue;
      seen++;
      for (let k = 0; k < terms; k++) mean[k] += values[k];
    }
    if (!seen) continue;
    for (let k = 0; k < terms; k++) {
      for (let c = 0; c < 3; c++) found[at + c] += (mean[k] / seen) * sh.values[terms * at + 3 * k + c];
    }
  }
  return found;
}

/**
 * Harmonics of degree 1 to 3 of a color that is seen against a direction, in the order of splats' coefficients.
 * @param {Vector} d
 */
function viewBasis(d) {
  const [x, y, z] = [-d[0], -d[1], -d[2]];
  const [xx, yy, zz] = [x * x, y * y, z * z];
  return [
    -0.4886025119029199 * y,
    0.4886025119029199 * z,
    -0.4886025119029199 * x,
    1.0925484305920792 * x * y,
    -1.0925484305920792 * y * z,
    0.31539156525252005 * (2 * zz - xx - yy),
    -1.0925484305920792 * x * z,
    0.5462742152960396 * (xx - yy),
    -0.5900435899266435 * y * (3 * xx - yy),
    2.890611442640554 * x * y * z,
    -0.4570457994644658 * y * (4 * zz - xx - yy),
    0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
    -0.4570457994644658 * x * (4 * zz - xx - yy),
    1.445305721320277 * z * (xx - yy),
    -0.5900435899266435 * x * (xx - 3 * yy),
  ];
}

/**
 * Unit vectors spread evenly over the sphere (a Fibonacci lattice).
 * @param {number} count
 * @returns {Vector[]}
 */
function evenDirections(count) {
  return Array.from({ length: count }, (_, k) => {
    const height = 1 - (2 * (k + 0.5)) / count;
    const turn = (k + 0.5) * Math.PI * (1 + Math.sqrt(5));
    const ring = Math.sqrt(1 - height * height);
    return [ring * Math.cos(turn), height, ring * Math.sin(turn)];
  });
}

/** @param {number} value */
export function linearOfSrgb(value) {
  return value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
}

/**
 * The rotation (3×3, row by row) that best takes vertices to others (both 3·V), by weights (V): the orthogonal factor of
 * their weighted covariance (Higham's iteration).
 * @param {ArrayLike<number>} from
 * @param {ArrayLike<number>} to
 * @param {ArrayLike<number>} weights
 */
export function rigidRotation(from, to, weights) {
  let m = covariance(from, to, weights);
  for (let k = 0; k < 30; k++) {
    const [r0, r1, r2] = [m.slice(0, 3), m.slice(3, 6), m.slice(6, 9)];
    const cofactors = [crossed(r1, r2), crossed(r2, r0), crossed(r0, r1)].flat();
    const determinant = dotProduct(r0, cofactors);
    if (!(Math.abs(determinant) > 1e-300)) return [1, 0, 0, 0, 1, 0, 0, 0, 1]; // a mesh without an extent
    const next = m.map((value, at) => (value + cofactors[at] / determinant) / 2);
    const change = next.reduce((most, value, at) => Math.max(most, Math.abs(value - m[at])), 0);
    m = next;
    if (change < 1e-12) break;
  }
  return m;
}

/**
 * Σ weight · to · fromᵀ about the weighted means, over its norm.
 * @param {ArrayLike<number>} from
 * @param {ArrayLike<number>} to
 * @param {ArrayLike<number>} weights
 */
function covariance(from, to, weights) {
  const sums = { from: [0, 0, 0], to: [0, 0, 0], weight: 0 };
  const m = Array(9).fill(0);
  for (let v = 0; v < weights.length; v++) {
    sums.weight += weights[v];
    for (let i = 0; i < 3; i++) {
      sums.from[i] += weights[v] * from[3 * v + i];
      sums.to[i] += weights[v] * to[3 * v + i];
      for (let j = 0; j < 3; j++) m[3 * i + j] += weights[v] * to[3 * v + i] * from[3 * v + j];
    }
  }
  for (let k = 0; k < 9; k++) m[k] -= (sums.to[Math.floor(k / 3)] * sums.from[k % 3]) / sums.weight;
  const norm = Math.hypot(...m) || 1;
  return m.map((value) => value / norm);
}

/**
 * Irradiance (3·V) of light (harmonics in the head's axes) past the head itself.
 * @param {Values} transfer (9·V)
 * @param {Float64Array} light
 */
export function received(transfer, light) {
  const found = new Float64Array(transfer.length / 3);
  for (let v = 0; 9 * v < transfer.length; v++) {
    for (let c = 0; c < 3; c++) {
      let sum = 0;
      for (let k = 0; k < HARMONICS; k++) sum += transfer[9 * v + k] * light[3 * k + c];
      found[3 * v + c] = Math.max(sum, 0);
    }
  }
  return found;
}
