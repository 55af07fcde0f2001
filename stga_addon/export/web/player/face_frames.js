// @ts-check
// Local frames of the triangles, in which splats are stored, and what these follow: strain against the neutral mesh.
// The rules are those of STGA for Blender's embedding.py and strain.py.

/** @import { Arrays, Values, Vector } from './types.js' */

import { crossed, difference, dotProduct, scaled, unit } from './vector.js';

const STRAIN_GAIN = 5;
const MAX_STRAIN = 2;
const AVERAGING_ROUNDS = 3; // of smoothed strain
const MIN_SQUARED_NORMAL = 1e-24;

export class Strain {
  // faces (3·F), neutral (3·V) meters, range (6·F: lowest three, highest three) of strain;
  // ±MAX_STRAIN without one.
  /**
   * @param {Values} faces
   * @param {Values} neutral
   * @param {Values} [range]
   */
  constructor(faces, neutral, range) {
    this.faces = faces;
    const count = faces.length / 3;
    this.range =
      range ?? new Float32Array(6 * count).map((_, k) => (k % 6 < 3 ? -MAX_STRAIN : MAX_STRAIN));
    this.values = new Float32Array(3 * count);
    this.gram = new Float64Array(3 * count); // u·u, u·v, v·v of the neutral edges from corner 0
    this.toTensor = new Float32Array(18 * count); // change of gram → tensor xx, yy, zz, xy, yz, zx
    this.toPlane = new Float32Array(18 * count); // tensor → along the first edge, across it, shear
    this.share = new Float64Array(neutral.length / 3); // of a triangle in the mean of its vertex, and that in its own
    this.atVertex = new Float64Array(2 * neutral.length);
    for (const vertex of faces) this.share[vertex]++;
    for (let v = 0; v < this.share.length; v++)
      this.share[v] = 1 / (3 * Math.max(1, this.share[v]));
    for (let f = 0; f < count; f++) this.prepare(f, neutral);
  }

  /** @type {(f: number, neutral: Values) => void} */
  prepare(f, neutral) {
    const corner = (/** @type {number} */ k) =>
      neutral.subarray(3 * this.faces[3 * f + k], 3 * this.faces[3 * f + k] + 3);
    const u = difference(corner(1), corner(0));
    const v = difference(corner(2), corner(0));
    this.gram.set([dotProduct(u, u), dotProduct(u, v), dotProduct(v, v)], 3 * f);
    const normal = crossed(u, v);
    const square = dotProduct(normal, normal);
    if (square < MIN_SQUARED_NORMAL) return;
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

  // Follow the posed vertices (3·V).
  /** @param {Float64Array} vertices */
  update(vertices) {
    this.spread(vertices);
    this.gather();
  }

  // Add every triangle's tensor to its three vertices, each of which takes its mean.
  /** @param {Float64Array} vertices */
  spread(vertices) {
    const { faces, gram, toTensor, atVertex, share } = this;
    atVertex.fill(0);
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
      const a = ux * ux + uy * uy + uz * uz - gram[f];
      const b = ux * vx + uy * vy + uz * vz - gram[f + 1];
      const c = vx * vx + vy * vy + vz * vz - gram[f + 2];
      for (let n = 0, t = 6 * f; n < 6; n++, t++) {
        const part = a * toTensor[t] + b * toTensor[t + 6] + c * toTensor[t + 12];
        atVertex[2 * i + n] += part;
        atVertex[2 * j + n] += part;
        atVertex[2 * k + n] += part;
      }
    }
    for (let v = 0, at = 0; v < share.length; v++) {
      for (const end = at + 6; at < end; at++) atVertex[at] *= share[v];
    }
  }

  /** Strain of every triangle from the tensors of its vertices. */
  gather() {
    const { faces, toPlane, atVertex, range, values } = this;
    for (let f = 0; f < faces.length; f += 3) {
      const i = 6 * faces[f];
      const j = 6 * faces[f + 1];
      const k = 6 * faces[f + 2];
      let along = 0;
      let across = 0;
      let shear = 0;
      for (let n = 0, t = 6 * f; n < 6; n++, t++) {
        const part = atVertex[i + n] + atVertex[j + n] + atVertex[k + n];
        along += toPlane[t] * part;
        across += toPlane[t + 6] * part;
        shear += toPlane[t + 12] * part;
      }
      const at = 2 * f;
      values[f] = Math.min(range[at + 3], Math.max(range[at], STRAIN_GAIN * along));
      values[f + 1] = Math.min(range[at + 4], Math.max(range[at + 1], STRAIN_GAIN * across));
      values[f + 2] = Math.min(range[at + 5], Math.max(range[at + 2], STRAIN_GAIN * shear));
    }
  }
}

