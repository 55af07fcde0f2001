// @ts-check
// Local frames of the triangles, in which splats are stored, and how these follow the deformation
// of the neutral mesh. The rules are those of STGA for Blender's embedding.py, strain.py and
// offsets.py.

/** @import { Arrays, Header, Vector } from './types.js' */

import {
  AVERAGING_ROUNDS,
  MAX_DEFORMATION,
  MIN_AREA_RATIO,
  MIN_SQUARED_NORMAL,
  STRAIN_GAIN,
  UPRIGHT_COSINE,
} from './constants.js';
import { crossed, difference, dotProduct, scaled, unit } from './vector.js';

/** Strain of each triangle, less that at rest. */
class Strain {
  // By `FaceFrames.sides` of the neutral mesh and the range (12·F: lowest strain and change of the
  // normal of a triangle, then the highest) that they stay in.
  /** @param {Float64Array} sides @param {ArrayLike<number>} range @param {Arrays} arrays */
  constructor(sides, range, arrays) {
    const faces = arrays.faces.values;
    this.faces = faces;
    this.range = range;
    const count = faces.length / 3;
    this.values = new Float64Array(3 * count);
    this.rest = this.values.map((_, k) => clipped(0, range, k + 9 * Math.floor(k / 3)));
    this.gram = new Float64Array(3 * count); // u·u, u·v, v·v of the neutral sides
    this.toTensor = new Float32Array(18 * count); // change of gram → tensor xx, yy, zz, xy, yz, zx
    this.toPlane = new Float32Array(18 * count); // tensor → along the first side, across it, shear
    const vertices = arrays.neutral.shape[0];
    this.share = new Float64Array(vertices); // of a triangle in the means of vertex and triangle
    this.atVertex = new Float64Array(6 * vertices);
    for (const vertex of faces) this.share[vertex]++;
    this.share = this.share.map(faces => 1 / (3 * Math.max(1, faces)));
    for (let f = 0; f < count; f++) {
      const [u, v, normal] = [0, 3, 6].map(k => sides.subarray(9 * f + k, 9 * f + k + 3));
      this.gram.set([dotProduct(u, u), dotProduct(u, v), dotProduct(v, v)], 3 * f);
      const square = dotProduct(normal, normal);
      if (square < MIN_SQUARED_NORMAL) continue;
      const a1 = scaled(crossed(v, normal), 1 / square);
      const a2 = scaled(crossed(normal, u), 1 / square);
      const along = unit(u);
      const across = scaled(crossed(normal, along), 1 / Math.sqrt(square));
      symmetricProduct(a1, a1, 0.5, this.toTensor, 18 * f);
      symmetricProduct(a1, a2, 1, this.toTensor, 18 * f + 6);
      symmetricProduct(a2, a2, 0.5, this.toTensor, 18 * f + 12);
      symmetricProduct(along, along, 1, this.toPlane, 18 * f);
      symmetricProduct(across, across, 1, this.toPlane, 18 * f + 6);
      symmetricProduct(along, across, 1, this.toPlane, 18 * f + 12);
      // A tensor has each of the mixed components twice.
      for (let k = 0; k < 18; k++) if (k % 6 > 2) this.toPlane[18 * f + k] *= 2;
    }
  }

  // Follow the sides of the posed triangles: add every triangle's tensor to its three vertices,
  // each of which takes its mean.
  /** @param {Float64Array} sides */
  update(sides) {
    const { faces, gram, toTensor, atVertex, share } = this;
    atVertex.fill(0);
    for (let f = 0; f < faces.length; f += 3) {
      const [i, j, k] = [6 * faces[f], 6 * faces[f + 1], 6 * faces[f + 2]];
      let a = -gram[f];
      let b = -gram[f + 1];
      let c = -gram[f + 2];
      for (let u = 3 * f, v = u + 3; u < 3 * f + 3; u++, v++) {
        a += sides[u] * sides[u];
        b += sides[u] * sides[v];
        c += sides[v] * sides[v];
      }
      for (let n = 0, t = 6 * f; n < 6; n++, t++) {
        const part = a * toTensor[t] + b * toTensor[t + 6] + c * toTensor[t + 12];
        atVertex[i + n] += part;
        atVertex[j + n] += part;
        atVertex[k + n] += part;
      }
    }
    for (let v = 0, at = 0; v < share.length; v++) {
      for (const end = at + 6; at < end; at++) atVertex[at] *= share[v];
    }
    const { rest, toPlane, range, values } = this;
    for (let f = 0; f < faces.length; f += 3) {
      const [i, j, k] = [6 * faces[f], 6 * faces[f + 1], 6 * faces[f + 2]];
      let along = 0;
      let across = 0;
      let shear = 0;
      for (let n = 0, t = 6 * f; n < 6; n++, t++) {
        const part = atVertex[i + n] + atVertex[j + n] + atVertex[k + n];
        along += toPlane[t] * part;
        across += toPlane[t + 6] * part;
        shear += toPlane[t + 12] * part;
      }
      values[f] = clipped(STRAIN_GAIN * along, range, 4 * f) - rest[f];
      values[f + 1] = clipped(STRAIN_GAIN * across, range, 4 * f + 1) - rest[f + 1];
      values[f + 2] = clipped(STRAIN_GAIN * shear, range, 4 * f + 2) - rest[f + 2];
    }
  }
}

