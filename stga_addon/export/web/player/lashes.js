// @ts-check
// Lashes: dark splats around the eyes that stand off the mesh, and throw shadows that the mesh does not. The rules are
// those of STGA for Blender's light/surface.py.

/**
 * @import { Surface } from './surface.js'
 * @import { Arrays, Data, Values, Vector } from './types.js'
 */

import { FaceFrames } from './face_frames.js';
import { wholeQuaternion } from './rotation.js';
import { placed, vertexNormals } from './surface.js';
import { difference, dotProduct } from './vector.js';

const REACH_M = 0.025; // from the middle of an eyeball
const MIN_HEIGHT_M = 0.002; // above the mesh
const MIN_OPACITY = 0.3;
const MAX_ALBEDO = 0.15;
const EXTENT = 2; // standard deviations from the middle of a splat to the corners of its card

/** Four-cornered cards: `count` of them, `faces` (6·M) triangles of their corners, which `place` finds for a pose. */
export class Lashes {
  /**
   * @param {Data} data of an avatar whose light is known
   * @param {Surface} surface
   */
  constructor({ header, arrays }, surface) {
    const { splats, faces } = lashSplats(arrays, header.convention, surface);
    this.count = splats.length;
    this.corners = Float32Array.from(splats.flatMap((splat) => card(arrays, splat)));
    const used = faces.flatMap((face) => Array.from(arrays.faces.values.subarray(3 * face, 3 * face + 3)));
    const triangles = { shape: [this.count, 3], values: Int32Array.from(used) };
    this.frames = new FaceFrames({ faces: triangles, neutral: arrays.neutral }, header.convention);
    this.faces = splats.flatMap((_, m) => [0, 1, 2, 0, 2, 3].map((corner) => 4 * m + corner));
  }

  /**
   * Corners (12·M) for posed vertices (3·V).
   * @param {Float64Array} vertices
   */
  place(vertices) {
    this.frames.placeFrames(vertices);
    const found = new Float32Array(12 * this.count);
    for (let corner = 0; corner < 4 * this.count; corner++) {
      found.set(placed(this.frames.world, corner >> 2, this.corners, corner), 3 * corner);
    }
    return found;
  }
}

/**
 * The lashes among the splats, and their triangles.
 * @param {Arrays} arrays
 * @param {Data['header']['convention']} convention
 * @param {Surface} surface
 */
function lashSplats(arrays, convention, surface) {
  const { xyz, opacity, neutral, splats_per_face } = arrays;
  const frames = new FaceFrames({ faces: arrays.faces, neutral }, convention);
  frames.placeFrames(Float64Array.from(neutral.values));
  const middles = eyeMiddles(arrays);
  const normals = surface.atSplats(vertexNormals(arrays.faces.values, neutral.values), 3);
  const beneath = surface.atSplats(neutral.values, 3);
  const [splats, faces] = [/** @type {number[]} */ ([]), /** @type {number[]} */ ([])];
  for (let face = 0, splat = 0; face < splats_per_face.values.length; face++) {
    for (const end = splat + splats_per_face.values[face]; splat < end; splat++) {
      if (surface.roughness[splat] !== 0 || opacity.values[splat] <= MIN_OPACITY) continue;
      const point = placed(frames.world, face, xyz.values, splat);
      if (!middles.some((middle) => Math.hypot(...difference(point, middle)) < REACH_M)) continue;
      const normal = normals.subarray(3 * splat, 3 * splat + 3);
      const above = difference(point, beneath.subarray(3 * splat, 3 * splat + 3));
      const height = dotProduct(above, normal) / Math.max(Math.hypot(...normal), 1e-9);
      if (height <= MIN_HEIGHT_M || surface.meanAlbedo(splat) >= MAX_ALBEDO) continue;
      splats.push(splat);
      faces.push(face);
    }
  }
  return { splats, faces };
}

/**
 * Middles of the eyeballs: parts of the mesh whose corners are all wet.
 * @param {Arrays} arrays
 */
function eyeMiddles({ faces, neutral, light_roughness }) {
  const wet = /** @type {Values} */ (light_roughness?.values);
  const part = Int32Array.from(wet, (_, vertex) => vertex);
  const first = (/** @type {number} */ vertex) => {
    while (part[vertex] !== vertex) vertex = part[vertex] = part[part[vertex]];
    return vertex;
  };
  for (let f = 0; f < faces.values.length; f += 3) {
    const corners = [0, 1, 2].map((k) => faces.values[f + k]);
    if (!corners.every((vertex) => wet[vertex] > 0)) continue;
    const roots = corners.map(first);
    for (const root of roots) part[root] = Math.min(...roots);
  }
  /** @type {Map<number, number[]>} */
  const sums = new Map();
  for (let vertex = 0; vertex < wet.length; vertex++) {
    if (!(wet[vertex] > 0)) continue;
    const sum = sums.get(first(vertex)) ?? [0, 0, 0, 0];
    for (let k = 0; k < 3; k++) sum[k] += neutral.values[3 * vertex + k];
    sum[3]++;
    sums.set(first(vertex), sum);
  }
  return Array.from(sums.values(), ([x, y, z, count]) => /** @type {Vector} */ ([x / count, y / count, z / count]));
}

/**
 * Ends (12) of the two longest axes of a splat, in turn, in the frame of its triangle.
 * @param {Arrays} arrays
 * @param {number} splat
 */
function card({ xyz, rotation, rotation_largest, log_scale }, splat) {
  const from = 3 * splat;
  const scales = Array.from(log_scale.values.subarray(from, from + 3), Math.exp);
  const [first, second] = [0, 1, 2].sort((a, b) => scales[b] - scales[a]);
  const quaternion = wholeQuaternion(rotation.values.subarray(from, from + 3), rotation_largest.values[splat]);
  const ends = (/** @type {number} */ axis, /** @type {number} */ sign) =>
    column(quaternion, axis).map((part, k) => xyz.values[from + k] + sign * EXTENT * scales[axis] * part);
  return [...ends(first, 1), ...ends(second, 1), ...ends(first, -1), ...ends(second, -1)];
}

/**
 * A column of the rotation matrix of a unit quaternion.
 * @param {number[]} quaternion
 * @param {number} axis
 */
function column([w, x, y, z], axis) {
  if (axis === 0) return [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)];
  if (axis === 1) return [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)];
  return [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)];
}
