// @ts-check
// How much of an avatar's recorded colors a light keeps. The rules are those of STGA for Blender's light/relight.py.

/** @import { Bounce } from './bounce.js' */

import { COSINE_LOBE, HARMONICS } from './harmonics.js';

/** Difference between two lights from which on nothing is kept, as a share of the capture's light. */
const UNLIKE_LIGHT = 0.2;
/** Difference between what arrives at a splat, now and in the capture, up to which all is kept, and from which nothing. */
export const ALIKE_AT_SPLAT = 0.25;
export const UNLIKE_AT_SPLAT = 0.75;

/** Of the mean of a matrix's diagonal, added to it: meshes that receive no light in some harmonics. */
const RIDGE = 1e-6;

/**
 * The light (27 harmonics in the axes of the neutral mesh) that gave vertices their irradiance (3·V): the least squares
 * of its transfer (9·V) and of what skin reflects onto skin.
 * @param {ArrayLike<number>} transfer
 * @param {Bounce} bounce
 * @param {ArrayLike<number>} irradiance
 */
export function recordedLight(transfer, bounce, irradiance) {
  const columns = Array.from({ length: HARMONICS }, (_, k) => {
    const direct = Float64Array.from(irradiance, (_, n) => transfer[HARMONICS * Math.floor(n / 3) + k]);
    const all = Float64Array.from(direct);
    bounce.add(direct, all);
    return all;
  });
  const light = new Float64Array(3 * HARMONICS);
  for (let c = 0; c < 3; c++) {
    const rows = columns.map((one) => [...columns, irradiance].map((other) => channelProduct(one, other, c)));
    const mean = rows.reduce((sum, row, k) => sum + row[k], 0) / HARMONICS;
    rows.forEach((row, k) => (row[k] += RIDGE * mean));
    solved(rows).forEach((value, k) => (light[3 * k + c] = value));
  }
  return light;
}

/**
 * @param {ArrayLike<number>} a
 * @param {ArrayLike<number>} b
 * @param {number} channel
 */
function channelProduct(a, b, channel) {
  let sum = 0;
  for (let n = channel; n < a.length; n += 3) sum += a[n] * b[n];
  return sum;
}

/**
 * Solution of equations whose matrix is positive definite: rows with the right side last, which are changed.
 * @param {number[][]} rows
 */
function solved(rows) {
  const count = rows.length;
  for (let k = 0; k < count; k++) {
    for (let below = k + 1; below < count; below++) {
      const factor = rows[below][k] / rows[k][k];
      for (let j = k; j <= count; j++) rows[below][j] -= factor * rows[k][j];
    }
  }
  const found = new Array(count).fill(0);
  for (let k = count - 1; k >= 0; k--) {
    let rest = rows[k][count];
    for (let j = k + 1; j < count; j++) rest -= rows[k][j] * found[j];
    found[k] = rest / rows[k][k];
  }
  return found;
}

/**
 * Share, and gain of red, green and blue, by the light of the capture and the one that is shown (27 harmonics each, in
 * the same axes; lamps as if they were far away).
 * @param {ArrayLike<number>} recorded
 * @param {ArrayLike<number>} shown
 */
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
  return { share: 1 - step * step * (3 - 2 * step), gain };
}