/** Strain around each triangle, which positions follow: 0 for a mesh at rest. */
export class SmoothedStrain {
  static components = 3;

  // Of `strain` (Strain), which is to be updated first.
  /** @param {Strain} strain */
  constructor(strain) {
    const { faces, range } = strain;
    const count = faces.length / 3;
    this.strain = strain;
    this.values = new Float64Array(3 * count);
    this.rest = new Float64Array(3 * count);
    for (let k = 0; k < 3 * count; k++) {
      const lowest = k + 3 * Math.floor(k / 3);
      this.rest[k] = Math.min(range[lowest + 3], Math.max(range[lowest], 0));
    }
    const [edges, edgeCount] = edgesOf(faces);
    this.edges = edges; // (3·F), each three times its index
    this.edgeSum = new Float64Array(3 * edgeCount); // over all triangles at an edge
    this.ownFactor = new Float64Array(count);
    this.share = new Float64Array(count); // one over how many neighbors a triangle has and itself
    this.weigh(edgeCount);
  }

  // The sums of a triangle's three edges hold its neighbors, and itself three times: `ownFactor`
  // leaves it once.
  /** @param {number} edgeCount */
  weigh(edgeCount) {
    const { edges, ownFactor, share } = this;
    const touching = new Int32Array(edgeCount);
    for (const edge of edges) touching[edge / 3]++;
    for (let f = 0; f < share.length; f++) {
      const own = edges.subarray(3 * f, 3 * f + 3);
      let held = 0;
      let itself = 0; // 3, or more where a degenerate triangle has one edge twice
      for (const edge of own) {
        held += touching[edge / 3];
        for (const other of own) if (edge === other) itself++;
      }
      ownFactor[f] = 1 - itself;
      share[f] = 1 / (1 + held - itself);
    }
  }

  /** Follow the strain. */
  update() {
    const { rest, strain, values } = this;
    for (let k = 0; k < values.length; k++) values[k] = strain.values[k] - rest[k];
    for (let round = 0; round < AVERAGING_ROUNDS; round++) this.average();
  }

  /** Replace every value by the mean of the triangle and those that share an edge with it. */
  average() {
    const { edges, edgeSum, ownFactor, share, values } = this;
    edgeSum.fill(0);
    for (let at = 0; at < edges.length; at += 3) {
      for (let c = at; c < at + 3; c++) {
        const e = edges[c];
        edgeSum[e] += values[at];
        edgeSum[e + 1] += values[at + 1];
        edgeSum[e + 2] += values[at + 2];
      }
    }
    for (let f = 0, at = 0; f < share.length; f++, at += 3) {
      const i = edges[at];
      const j = edges[at + 1];
      const k = edges[at + 2];
      for (let n = 0; n < 3; n++) {
        const around = edgeSum[i + n] + edgeSum[j + n] + edgeSum[k + n];
        values[at + n] = share[f] * (ownFactor[f] * values[at + n] + around);
      }
    }
  }
}

// [three times the index of the edge from each corner to the next (3·F), number of edges], by the
// edges' ends.
/** @type {(faces: Values) => [Int32Array, number]} */
function edgesOf(faces) {
  const vertices = faces.reduce((most, vertex) => Math.max(most, vertex), 0) + 1;
  /** @type {Map<number, number>} */
  const index = new Map();
  const edges = Int32Array.from(faces, (vertex, c) => {
    const next = faces[c % 3 < 2 ? c + 1 : c - 2];
    const ends = Math.min(vertex, next) * vertices + Math.max(vertex, next);
    const known = index.get(ends) ?? 3 * index.size;
    index.set(ends, known);
    return known;
  });
  return [edges, index.size];
}

// Symmetric part of the outer product of two vectors, times a factor: xx, yy, zz, xy, yz, zx.
/** @type {(a: ArrayLike<number>, b: ArrayLike<number>, factor: number, out: Float32Array, at: number) => void} */
function symmetricProduct(a, b, factor, out, at) {
  for (let k = 0; k < 3; k++) {
    const next = (k + 1) % 3;
    out[at + k] = factor * a[k] * b[k];
    out[at + 3 + k] = (factor * (a[k] * b[next] + a[next] * b[k])) / 2;
  }
}

