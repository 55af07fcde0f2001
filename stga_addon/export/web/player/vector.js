// @ts-check
// Vectors of three numbers, and rotations as axis-angle vectors, unit quaternions (w, x, y, z) and
// 3×3 matrices, row by row.

/** @import { Vector } from './types.js' */

const SMALL_ANGLE = 1e-8;

/** @type {(part: (k: number) => number) => Vector} */
export const vector = part => [part(0), part(1), part(2)];

/** @type {(a: ArrayLike<number>, b: ArrayLike<number>) => Vector} */
export const crossed = (a, b) => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];

/** @type {(a: ArrayLike<number>, b: ArrayLike<number>) => number} */
export const dotProduct = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** @type {(a: ArrayLike<number>, b: ArrayLike<number>) => Vector} */
export const difference = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];

/** @type {(v: ArrayLike<number>, factor: number) => Vector} */
export const scaled = (v, factor) => [v[0] * factor, v[1] * factor, v[2] * factor];

/** @type {(v: ArrayLike<number>) => Vector} */
export const unit = v => scaled(v, 1 / Math.hypot(v[0], v[1], v[2]));

// Least and largest coordinates of points (3·V).
/** @type {(points: ArrayLike<number>) => [Vector, Vector]} */
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

// The matrix of an axis-angle vector.
/** @param {ArrayLike<number>} vector */
export function matrixOf(vector) {
  const [w, x, y, z] = quaternionOf(vector);
  const first = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)];
  const second = [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)];
  return [...first, ...second, 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
}

// Axis-angle vector on the shortest arc from axis-angle vector `a` to `b`, at `share` of the way.
/** @type {(a: ArrayLike<number>, b: ArrayLike<number>, share: number) => Vector} */
export function slerpAxisAngle(a, b, share) {
  const [w, x, y, z] = quaternionOf(a);
  const way = axisAngleOf(multiplied([w, -x, -y, -z], quaternionOf(b)));
  return axisAngleOf(multiplied([w, x, y, z], quaternionOf(scaled(way, share))));
}

/** @type {(vector: ArrayLike<number>) => number[]} */
export function quaternionOf(vector) {
  const [x, y, z] = [vector[0], vector[1], vector[2]];
  const angle = Math.hypot(x, y, z);
  const factor = angle < SMALL_ANGLE ? 0.5 : Math.sin(angle / 2) / angle;
  return [Math.cos(angle / 2), factor * x, factor * y, factor * z];
}

// By half a turn at most.
/** @type {(quaternion: number[]) => Vector} */
export function axisAngleOf([w, x, y, z]) {
  const length = Math.hypot(x, y, z);
  return scaled([x, y, z], length < SMALL_ANGLE ? 2 : (2 * Math.atan(length / w)) / length);
}

// The quaternion that turns by `b`, then by `a`.
/** @type {(a: number[], b: number[]) => number[]} */
export function multiplied([aw, ax, ay, az], [bw, bx, by, bz]) {
  return [
    aw * bw - ax * bx - ay * by - az * bz,
    aw * bx + ax * bw + ay * bz - az * by,
    aw * by - ax * bz + ay * bw + az * bx,
    aw * bz + ax * by - ay * bx + az * bw,
  ];
}
