// @ts-check
// The recorded motion, ARKit's shapes and the values by which a person or a program replaces parts
// of it; and the mesh of a pose.

/** @import { Data, Performance } from './types.js' */

import { axisAngleOf, matrixOf, multiplied, quaternionOf, slerpAxisAngle } from './vector.js';

// Coefficients, pose and translation of any moment. Pinned values (not NaN) replace recorded ones.
export class Motion {
  /** @param {Data} data */
  constructor(data) {
    this.data = data;
    this.shapes = new Shapes(data);
    const { coefficients, pose } = data.arrays;
    this.coefficients = new Float64Array(coefficients.shape[1]);
    this.pose = new Float64Array(3 * pose.shape[1]);
    this.translation = new Float64Array(3);
    this.pinnedCoefficients = this.coefficients.slice().fill(NaN);
    this.pinnedPose = this.pose.slice().fill(NaN);
  }

  /** Of the performance, where one plays instead of the recording. */
  get frames() {
    return this.shapes.performance?.rows.length ?? this.data.arrays.pose.shape[0];
  }

  get fps() {
    return this.shapes.performance?.fps ?? this.data.header.fps;
  }

  // Fill coefficients, pose and translation with those of `frame`, between frames on the shortest
  // way. Of a performance, the head as a whole stays where it is in the first recorded frame.
  /** @param {number} frame */
  sample(frame) {
    const { arrays } = this.data;
    const time = this.shapes.performance ? 0 : frame;
    const [first, second, share] = neighbors(time, arrays.pose.shape[0]);
    for (const name of /** @type {const} */ (['coefficients', 'translation'])) {
      const [{ values }, out] = [arrays[name], this[name]];
      for (let k = 0, at = first * out.length, to = second * out.length; k < out.length; k++)
        out[k] = values[at + k] + share * (values[to + k] - values[at + k]);
    }
    for (let at = 0; at < this.pose.length; at += 3) {
      const [before, after] = [first, second].map(row => {
        const from = row * this.pose.length + at;
        return arrays.pose.values.subarray(from, from + 3);
      });
      this.pose.set(share > 0 ? slerpAxisAngle(before, after, share) : before, at);
    }
    if (this.shapes.active) this.shapes.apply(frame, this.coefficients, this.pose);
    replacePinned(this.coefficients, this.pinnedCoefficients);
    replacePinned(this.pose, this.pinnedPose);
  }

  release() {
    const { pinnedCoefficients, pinnedPose, shapes } = this;
    for (const pinned of [pinnedCoefficients, pinnedPose, shapes.pinned]) pinned.fill(NaN);
  }
}

// Rows before and after a time, and the share of the second.
/** @type {(time: number, rows: number) => [number, number, number]} */
function neighbors(time, rows) {
  const first = Math.min(Math.max(Math.floor(time), 0), rows - 1);
  return [first, Math.min(first + 1, rows - 1), Math.min(Math.max(time - first, 0), 1)];
}

/** @type {(values: Float64Array, pinned: Float64Array) => void} */
function replacePinned(values, pinned) {
  for (let k = 0; k < values.length; k++) if (!Number.isNaN(pinned[k])) values[k] = pinned[k];
}

export class Rig {
  /** @param {Data} data */
  constructor({ header, arrays }) {
    const joints = header.parents.length;
    this.arrays = arrays;
    this.parents = header.parents.map(parent => (parent < 0 ? joints : parent));
    this.shaped = new Float64Array(3 * arrays.base.shape[0]);
    this.vertices = this.shaped.slice();
    this.local = new Float64Array(9 * joints);
    this.joints = new Float64Array(3 * joints);
    // Per joint: rotation and offset, rows of a 3×4 matrix. The last, the root's parent, rests.
    this.skin = new Float64Array(12 * joints + 12);
    for (let row = 0; row < 3; row++) this.skin[12 * joints + 5 * row] = 1;
  }

  // Vertices (3·V, meters) of coefficients (R), pose (3·J, axis-angle) and translation (3).
  /** @param {Motion} motion */
  pose({ coefficients, pose, translation }) {
    const { base, basis, correctives, joint_rest, joint_basis } = this.arrays;
    const weights = this.arrays.weights.values;
    const { joints, shaped, skin, vertices } = this;
    shaped.set(base.values);
    joints.set(joint_rest.values);
    addShapes(shaped, basis.values, coefficients);
    addShapes(joints, joint_basis.values, coefficients);
    for (let at = 0; at < pose.length; at += 3)
      this.local.set(matrixOf(pose.subarray(at, at + 3)), 3 * at);
    // Correctives follow the entries of the rotations of joints 1… minus identity.
    const features = this.local.slice(9).map((entry, k) => entry - ((k % 9) % 4 === 0 ? 1 : 0));
    addShapes(shaped, correctives.values, features);
    this.chain();
    const count = this.parents.length;
    for (let v = 0, at = 0; at < shaped.length; v++, at += 3) {
      const x = shaped[at];
      const y = shaped[at + 1];
      const z = shaped[at + 2];
      let px = translation[0];
      let py = translation[1];
      let pz = translation[2];
      for (let j = 0; j < count; j++) {
        const w = weights[v * count + j];
        if (w === 0) continue;
        const s = 12 * j;
        px += w * (skin[s] * x + skin[s + 1] * y + skin[s + 2] * z + skin[s + 3]);
        py += w * (skin[s + 4] * x + skin[s + 5] * y + skin[s + 6] * z + skin[s + 7]);
        pz += w * (skin[s + 8] * x + skin[s + 9] * y + skin[s + 10] * z + skin[s + 11]);
      }
      vertices[at] = px;
      vertices[at + 1] = py;
      vertices[at + 2] = pz;
    }
    return vertices;
  }