/** By the name of their coefficients in a data file (faces, 3·components); of the strain, which is updated first. */
export const SIGNALS = { strain_position: SmoothedStrain };

const MIN_DIVISOR = 1e-30;
const MIN_AREA_RATIO = 1e-4; // of a triangle that counts as a line, to its longest edge's square
const UPRIGHT_COSINE = 0.8;
export const FACE_FLOATS = 16; // of a triangle in the texture: three rows of matrix | origin, then strain | selected

export class FaceFrames {
  // Arrays of the data file, and the convention of the embedding; strain is computed where splats
  // follow it.
  /**
   * @param {Pick<Arrays, 'faces' | 'neutral'> & Partial<Arrays>} arrays
   * @param {string} convention
   */
  constructor(arrays, convention) {
    const faces = arrays.faces.values;
    const neutral = arrays.neutral.values;
    this.faces = faces;
    this.count = faces.length / 3;
    this.isStga = convention === 'stga';
    this.world = new Float64Array(12 * this.count); // rotation · scale and origin, rows of a 3×4 matrix
    this.neutralArea = neutralAreas(faces, neutral);
    const offsets = Object.entries(SIGNALS).filter(([name]) => arrays[name]);
    const followsStrain = arrays.strain_color || offsets.length;
    const strain = followsStrain ? new Strain(faces, neutral, arrays.strain_range?.values) : null;
    this.strain = strain;
    /** Signals and their coefficients (3·S·F): for each of S components a vector in the frame. */
    this.offsets = strain
      ? offsets.map(([name, Signal]) => ({
          signal: new Signal(strain),
          components: Signal.components,
          coefficients: /** @type {Values} */ (arrays[name]?.values),
        }))
      : [];
  }

  // Follow the posed vertices (3·V).
  /** @param {Float64Array} vertices */
  update(vertices) {
    this.placeFrames(vertices);
    this.strain?.update(vertices);
    for (const { signal, components, coefficients } of this.offsets) {
      signal.update();
      this.moveOrigins(signal.values, components, coefficients);
    }
  }

  // "stga": axes [first, normal × first, normal], first from the middle to corner 0; scale
  // sqrt(area / neutral area). "gaussian_avatars": axes [first, normal, first × normal], first
  // along the first edge; scale the mean of edge and height.
  /** @param {Float64Array} vertices */
  placeFrames(vertices) {
    const { faces, isStga, neutralArea, world } = this;
    for (let f = 0; f < this.count; f++) {
      const i = 3 * faces[3 * f];
      const j = 3 * faces[3 * f + 1];
      const k = 3 * faces[3 * f + 2];
      // Edges u and v from corner 0, and their normal n, as long as twice the area.
      const ux = vertices[j] - vertices[i];
      const uy = vertices[j + 1] - vertices[i + 1];
      const uz = vertices[j + 2] - vertices[i + 2];
      const vx = vertices[k] - vertices[i];
      const vy = vertices[k + 1] - vertices[i + 1];
      const vz = vertices[k + 2] - vertices[i + 2];
      let nx = uy * vz - uz * vy;
      let ny = uz * vx - ux * vz;
      let nz = ux * vy - uy * vx;
      let x = isStga ? -(ux + vx) / 3 : ux;
      let y = isStga ? -(uy + vy) / 3 : uy;
      let z = isStga ? -(uz + vz) / 3 : uz;
      const twice = Math.sqrt(nx * nx + ny * ny + nz * nz);
      const length = Math.sqrt(x * x + y * y + z * z);
      const uu = ux * ux + uy * uy + uz * uz;
      const vv = vx * vx + vy * vy + vz * vz;
      const longest = Math.max(
        uu,
        vv,
        (vx - ux) * (vx - ux) + (vy - uy) * (vy - uy) + (vz - uz) * (vz - uz),
      );
      const isShort = length <= MIN_AREA_RATIO * Math.sqrt(longest);
      const isLine = twice <= 2 * MIN_AREA_RATIO * longest;
      if (isShort || isLine) {
        [x, y, z, nx, ny, nz] = substitutes([x, y, z], [nx, ny, nz], isShort, isLine);
      } else {
        const perLength = 1 / length;
        const perTwice = 1 / twice;
        x *= perLength;
        y *= perLength;
        z *= perLength;
        nx *= perTwice;
        ny *= perTwice;
        nz *= perTwice;
      }
      let scale = 1;
      if (!isStga) scale = (length + (isShort ? Math.sqrt(vv) : twice / length)) / 2;
      else if (neutralArea[f] > 0) scale = Math.sqrt(twice / 2 / neutralArea[f]);
      x *= scale;
      y *= scale;
      z *= scale;
      const sx = ny * z - nz * y;
      const sy = nz * x - nx * z;
      const sz = nx * y - ny * x;
      const to = 12 * f;
      world[to] = x;
      world[to + 1] = isStga ? sx : scale * nx;
      world[to + 2] = isStga ? scale * nx : -sx;
      world[to + 3] = vertices[i] + (ux + vx) / 3;
      world[to + 4] = y;
      world[to + 5] = isStga ? sy : scale * ny;
      world[to + 6] = isStga ? scale * ny : -sy;
      world[to + 7] = vertices[i + 1] + (uy + vy) / 3;
      world[to + 8] = z;
      world[to + 9] = isStga ? sz : scale * nz;
      world[to + 10] = isStga ? scale * nz : -sz;
      world[to + 11] = vertices[i + 2] + (uz + vz) / 3;
    }
  }

