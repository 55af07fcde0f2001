// @ts-check
// Vectors of three numbers.

/** @import { Vector } from './types.js' */

/**
 * @param {ArrayLike<number>} a
 * @param {ArrayLike<number>} b
 * @returns {Vector}
 */
export function crossed(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/**
 * @param {ArrayLike<number>} a
 * @param {ArrayLike<number>} b
 * @returns {number}
 */
export function dotProduct(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/**
 * @param {ArrayLike<number>} a
 * @param {ArrayLike<number>} b
 * @returns {Vector}
 */
export function difference(a, b) {
  return [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
}

/**
 * @param {ArrayLike<number>} v
 * @param {number} factor
 * @returns {Vector}
 */
export function scaled(v, factor) {
  return [v[0] * factor, v[1] * factor, v[2] * factor];
}

/**
 * @param {ArrayLike<number>} v
 * @returns {Vector}
 */
export function unit(v) {
  return scaled(v, 1 / Math.hypot(v[0], v[1], v[2]));
}

/**
 * Least and largest coordinates of points (3·V).
 * @param {ArrayLike<number>} points
 * @returns {[Vector, Vector]}
 */
export function box(points) {
  /** @type {Vector} */
  const low = [Infinity, Infinity, Infinity];
  /** @type {Vector} */
  const high = [-Infinity, -Infinity, -Infinity];
  for (let k = 0; k < points.length; k++) {
    low[k % 3] = Math.min(low[k % 3], points[k]);
    high[k % 3] = Math.max(high[k % 3], points[k]);
  }
  return [low, high];
}
