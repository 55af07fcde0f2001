// @ts-check
// Green's strain of the triangles against the neutral mesh, averaged over neighbors: three components, clipped; and
// smoothed strain, the same less that at rest, averaged over triangles that share an edge.
// The rules are those of STGA for Blender's strain.py.

/** @import { Values } from './types.js' */

import { crossed, difference, dotProduct, scaled, unit } from './vector.js';

const STRAIN_GAIN = 5;
const MAX_STRAIN = 2;
const AVERAGING_ROUNDS = 3; // of smoothed strain
const MIN_SQUARED_NORMAL = 1e-24;

export class Strain {
  /**
   * faces (3·F), neutral (3·V) meters, range (6·F: lowest three, highest three) of strain; ±MAX_STRAIN without one.
   * @param {Values} faces
   * @param {Values} neutral
   * @param {Values} [range]
   */
  constructor(faces, neutral, range) {
    this.faces = faces;
    const count = faces.length / 3;
    this.range = range ?? new Float32Array(6 * count).map((_, k) => (k % 6 < 3 ? -MAX_STRAIN : MAX_STRAIN));
    this.values = new Float32Array(3 * count);
    this.gram = new Float64Array(3 * count); // u·u, u·v, v·v of the neutral edges from corner 0
    this.toTensor = new Float32Array(18 * count); // change of gram → tensor xx, yy, zz, xy, yz, zx
    this.toPlane = new Float32Array(18 * count); // tensor → along the first edge, across it, shear
    this.share = new Float64Array(neutral.length / 3); // of a triangle in the mean of its vertex, and that in its own
    this.atVertex = new Float64Array(2 * neutral.length);
    for (const vertex of faces) this.share[vertex]++;
    for (let v = 0; v < this.share.length; v++) this.share[v] = 1 / (3 * Math.max(1, this.share[v]));
    for (let f = 0; f < count; f++) this.prepare(f, neutral);
  }

  /**
   * @param {number} f
   * @param {Values} neutral
   */
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

  /**
   * Follow the posed vertices (3·V).
   * @param {Float64Array} vertices
   */
  update(vertices) {
    this.spread(vertices);
    this.gather();
  }

  /**
   * Add every triangle's tensor to its three vertices, each of which takes its mean.
   * @param {Float64Array} vertices
   */
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

  /**
   * Of `strain` (Strain), which is to be updated first.
   * @param {Strain} strain
   */
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

  /**
   * The sums of a triangle's three edges hold its neighbors, and itself three times: `ownFactor` leaves it once.
   * @param {number} edgeCount
   */
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

/**
 * [three times the index of the edge from each corner to the next (3·F), number of edges], by the edges' ends.
 * @param {Values} faces
 * @returns {[Int32Array, number]}
 */
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

/**
 * Symmetric part of the outer product of two vectors, times a factor: xx, yy, zz, xy, yz, zx.
 * @param {ArrayLike<number>} a
 * @param {ArrayLike<number>} b
 * @param {number} factor
 * @param {Float32Array} out
 * @param {number} at
 */
function symmetricProduct(a, b, factor, out, at) {
  for (let k = 0; k < 3; k++) {
    const next = (k + 1) % 3;
    out[at + k] = factor * a[k] * b[k];
    out[at + 3 + k] = (factor * (a[k] * b[next] + a[next] * b[k])) / 2;
  }
}
