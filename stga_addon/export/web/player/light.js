// @ts-check
// Distant light: as it is asked for, as the player computes with it, and how a head receives and
// reflects it. Axes are those of the data file's meshes; the rules are those of STGA for Blender's
// light/.

/** @import { Environment, Lighting, LitBy, Values, Vector } from './types.js' */

import { box, crossed, dotProduct, matrixFromAxisAngle, scaled, unit } from './vector.js';

// Built-in environments, y up and the face towards z: even radiance, lobes of radiance that falls
// with the cosine, and a sun of irradiance `color` that throws shadows.
/** @type {Record<string, Environment>} */
export const ENVIRONMENTS = {
  studio: {
    label: 'Soft studio',
    even: [0.22, 0.22, 0.23],
    lobes: [
      { toward: [-0.6, 0.5, 0.6], color: [1.05, 1.0, 0.94] },
      { toward: [0.7, 0.2, 0.6], color: [0.42, 0.44, 0.48] },
    ],
  },
  sky: {
    label: 'Open sky',
    even: [0.2, 0.25, 0.32],
    lobes: [
      { toward: [0.1, 1, 0.3], color: [0.75, 0.92, 1.15] },
      { toward: [0, -1, 0], color: [0.16, 0.13, 0.1] },
    ],
  },
  sunset: {
    label: 'Sunset',
    even: [0.09, 0.09, 0.14],
    lobes: [
      { toward: [0.9, 0.15, 0.2], color: [0.75, 0.34, 0.16] },
      { toward: [-0.5, 0.8, 0.2], color: [0.16, 0.2, 0.42] },
    ],
    sun: { toward: [0.85, 0.28, 0.45], color: [3.4, 1.75, 0.7] },
  },
};

// What the player computes with. Throws RangeError where the lighting is none (types.d.ts).
/** @type {(lighting: Lighting, up: Vector) => LitBy} */
export function litBy(lighting, up) {
  const { even = [0, 0, 0], environment, turn = 0, harmonics, exposure = 0 } = lighting;
  check([...even, turn, exposure], 5, 'even, turn and exposure');
  const world = evenLight(even);
  const added =
    environment === undefined ? null : addEnvironment(world, environment, fromUpright(up, turn));
  if (harmonics) {
    check(harmonics, 3 * HARMONICS, 'harmonics');
    for (let k = 0; k < world.length; k++) world[k] += harmonics[k];
  }
  const sun = lighting.sun ?? added;
  if (sun) check([...sun.toward, ...sun.color], 6, 'sun');
  return {
    world,
    sun: sun && { toward: unit(sun.toward), color: [...sun.color] },
    factor: 2 ** exposure,
  };
}

// Add an environment whose axes a rotation takes to those of the head; returns its sun.
/**
 * @type {(world: Float64Array, name: string, rotation: ArrayLike<number>) => { toward: Vector;
 *   color: Vector; } | null}
 */
function addEnvironment(world, name, rotation) {
  if (!Object.hasOwn(ENVIRONMENTS, name))
    throw new RangeError(`There is no environment "${name}".`);
  const { even, lobes, sun } = ENVIRONMENTS[name];
  evenLight(even).forEach((value, k) => (world[k] += value));
  for (const { toward, color } of lobes)
    addLobe(world, turnedVector(rotation, unit(toward)), color);
  return sun ? { toward: turnedVector(rotation, sun.toward), color: sun.color } : null;
}

// The rotation from axes in which y is up, turned about it by an angle, to those in which `up` is.
/** @type {(up: Vector, turn: number) => number[]} */
function fromUpright(up, turn) {
  const [tilt, spin] = [new Float64Array(9), new Float64Array(9)];
  matrixFromAxisAngle(scaled(unit(up), turn), 0, spin, 0);
  const axis = crossed([0, 1, 0], unit(up));
  const sine = Math.hypot(...axis);
  const angle = Math.atan2(sine, unit(up)[1]);
  matrixFromAxisAngle(sine > 1e-9 ? scaled(axis, angle / sine) : [angle, 0, 0], 0, tilt, 0);
  const columns = [0, 1, 2].map(k => turnedVector(spin, [tilt[k], tilt[k + 3], tilt[k + 6]]));
  return [0, 1, 2].flatMap(row => columns.map(column => column[row]));
}

/** @type {(values: ArrayLike<number>, count: number, name: string) => void} */
function check(values, count, name) {
  if (values.length !== count || !Array.from(values).every(Number.isFinite)) {
    throw new RangeError(
      `Lighting: ${name} holds something else than finite numbers, or too few or too many.`,
    );
  }
}

// Spherical harmonics of degree 2, in which distant light is kept: nine coefficients of red, green
// and blue each.