/** Strain around each triangle: 0 for a mesh at rest. */
class SmoothedStrain {
  /** @param {Float64Array} sides @param {ArrayLike<number>} range @param {Arrays} arrays */
  constructor(sides, range, arrays) {
    this.strain = new Strain(sides, range, arrays);
    const { faces, share } = this.strain;
    this.values = new Float64Array(faces.length);
    this.before = new Float64Array(faces.length); // of the last round
    /** @type {Map<number, number[]>} */
    const touching = new Map(); // the triangles at an edge, by its ends
    const edges = Array.from(faces, (vertex, c) => {
      const next = faces[c % 3 < 2 ? c + 1 : c - 2];
      const ends = Math.min(vertex, next) * share.length + Math.max(vertex, next);
      const triangles = touching.get(ends) ?? [];
      triangles.push(Math.floor(c / 3));
      touching.set(ends, triangles);
      return triangles;
    });
    /** @type {number[]} */
    const neighbors = [];
    const ends = new Int32Array(faces.length / 3); // of each triangle's in the list of neighbors
    for (let c = 0; c < edges.length; c++) {
      const own = Math.floor(c / 3);
      for (const other of edges[c]) if (other !== own) neighbors.push(3 * other);
      ends[own] = neighbors.length;
    }
    this.neighbors = Int32Array.from(neighbors);
    this.ends = ends;
  }

  // Follow the posed triangles: AVERAGING_ROUNDS times the mean with those that share an edge.
  /** @param {Float64Array} sides */
  update(sides) {
    const { before, ends, neighbors, strain, values } = this;
    strain.update(sides);
    values.set(strain.values);
    for (let round = 0; round < AVERAGING_ROUNDS; round++) {
      before.set(values);
      for (let f = 0, n = 0; f < ends.length; f++) {
        const at = 3 * f;
        const share = 1 / (1 + ends[f] - n);
        for (; n < ends[f]; n++) {
          values[at] += before[neighbors[n]];
          values[at + 1] += before[neighbors[n] + 1];
          values[at + 2] += before[neighbors[n] + 2];
        }
        for (let k = at; k < at + 3; k++) values[k] *= share;
      }
    }
  }
}

/** Change of each triangle's unit normal since the neutral mesh. */
class NormalChange {
  /** @param {Float64Array} sides @param {ArrayLike<number>} range */
  constructor(sides, range) {
    this.range = range;
    this.values = new Float64Array(sides.length / 3);
    this.neutral = this.values.map((_, k) => {
      const normal = 9 * Math.floor(k / 3) + 6;
      return sides[normal + (k % 3)] * inverseLength(sides, normal);
    });
  }

  /** @param {Float64Array} sides of the posed triangles */
  update(sides) {
    const { neutral, range, values } = this;
    for (let f = 0; f < values.length; f += 3) {
      const hasNormal = neutral[f] || neutral[f + 1] || neutral[f + 2];
      const factor = inverseLength(sides, 3 * f + 6);
      for (let k = 0; k < 3; k++) {
        const change = hasNormal ? sides[3 * f + 6 + k] * factor - neutral[f + k] : 0;
        values[f + k] = clipped(change, range, 4 * f + 3 + k);
      }
    }
  }
}

// One over the length of the normal that begins at `at`; 0 of a triangle without area.
/** @type {(sides: Float64Array, at: number) => number} */
function inverseLength(sides, at) {
  const square = sides[at] ** 2 + sides[at + 1] ** 2 + sides[at + 2] ** 2;
  return square < MIN_SQUARED_NORMAL ? 0 : 1 / Math.sqrt(square);
}

// Within its range, whose lowest value is at `at`.
/** @type {(value: number, range: ArrayLike<number>, at: number) => number} */
const clipped = (value, range, at) => Math.min(range[at + 6], Math.max(range[at], value));

