// @ts-check
// Vectors of three numbers, and rotations as axis-angle vectors, unit quaternions (w, x, y, z) and
// 3×3 matrices, row by row.

/** @import { Values, Vector } from './types.js' */

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

// Write the matrix of the axis-angle vector at `from` of `vectors` to `out` (9 numbers from `to`).
/** @type {(vectors: ArrayLike<number>, from: number, out: Float64Array, to: number) => void} */
export function matrixFromAxisAngle(vectors, from, out, to) {
  const [x, y, z] = [vectors[from], vectors[from + 1], vectors[from + 2]];
  const angle = Math.hypot(x, y, z);
  const first = angle < SMALL_ANGLE ? 1 : Math.sin(angle) / angle;
  const half = angle < SMALL_ANGLE ? 1 : Math.sin(angle / 2) / (angle / 2);
  const second = (half * half) / 2; // (1 − cos) / angle², without cancellation
  out[to] = 1 - second * (y * y + z * z);
  out[to + 1] = second * x * y - first * z;
  out[to + 2] = second * x * z + first * y;
  out[to + 3] = second * x * y + first * z;
  out[to + 4] = 1 - second * (x * x + z * z);
  out[to + 5] = second * y * z - first * x;
  out[to + 6] = second * x * z - first * y;
  out[to + 7] = second * y * z + first * x;
  out[to + 8] = 1 - second * (x * x + y * y);
}

// Axis-angle vector on the shortest arc from axis-angle vector `a` to `b`, at `share` of the way.
/** @type {(a: ArrayLike<number>, b: ArrayLike<number>, share: number) => Vector} */
export function slerpAxisAngle(a, b, share) {
  const p = quaternionOf(a);
  let q = quaternionOf(b);
  let cosine = p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3];
  if (cosine < 0) {
    q = q.map(part => -part);
    cosine = -cosine;
  }
  const angle = Math.acos(Math.min(1, cosine));
  const sine = Math.sin(angle);
  const before = sine < SMALL_ANGLE ? 1 - share : Math.sin((1 - share) * angle) / sine;
  const after = sine < SMALL_ANGLE ? share : Math.sin(share * angle) / sine;
  return axisAngleOf(p.map((part, k) => before * part + after * q[k]));
}

/** @type {(vector: ArrayLike<number>) => number[]} */
export function quaternionOf(vector) {
  const [x, y, z] = [vector[0], vector[1], vector[2]];
  const angle = Math.hypot(x, y, z);
  const factor = angle < SMALL_ANGLE ? 0.5 : Math.sin(angle / 2) / angle;
  return [Math.cos(angle / 2), factor * x, factor * y, factor * z];
}

/** @type {(quaternion: number[]) => Vector} */
export function axisAngleOf([w, x, y, z]) {
  const length = Math.hypot(x, y, z);
  const angle = 2 * Math.atan2(length, w);
  const factor = length < SMALL_ANGLE ? 2 : angle / length;
  return [factor * x, factor * y, factor * z];
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

// The unit quaternion whose parts but the largest, which is positive, are `smaller`.
/** @type {(smaller: Values, largest: number) => number[]} */
export function wholeQuaternion(smaller, largest) {
  const rest = Math.sqrt(Math.max(0, 1 - smaller[0] ** 2 - smaller[1] ** 2 - smaller[2] ** 2));
  const whole = Array.from(smaller);
  whole.splice(largest, 0, rest);
  return whole;
}