export const HARMONICS = 9;
const DEGREE_0 = 0.28209479177387814;
const DEGREE_1 = 0.4886025119029199;
const MIXED = 1.0925484305920792; // xy, yz, xz
const UPRIGHT = 0.31539156525252005; // 3z² − 1
const CROSSED = 0.5462742152960396; // x² − y²
// Of each coefficient in a lobe max(0, cosine), over its value in the lobe's direction (Ramamoorthi
// and Hanrahan).
export const COSINE_LOBE = [
  Math.PI,
  ...Array(3).fill((2 * Math.PI) / 3),
  ...Array(5).fill(Math.PI / 4),
];

// Basis functions of a unit vector, orthonormal on the sphere: 1, y, z, x, xy, yz, 3z² − 1, xz, x²
// − y².
/** @param {ArrayLike<number>} direction */
export function harmonicsOf(direction) {
  const [x, y, z] = [direction[0], direction[1], direction[2]];
  const linear = [DEGREE_0, DEGREE_1 * y, DEGREE_1 * z, DEGREE_1 * x];
  const square = [UPRIGHT * (3 * z * z - 1), MIXED * x * z, CROSSED * (x * x - y * y)];
  return [...linear, MIXED * x * y, MIXED * y * z, ...square];
}

// Light of a color from everywhere.
/** @param {ArrayLike<number>} color */
export function evenLight(color) {
  const light = new Float64Array(3 * HARMONICS);
  for (let c = 0; c < 3; c++) light[c] = color[c] / DEGREE_0;
  return light;
}

// Add radiance of a color that falls with the cosine around a direction.
/** @type {(light: Float64Array, toward: Vector, color: ArrayLike<number>) => void} */
export function addLobe(light, toward, color) {
  const values = harmonicsOf(toward);
  for (let k = 0; k < HARMONICS; k++) {
    for (let c = 0; c < 3; c++) light[3 * k + c] += COSINE_LOBE[k] * values[k] * color[c];
  }
}

// The same light in other axes: the rotation (3×3, row by row) takes old coordinates to new ones.
// Degree 1 turns as a vector, degree 2 as a symmetric matrix.
/** @type {(light: ArrayLike<number>, rotation: ArrayLike<number>) => Float64Array<ArrayBuffer>} */
export function rotatedLight(light, rotation) {
  const turned = new Float64Array(3 * HARMONICS);
  for (let c = 0; c < 3; c++) {
    const part = (/** @type {number} */ k) => light[3 * k + c];
    const [x, y, z] = turnedVector(rotation, [part(3), part(1), part(2)]);
    const [xy, yz, xz] = [part(4), part(5), part(7)].map(value => (MIXED / 2) * value);
    const [up, across] = [UPRIGHT * part(6), CROSSED * part(8)];
    const m = turnedMatrix(rotation, [across - up, xy, xz, xy, -across - up, yz, xz, yz, 2 * up]);
    const square = [
      (2 * m[1]) / MIXED,
      (2 * m[5]) / MIXED,
      m[8] / (2 * UPRIGHT),
      (2 * m[2]) / MIXED,
    ];
    [part(0), y, z, x, ...square, (m[0] - m[4]) / (2 * CROSSED)].forEach(
      (value, k) => (turned[3 * k + c] = value),
    );
  }
  return turned;
}

/** @type {(rotation: ArrayLike<number>, v: ArrayLike<number>) => Vector} */
export function turnedVector(rotation, v) {
  const part = (/** @type {number} */ k) =>
    rotation[k] * v[0] + rotation[k + 1] * v[1] + rotation[k + 2] * v[2];
  return [part(0), part(3), part(6)];
}

// R · M · Rᵀ of 3×3 matrices, row by row.
/** @type {(rotation: ArrayLike<number>, m: number[]) => number[]} */
function turnedMatrix(rotation, m) {
  // (R · row)ᵀ: rows of M · Rᵀ.
  const rows = [0, 3, 6].map(k => turnedVector(rotation, m.slice(k, k + 3)));
  const columns = [0, 1, 2].map(k => turnedVector(rotation, [rows[0][k], rows[1][k], rows[2][k]]));
  return [0, 1, 2].flatMap(row => columns.map(column => column[row]));
}

// Add light of an irradiance from one direction.
/** @type {(light: Float64Array, toward: ArrayLike<number>, color: ArrayLike<number>) => void} */
export function addPoint(light, toward, color) {
  harmonicsOf(toward).forEach((value, k) => {
    for (let c = 0; c < 3; c++) light[3 * k + c] += value * color[c];
  });
}

// What arrives at a head, and how much of its recorded colors that keeps