// Symmetric part of the outer product of two vectors, times a factor: xx, yy, zz, xy, yz, zx.
/** @type {(a: Vector, b: Vector, factor: number, out: Float32Array, at: number) => void} */
function symmetricProduct(a, b, factor, out, at) {
  for (let k = 0; k < 3; k++) {
    const next = (k + 1) % 3;
    out[at + k] = factor * a[k] * b[k];
    out[at + 3 + k] = (factor * (a[k] * b[next] + a[next] * b[k])) / 2;
  }
}

// Three numbers a triangle, by name, which its splats may follow.
export const SIGNALS = { smoothed_strain: SmoothedStrain, normal: NormalChange };

// What an offset's coefficients (faces, 9) change: for each component of its signal a vector in the
// frame, the logarithm of its scale (and two zeros), or a color; 'light': one that is the light of
// the capture.
export const TARGETS = ['position', 'scale', 'color', 'light'];

// Of a triangle in the texture: three rows of matrix | origin, then color | selected, and what of
// the color is the light of the capture.
export const FACE_FLOATS = 20;

export class FaceFrames {
  // Arrays of the data file, the convention of the embedding, and the driven offsets.
  /** @param {Arrays} arrays @param {string} convention @param {Header['offsets']} offsets */
  constructor(arrays, convention, offsets = {}) {
    this.faces = arrays.faces.values;
    this.count = this.faces.length / 3;
    this.isStga = convention === 'stga';
    // Rotation · scale and origin, rows of a 3×4 matrix.
    this.world = new Float64Array(12 * this.count);
    // Of the triangles as last placed: sides u and v from corner 0 and their product, twice the
    // area long (9·F); area, 0 of those that count as lines.
    this.sides = new Float64Array(9 * this.count);
    this.area = new Float64Array(this.count);
    this.neutralArea = this.area; // while it is the neutral mesh that is placed
    this.placeFrames(Float64Array.from(arrays.neutral.values));
    this.neutralArea = this.area.slice();
    const range =
      arrays.strain_range?.values ??
      new Float32Array(12 * this.count).fill(MAX_DEFORMATION).map((v, k) => (k % 12 < 6 ? -v : v));
    /** @type {Partial<Record<keyof SIGNALS, SmoothedStrain | NormalChange>>} */
    this.signals = {};
    this.offsets = Object.entries(offsets).map(([name, [signal, target]]) => {
      const followed = (this.signals[signal] ??= new SIGNALS[signal](this.sides, range, arrays));
      return { target, signal: followed, coefficients: arrays[name].values };
    });
    const zeros = () => new Float64Array(3 * this.count);
    // Of a triangle's splats; positions in its own axes and unit.
    this.change = { position: zeros(), scale: zeros(), color: zeros(), light: zeros() };
  }

  // Follow the posed vertices (3·V).
  /** @param {Float64Array} vertices */
  update(vertices) {
    const { change, offsets, sides, signals, world } = this;
    this.placeFrames(vertices);
    for (const signal of Object.values(signals)) signal.update(sides);
    for (const sum of Object.values(change)) sum.fill(0);
    for (const { coefficients, signal, target } of offsets) {
      const [sum, { values }, c] = [change[target], signal, coefficients];
      for (let f = 0, k = 0; f < sum.length; f += 3, k += 9) {
        const [x, y, z] = [values[f], values[f + 1], values[f + 2]];
        sum[f] += x * c[k] + y * c[k + 3] + z * c[k + 6];
        sum[f + 1] += x * c[k + 1] + y * c[k + 4] + z * c[k + 7];
        sum[f + 2] += x * c[k + 2] + y * c[k + 5] + z * c[k + 8];
      }
    }
    for (let f = 0, to = 0; f < change.position.length; f += 3) {
      const [x, y, z] = [change.position[f], change.position[f + 1], change.position[f + 2]];
      const enlargement = Math.exp(change.scale[f]);
      for (const end = to + 12; to < end; to += 4) {
        world[to + 3] += world[to] * x + world[to + 1] * y + world[to + 2] * z;
        world[to] *= enlargement;
        world[to + 1] *= enlargement;
        world[to + 2] *= enlargement;
      }
    }
  }

