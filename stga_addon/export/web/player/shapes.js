// @ts-check
// Shapes such as ARKit's 52, which move expressions, jaw and eyes together, and performances of them.

/** @import { Data, Performance } from './types.js' */

import { multiplied, quaternionOf, axisAngleOf } from './rotation.js';

const JOINTS = ['jaw', 'left_eye', 'right_eye'];
const NECK = 'neck';

/** Weights of the shapes: pinned ones, else those of a performance, else 0; and what they pose. */
export class Shapes {
  /** @param {Data} data */
  constructor({ header, arrays }) {
    const { shapes, joints } = header;
    this.names = shapes?.names ?? [];
    this.linear = arrays.shape_linear?.values;
    this.products = arrays.shape_products?.values;
    this.columns = arrays.shape_linear?.shape[1] ?? 0;
    this.expressions = arrays.shape_products?.shape[1] ?? 0;
    this.opens = this.names.indexOf(shapes?.opens ?? '');
    this.limited = this.names.indexOf(shapes?.limited ?? '');
    this.joints = JOINTS.map((joint) => 3 * joints.indexOf(joint));
    this.neck = 3 * joints.indexOf(NECK);
    this.weights = new Float64Array(this.names.length);
    this.pinned = new Float64Array(this.names.length).fill(NaN);
    this.values = new Float64Array(this.columns);
    /** @type {Performance | null} */
    this.performance = null;
  }

  /** Whether the shapes replace the recorded expressions, jaw and eyes. */
  get active() {
    return this.performance !== null || this.pinned.some((value) => !Number.isNaN(value));
  }

  release() {
    this.pinned.fill(NaN);
  }

  /**
   * Replace expressions, jaw and eyes, and turn the neck as the performance does.
   * @param {number} frame
   * @param {Float64Array} coefficients
   * @param {Float64Array} pose
   */
  apply(frame, coefficients, pose) {
    const head = this.sample(frame);
    const { columns, expressions, linear, opens, products, values, weights } = this;
    if (!linear || !products) return;
    values.fill(0);
    for (let shape = 0; shape < weights.length; shape++) {
      let weight = weights[shape];
      if (shape === this.limited) weight = Math.min(weight, Math.max(weights[opens], 0));
      if (weight === 0) continue;
      for (let k = 0; k < columns; k++) values[k] += weight * linear[shape * columns + k];
      const product = weight * weights[opens];
      for (let k = 0; k < expressions; k++) values[k] += product * products[shape * expressions + k];
    }
    coefficients.fill(0);
    coefficients.set(values.subarray(0, expressions));
    for (const [number, at] of this.joints.entries()) {
      if (at >= 0) pose.set(values.subarray(expressions + 3 * number, expressions + 3 * number + 3), at);
    }
    if (head && this.neck >= 0) pose.set(headTurn(head), this.neck);
  }

  /**
   * Fill the weights with those of the frame; returns yaw, pitch and roll of the head, where the performance has them.
   * @param {number} frame
   * @returns {number[] | null}
   */
  sample(frame) {
    const { performance, pinned, weights } = this;
    weights.fill(0);
    let head = null;
    if (performance) {
      const first = Math.min(Math.max(Math.floor(frame), 0), performance.rows.length - 1);
      const second = Math.min(first + 1, performance.rows.length - 1);
      const share = Math.min(Math.max(frame - first, 0), 1);
      const [before, after] = [performance.rows[first], performance.rows[second]];
      for (let k = 0; k < weights.length; k++) {
        const column = performance.columns[k];
        if (column >= 0) weights[k] = before[column] + share * (after[column] - before[column]);
      }
      if (performance.head.every((column) => column >= 0)) {
        head = performance.head.map((column) => before[column] + share * (after[column] - before[column]));
      }
    }
    for (let k = 0; k < weights.length; k++) if (!Number.isNaN(pinned[k])) weights[k] = pinned[k];
    return head;
  }
}

/**
 * Axis-angle of yaw, pitch and roll: about y, then the turned x, then the turned z.
 * @param {number[]} angles
 */
function headTurn([yaw, pitch, roll]) {
  const turned = multiplied(quaternionOf([0, yaw, 0]), quaternionOf([pitch, 0, 0]));
  return axisAngleOf(multiplied(turned, quaternionOf([0, 0, roll])));
}
