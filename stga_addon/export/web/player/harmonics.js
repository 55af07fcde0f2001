// @ts-check
// Spherical harmonics of degree 2, in which distant light is kept: nine coefficients of red, green and blue each.

/** @import { Vector } from './types.js' */

export const HARMONICS = 9;
const DEGREE_0 = 0.28209479177387814;
const DEGREE_1 = 0.4886025119029199;
const MIXED = 1.0925484305920792; // xy, yz, xz
const UPRIGHT = 0.31539156525252005; // 3z² − 1
const CROSSED = 0.5462742152960396; // x² − y²
/** Of each coefficient in a lobe max(0, cosine), over its value in the lobe's direction (Ramamoorthi and Hanrahan). */
export const COSINE_LOBE = [Math.PI, ...Array(3).fill((2 * Math.PI) / 3), ...Array(5).fill(Math.PI / 4)];

/**
 * Basis functions of a unit vector, orthonormal on the sphere: 1, y, z, x, xy, yz, 3z² − 1, xz, x² − y².
 * @param {ArrayLike<number>} direction
 */
export function harmonicsOf(direction) {
  const [x, y, z] = [direction[0], direction[1], direction[2]];
  const linear = [DEGREE_0, DEGREE_1 * y, DEGREE_1 * z, DEGREE_1 * x];
  const square = [UPRIGHT * (3 * z * z - 1), MIXED * x * z, CROSSED * (x * x - y * y)];
  return [...linear, MIXED * x * y, MIXED * y * z, ...square];
}

/**
 * Light of a color from everywhere.
 * @param {ArrayLike<number>} color
 */
export function evenLight(color) {
  const light = new Float64Array(3 * HARMONICS);
  for (let c = 0; c < 3; c++) light[c] = color[c] / DEGREE_0;
  return light;
}

/**
 * Add radiance of a color that falls with the cosine around a direction.
 * @param {Float64Array} light
 * @param {Vector} toward
 * @param {ArrayLike<number>} color
 */
export function addLobe(light, toward, color) {
  const values = harmonicsOf(toward);
  for (let k = 0; k < HARMONICS; k++) {
    for (let c = 0; c < 3; c++) light[3 * k + c] += COSINE_LOBE[k] * values[k] * color[c];
  }
}

/**
 * The same light in other axes: the rotation (3×3, row by row) takes old coordinates to new ones. Degree 1 turns as a
 * vector, degree 2 as a symmetric matrix.
 * @param {ArrayLike<number>} light
 * @param {ArrayLike<number>} rotation
 */
export function rotatedLight(light, rotation) {
  const turned = new Float64Array(3 * HARMONICS);
  for (let c = 0; c < 3; c++) {
    const part = (/** @type {number} */ k) => light[3 * k + c];
    const [x, y, z] = turnedVector(rotation, [part(3), part(1), part(2)]);
    const [xy, yz, xz] = [part(4), part(5), part(7)].map((value) => (MIXED / 2) * value);
    const [up, across] = [UPRIGHT * part(6), CROSSED * part(8)];
    const m = turnedMatrix(rotation, [across - up, xy, xz, xy, -across - up, yz, xz, yz, 2 * up]);
    const square = [(2 * m[1]) / MIXED, (2 * m[5]) / MIXED, m[8] / (2 * UPRIGHT), (2 * m[2]) / MIXED];
    [part(0), y, z, x, ...square, (m[0] - m[4]) / (2 * CROSSED)].forEach((value, k) => (turned[3 * k + c] = value));
  }
  return turned;
}

/**
 * @param {ArrayLike<number>} rotation
 * @param {ArrayLike<number>} v
 * @returns {Vector}
 */
export function turnedVector(rotation, v) {
  const part = (/** @type {number} */ k) => rotation[k] * v[0] + rotation[k + 1] * v[1] + rotation[k + 2] * v[2];
  return [part(0), part(3), part(6)];
}

/**
 * R · M · Rᵀ of 3×3 matrices, row by row.
 * @param {ArrayLike<number>} rotation
 * @param {number[]} m
 */
function turnedMatrix(rotation, m) {
  const rows = [0, 3, 6].map((k) => turnedVector(rotation, m.slice(k, k + 3))); // (R · row)ᵀ: rows of M · Rᵀ
  const columns = [0, 1, 2].map((k) => turnedVector(rotation, [rows[0][k], rows[1][k], rows[2][k]]));
  return [0, 1, 2].flatMap((row) => columns.map((column) => column[row]));
}

/**
 * Add light of an irradiance from one direction.
 * @param {Float64Array} light
 * @param {ArrayLike<number>} toward
 * @param {ArrayLike<number>} color
 */
export function addPoint(light, toward, color) {
  harmonicsOf(toward).forEach((value, k) => {
    for (let c = 0; c < 3; c++) light[3 * k + c] += value * color[c];
  });
}