  /** Rotation and offset of each joint in the world, from the root outwards. */
  chain() {
    const { parents, joints, local, skin } = this;
    for (let j = 0; j < parents.length; j++) {
      for (let to = 12 * j, from = 12 * parents[j]; to < 12 * j + 12; to += 4, from += 4) {
        let offset = skin[from + 3];
        for (let c = 0; c < 3; c++) {
          const [x, y, z] = [local[9 * j + c], local[9 * j + c + 3], local[9 * j + c + 6]];
          skin[to + c] = skin[from] * x + skin[from + 1] * y + skin[from + 2] * z;
          offset += (skin[from + c] - skin[to + c]) * joints[3 * j + c]; // which the parent carries
        }
        skin[to + 3] = offset;
      }
    }
  }
}

// target += Σ factor · shape, eight shapes in a pass: passes over `target` and loops cost more than
// the sums.
/** @type {(target: Float64Array, shapes: ArrayLike<number>, factors: ArrayLike<number>) => void} */
function addShapes(target, shapes, factors) {
  const size = target.length;
  /** @type {number[]} */
  const offset = [];
  /** @type {number[]} */
  const factor = [];
  for (let k = 0; k < factors.length; k++) {
    if (factors[k] === 0) continue;
    offset.push(k * size);
    factor.push(factors[k]);
  }
  while (offset.length % 8) {
    offset.push(0);
    factor.push(0);
  }
  for (let n = 0; n < offset.length; n += 8) {
    const [a, b, c, d] = offset.slice(n, n + 4);
    const [e, f, g, h] = offset.slice(n + 4, n + 8);
    const [p, q, r, s] = factor.slice(n, n + 4);
    const [t, u, v, w] = factor.slice(n + 4, n + 8);
    for (let i = 0; i < size; i++) {
      target[i] +=
        p * shapes[a + i] +
        q * shapes[b + i] +
        r * shapes[c + i] +
        s * shapes[d + i] +
        t * shapes[e + i] +
        u * shapes[f + i] +
        v * shapes[g + i] +
        w * shapes[h + i];
    }
  }
}

/** Weights of the shapes: pinned ones, else those of a performance, else 0; and what they pose. */
export class Shapes {
  /** @param {Data} data */
  constructor({ header, arrays }) {
    const { shapes, joints } = header;
    this.names = shapes?.names ?? [];
    this.linear = arrays.shape_linear?.values;
    this.products = arrays.shape_products?.values;
    this.expressions = arrays.shape_products?.shape[1] ?? 0;
    this.opens = this.names.indexOf(shapes?.opens ?? '');
    this.limited = this.names.indexOf(shapes?.limited ?? '');
    this.joints = ['jaw', 'left_eye', 'right_eye'].map(joint => 3 * joints.indexOf(joint));
    this.neck = 3 * joints.indexOf('neck');
    this.weights = new Float64Array(this.names.length);
    this.pinned = this.weights.slice().fill(NaN);
    this.values = new Float64Array(this.expressions + 9);
    /** @type {Performance | null} */
    this.performance = null;
  }

  /** Whether the shapes replace the recorded expressions, jaw and eyes. */
  get active() {
    return this.performance !== null || this.pinned.some(value => !Number.isNaN(value));
  }

  // Replace expressions, jaw and eyes, and turn the neck as the performance does.
  /** @type {(frame: number, coefficients: Float64Array, pose: Float64Array) => void} */
  apply(frame, coefficients, pose) {
    const head = this.sample(frame);
    const { expressions, linear, opens, products, values, weights } = this;
    if (!linear || !products) return;
    values.fill(0);
    for (let shape = 0; shape < weights.length; shape++) {
      let weight = weights[shape];
      if (shape === this.limited) weight = Math.min(weight, Math.max(weights[opens], 0));
      if (weight === 0) continue;
      const product = weight * weights[opens];
      const from = shape * values.length;
      for (let k = 0; k < values.length; k++) values[k] += weight * linear[from + k];
      for (let k = 0; k < expressions; k++)
        values[k] += product * products[shape * expressions + k];
    }
    coefficients.fill(0);
    coefficients.set(values.subarray(0, expressions));
    for (const [number, at] of this.joints.entries()) {
      const from = expressions + 3 * number;
      if (at >= 0) pose.set(values.subarray(from, from + 3), at);
    }
    if (!head || this.neck < 0) return;
    // About y, then the turned x, then the turned z.
    const [yaw, pitch, roll] = head;
    const turned = multiplied(quaternionOf([0, yaw, 0]), quaternionOf([pitch, 0, 0]));
    pose.set(axisAngleOf(multiplied(turned, quaternionOf([0, 0, roll]))), this.neck);
  }

  // Fill the weights with those of the frame; returns yaw, pitch and roll of the head, where the
  // performance has them.
  /** @type {(frame: number) => number[] | null} */
  sample(frame) {
    const { performance, pinned, weights } = this;
    weights.fill(0);
    let head = null;
    if (performance) {
      const { columns, rows } = performance;
      const [first, second, share] = neighbors(frame, rows.length);
      const value = (/** @type {number} */ column) =>
        rows[first][column] + share * (rows[second][column] - rows[first][column]);
      for (let k = 0; k < weights.length; k++) if (columns[k] >= 0) weights[k] = value(columns[k]);
      if (performance.head.every(column => column >= 0)) head = performance.head.map(value);
    }
    replacePinned(weights, pinned);
    return head;
  }
}