// The rotation (3×3, row by row) that best takes vertices to others (both 3·V), by weights (V): the
// orthogonal factor of their weighted covariance (Higham's iteration).
/**
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
    // A mesh without an extent.
    if (!(Math.abs(determinant) > 1e-300)) return [1, 0, 0, 0, 1, 0, 0, 0, 1];
    const next = m.map((value, at) => (value + cofactors[at] / determinant) / 2);
    const change = next.reduce((most, value, at) => Math.max(most, Math.abs(value - m[at])), 0);
    m = next;
    if (change < 1e-12) break;
  }
  return m;
}

// Σ weight · to · fromᵀ about the weighted means, over its norm.
/**
 * @type {(from: ArrayLike<number>, to: ArrayLike<number>, weights: ArrayLike<number>) =>
 *   number[]}
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
  return m.map(value => value / norm);
}

// Irradiance (3·V) of light (harmonics in the head's axes) past the head itself.
/**
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

const CELL_M = 0.02;
const SKIN = [0.5, 0.33, 0.25];
const MIN_OPEN = 0.3; // share of the sky that a vertex must see to count as lit skin

export class Bounce {
  // Neutral vertices (3·V), triangles (3·F) with their areas, and the share of the sky that
  // vertices see (V).
  /**
   * @param {Values} neutral
   * @param {Values} faces
   * @param {ArrayLike<number>} areas
   * @param {ArrayLike<number>} occlusion
   */
  constructor(neutral, faces, areas, occlusion) {
    this.occlusion = occlusion;
    this.weight = new Float64Array(occlusion.length);
    for (let c = 0; c < faces.length; c++) {
      if (occlusion[faces[c]] > MIN_OPEN) this.weight[faces[c]] += areas[Math.floor(c / 3)];
    }
    this.cell = new Int32Array(occlusion.length);
    this.cells = 0;
    /** Cells between neighbors along x, y and z; the outermost cells are empty. */
    this.strides = this.placeInCells(neutral);
    this.sumOfWeights = this.around(this.weight);
  }

  /** @param {Values} neutral */
  placeInCells(neutral) {
    const [low, high] = box(neutral);
    const place = (/** @type {number} */ value, /** @type {number} */ axis) =>
      Math.floor((value - low[axis]) / CELL_M) + 1;
    const [nx, ny, nz] = high.map((value, axis) => place(value, axis) + 2);
    for (let v = 0; v < this.cell.length; v++) {
      const [x, y, z] = [0, 1, 2].map(axis => place(neutral[3 * v + axis], axis));
      this.cell[v] = (x * ny + y) * nz + z;
    }
    this.cells = nx * ny * nz;
    return [ny * nz, nz, 1];
  }

  // Sum of values (V) in each vertex's cell and the 26 around it.
  /** @param {ArrayLike<number>} values */
  around(values) {
    const { cell } = this;
    let total = new Float64Array(this.cells);
    for (let v = 0; v < cell.length; v++) total[cell[v]] += values[v];
    for (const stride of this.strides) {
      const sum = new Float64Array(total.length);
      for (let k = stride; k < total.length - stride; k++)
        sum[k] = total[k - stride] + total[k] + total[k + stride];
      total = sum;
    }
    const found = new Float64Array(cell.length);
    for (let v = 0; v < cell.length; v++) found[v] = total[cell[v]];
    return found;
  }

  // Add the irradiance that vertices get from skin around them to `out`: of `arriving`, both three
  // numbers a vertex.
  /** @type {(arriving: Float64Array, out: Float64Array) => void} */
  add(arriving, out) {
    const { occlusion, weight, sumOfWeights } = this;
    const channel = new Float64Array(weight.length);
    for (let c = 0; c < 3; c++) {
      for (let v = 0; v < weight.length; v++) channel[v] = weight[v] * arriving[3 * v + c];
      const near = this.around(channel);
      for (let v = 0; v < weight.length; v++) {
        out[3 * v + c] +=
          ((1 - occlusion[v]) * SKIN[c] * near[v]) / Math.max(sumOfWeights[v], 1e-12);
      }
    }
  }
}

// Difference between two lights from which on nothing is kept, as a share of the capture's light.
const UNLIKE_LIGHT = 0.2;

// Gain of red, green and blue, and share, by the light of the capture and the one that is shown (27
// harmonics each, in the same axes; lamps as if they were far away).
/** @type {(recorded: ArrayLike<number>, shown: ArrayLike<number>) => number[]} */
export function keptColors(recorded, shown) {
  const gain = [0, 0, 0];
  const weight = (/** @type {number} */ k) => COSINE_LOBE[Math.floor(k / 3)] ** 2;
  const [product, square] = [new Float64Array(3), new Float64Array(3).fill(1e-12)];
  for (let k = 0; k < 3 * HARMONICS; k++) {
    product[k % 3] += weight(k) * recorded[k] * shown[k];
    square[k % 3] += weight(k) * recorded[k] ** 2;
  }
  for (let c = 0; c < 3; c++) gain[c] = Math.max(0, product[c] / square[c]);
  let [off, whole] = [0, 1e-24];
  for (let k = 0; k < 3 * HARMONICS; k++) {
    const same = gain[k % 3] * recorded[k];
    off += weight(k) * (shown[k] - same) ** 2;
    whole += weight(k) * same ** 2;
  }
  const step = Math.min(1, Math.sqrt(off / whole) / UNLIKE_LIGHT);
  return [...gain, 1 - step * step * (3 - 2 * step)];
}