  // "stga": axes [first, normal × first, normal], first from the middle to corner 0; scale
  // sqrt(area / neutral area). "gaussian_avatars": axes [first, normal, first × normal], first
  // along the first edge; scale the mean of edge and height.
  /** @param {Float64Array} vertices */
  placeFrames(vertices) {
    const { area, faces, isStga, neutralArea, sides, world } = this;
    const [first, normal] = [new Float64Array(3), new Float64Array(3)];
    for (let f = 0, at = 0; f < this.count; f++, at += 9) {
      const corner = 3 * faces[3 * f];
      const second = 3 * faces[3 * f + 1];
      const third = 3 * faces[3 * f + 2];
      for (let k = 0; k < 3; k++) {
        sides[at + k] = vertices[second + k] - vertices[corner + k];
        sides[at + 3 + k] = vertices[third + k] - vertices[corner + k];
      }
      let [uu, vv, ww, twice, length] = [0, 0, 0, 0, 0];
      for (let k = 0; k < 3; k++) {
        const [a, b] = [at + ((k + 1) % 3), at + ((k + 2) % 3)];
        const u = sides[at + k];
        const v = sides[at + 3 + k];
        first[k] = isStga ? -(u + v) / 3 : u;
        normal[k] = sides[at + 6 + k] = sides[a] * sides[b + 3] - sides[b] * sides[a + 3];
        uu += u * u;
        vv += v * v;
        ww += (v - u) * (v - u);
        twice += normal[k] * normal[k];
        length += first[k] * first[k];
      }
      twice = Math.sqrt(twice);
      length = Math.sqrt(length);
      const longest = Math.max(uu, vv, ww);
      const isShort = length <= MIN_AREA_RATIO * Math.sqrt(longest);
      const isLine = twice <= 2 * MIN_AREA_RATIO * longest;
      area[f] = isLine ? 0 : twice / 2;
      let scale = 1;
      if (!isStga) scale = (length + (isShort ? Math.sqrt(vv) : twice / length)) / 2;
      else if (neutralArea[f] > 0) scale = Math.sqrt(twice / 2 / neutralArea[f]);
      if (isShort || isLine) substitute(first, normal, isShort, isLine);
      for (let k = 0; k < 3; k++) {
        first[k] *= isShort || isLine ? scale : scale / length;
        normal[k] *= isShort || isLine ? 1 : 1 / twice;
      }
      for (let k = 0, to = 12 * f; k < 3; k++, to += 4) {
        const a = k < 2 ? k + 1 : 0;
        const b = k > 0 ? k - 1 : 2;
        const side = normal[a] * first[b] - normal[b] * first[a];
        world[to] = first[k];
        world[to + 1] = isStga ? side : scale * normal[k];
        world[to + 2] = isStga ? scale * normal[k] : -side;
        world[to + 3] = vertices[corner + k] + (sides[at + k] + sides[at + 3 + k]) / 3;
      }
    }
  }

  // Write the frames as a camera (row-major 4×4 world to camera) sees them: FACE_FLOATS a triangle.
  /** @type {(camera: ArrayLike<number>, out: Float32Array) => void} */
  compose(camera, out) {
    const { world, count } = this;
    for (let row = 0; row < 3; row++) {
      const a = camera[4 * row];
      const b = camera[4 * row + 1];
      const c = camera[4 * row + 2];
      const d = camera[4 * row + 3];
      for (let f = 0, from = 0, to = 4 * row; f < count; f++, from += 12, to += FACE_FLOATS) {
        out[to] = a * world[from] + b * world[from + 4] + c * world[from + 8];
        out[to + 1] = a * world[from + 1] + b * world[from + 5] + c * world[from + 9];
        out[to + 2] = a * world[from + 2] + b * world[from + 6] + c * world[from + 10];
        out[to + 3] = a * world[from + 3] + b * world[from + 7] + c * world[from + 11] + d;
      }
    }
  }

  // Write the changes of color, and the triangles' selection flags (bits, or null: all selected).
  /** @type {(selection: ArrayLike<number> | null, out: Float32Array) => void} */
  annotate(selection, out) {
    const { color, light } = this.change;
    for (let f = 0; f < this.count; f++) {
      const to = FACE_FLOATS * f + 12;
      for (let k = 0; k < 3; k++) {
        out[to + k] = color[3 * f + k] + light[3 * f + k];
        out[to + 4 + k] = light[3 * f + k];
      }
      out[to + 3] = selection ? (selection[f >> 3] >> (7 - (f & 7))) & 1 : 1;
    }
  }
}

// Make first and normal of a triangle that is a line, or whose `first` has no length, perpendicular
// unit vectors.
/** @type {(first: Float64Array, normal: Float64Array, short: boolean, line: boolean) => void} */
function substitute(first, normal, isShort, isLine) {
  const x = isShort ? [1, 0, 0] : unit(first);
  const isUpright = Math.abs(x[2]) > UPRIGHT_COSINE;
  const n = isLine ? crossed(x, isUpright ? [1, 0, 0] : [0, 0, 1]) : normal;
  normal.set(unit(difference(n, scaled(x, dotProduct(n, x)))));
  first.set(x);
}
