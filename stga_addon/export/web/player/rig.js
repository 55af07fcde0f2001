// @ts-check
// The mesh of a pose: blend shapes, pose correctives, linear blend skinning, translation.

/** @import { Data } from './types.js' */

import { matrixFromAxisAngle } from './rotation.js';

export class Rig {
  /** @param {Data} data */
  constructor({ header, arrays }) {
    this.parents = header.parents;
    this.base = arrays.base.values;
    this.basis = arrays.basis.values;
    this.correctives = arrays.correctives.values;
    this.weights = arrays.weights.values;
    this.jointRest = arrays.joint_rest.values;
    this.jointBasis = arrays.joint_basis.values;
    const joints = this.parents.length;
    this.shaped = new Float64Array(this.base.length);
    this.vertices = new Float64Array(this.base.length);
    this.joints = new Float64Array(3 * joints);
    this.local = new Float64Array(9 * joints);
    this.skin = new Float64Array(12 * joints); // per joint: rotation and offset, rows of a 3×4 matrix
    this.placed = new Float64Array(3 * joints);
  }

  /**
   * Vertices (3·V, meters) of coefficients (R), pose (3·J, axis-angle) and translation (3).
   * @param {ArrayLike<number>} coefficients
   * @param {ArrayLike<number>} pose
   * @param {ArrayLike<number>} translation
   */
  pose(coefficients, pose, translation) {
    this.shaped.set(this.base);
    this.joints.set(this.jointRest);
    addShapes(this.shaped, this.basis, coefficients);
    addShapes(this.joints, this.jointBasis, coefficients);
    for (let j = 0; j < this.parents.length; j++) matrixFromAxisAngle(pose, 3 * j, this.local, 9 * j);
    if (this.correctives.length) addShapes(this.shaped, this.correctives, this.poseFeatures());
    this.chain();
    this.skinVertices(translation);
    return this.vertices;
  }

  /** The entries of the rotations of joints 1… minus identity. */
  poseFeatures() {
    return this.local.slice(9).map((entry, k) => entry - ((k % 9) % 4 === 0 ? 1 : 0));
  }

  /** Rotation and offset of each joint in the world, from the root outwards. */
  chain() {
    const { parents, joints, local, skin, placed } = this;
    for (let j = 0; j < parents.length; j++) {
      const parent = parents[j];
      for (let row = 0; row < 3; row++) {
        const to = 12 * j + 4 * row;
        if (parent < 0) {
          for (let c = 0; c < 3; c++) skin[to + c] = local[9 * j + 3 * row + c];
          placed[3 * j + row] = joints[3 * j + row];
        } else {
          const from = 12 * parent + 4 * row;
          for (let c = 0; c < 3; c++) {
            const at = 9 * j + c;
            skin[to + c] = skin[from] * local[at] + skin[from + 1] * local[at + 3] + skin[from + 2] * local[at + 6];
          }
          let sum = placed[3 * parent + row];
          for (let c = 0; c < 3; c++) sum += skin[from + c] * (joints[3 * j + c] - joints[3 * parent + c]);
          placed[3 * j + row] = sum;
        }
        const turned = skin[to] * joints[3 * j] + skin[to + 1] * joints[3 * j + 1] + skin[to + 2] * joints[3 * j + 2];
        skin[to + 3] = placed[3 * j + row] - turned;
      }
    }
  }

  /** @param {ArrayLike<number>} translation */
  skinVertices(translation) {
    const { shaped, weights, skin, vertices } = this;
    const joints = this.parents.length;
    for (let v = 0, at = 0; at < shaped.length; v++, at += 3) {
      const x = shaped[at];
      const y = shaped[at + 1];
      const z = shaped[at + 2];
      let px = translation[0];
      let py = translation[1];
      let pz = translation[2];
      for (let j = 0; j < joints; j++) {
        const w = weights[v * joints + j];
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
  }
}

/**
 * target += Σ factor · shape, eight shapes in a pass: passes over `target` and loops cost more than the sums.
 * @param {Float64Array} target
 * @param {ArrayLike<number>} shapes
 * @param {ArrayLike<number>} factors
 */
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