  // Move the origins by a signal (S·F) times coefficients (3·S·F), in each triangle's own axes and
  // unit.
  /** @type {(values: Float64Array, components: number, coefficients: Values) => void} */
  moveOrigins(values, components, coefficients) {
    const { count, world } = this;
    for (let f = 0; f < count; f++) {
      let x = 0;
      let y = 0;
      let z = 0;
      for (let k = components * f; k < components * (f + 1); k++) {
        x += values[k] * coefficients[3 * k];
        y += values[k] * coefficients[3 * k + 1];
        z += values[k] * coefficients[3 * k + 2];
      }
      for (let to = 12 * f; to < 12 * f + 12; to += 4) {
        world[to + 3] += world[to] * x + world[to + 1] * y + world[to + 2] * z;
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

  // Write strain, for colors that follow it, and the triangles' selection flags (bits, or null: all
  // selected).
  /** @type {(selection: ArrayLike<number> | null, out: Float32Array) => void} */
  annotate(selection, out) {
    const strain = this.strain?.values;
    for (let f = 0; f < this.count; f++) {
      const to = FACE_FLOATS * f + 12;
      for (let k = 0; k < 3; k++) out[to + k] = strain ? strain[3 * f + k] : 0;
      out[to + 3] = selection ? (selection[f >> 3] >> (7 - (f & 7))) & 1 : 1;
    }
  }
}

// Areas of the triangles; 0 for those that count as lines.
/** @type {(faces: Values, neutral: Values) => Float64Array<ArrayBuffer>} */
function neutralAreas(faces, neutral) {
  const areas = new Float64Array(faces.length / 3);
  const corner = (/** @type {number} */ f, /** @type {number} */ k) =>
    neutral.subarray(3 * faces[3 * f + k], 3 * faces[3 * f + k] + 3);
  for (let f = 0; f < areas.length; f++) {
    const u = difference(corner(f, 1), corner(f, 0));
    const v = difference(corner(f, 2), corner(f, 0));
    const w = difference(corner(f, 2), corner(f, 1));
    const area = Math.hypot(...crossed(u, v)) / 2;
    const longest = Math.max(dotProduct(u, u), dotProduct(v, v), dotProduct(w, w));
    areas[f] = area > Math.max(MIN_AREA_RATIO * longest, MIN_DIVISOR) ? area : 0;
  }
  return areas;
}

// Perpendicular unit vectors first and normal (six numbers) of a triangle that is a line, or whose
// `first` has no length.
/**
 * @param {Vector} first
 * @param {Vector} normal
 * @param {boolean} isShort
 * @param {boolean} isLine
 * @returns {number[]}
 */
function substitutes(first, normal, isShort, isLine) {
  const x = isShort ? [1, 0, 0] : unit(first);
  const isUpright = Math.abs(x[2]) > UPRIGHT_COSINE;
  const n = isLine ? crossed(x, isUpright ? [1, 0, 0] : [0, 0, 1]) : normal;
  return [...x, ...unit(difference(n, scaled(x, dotProduct(n, x))))];
}
